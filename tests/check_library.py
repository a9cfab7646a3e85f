#!/usr/bin/env python3
"""The library as its users get it: check_library.py SOURCE_ROOT BUILD_ROOT COMPILER

The header alone as C11, C17 and C++17 without a warning; its functions, and nothing else, in the shared library; kernels that
call nothing; and, installed into a folder of its own, a program that is built by pkg-config and runs.
"""
import glob
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile

SOURCE, BUILD = os.path.abspath(sys.argv[1]), os.path.abspath(sys.argv[2])
CC = shlex.split(sys.argv[3])
HEADER = os.path.join(SOURCE, "lib", "talus.h")
STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Werror"]


def run(*words, fails=False, **options):
    found = subprocess.run(list(map(str, words)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False, **options)
    text = found.stdout.decode("utf-8", "replace")
    if (found.returncode != 0) != fails:
        raise AssertionError(f"{' '.join(map(str, words))}: exit status {found.returncode}\n{text}")
    return text


def header_alone(folder):
    checked = 0
    for compiler, language, standard in (("gcc", "c", "c11"), ("gcc", "c", "c17"), ("g++", "c++", "c++17"),
                                         ("clang", "c", "c11"), ("clang", "c", "c17"), ("clang++", "c++", "c++17")):
        if shutil.which(compiler):
            command = (compiler, "-x", language, f"-std={standard}", *STRICT, "-fsyntax-only")
            unit = os.path.join(folder, "unit")
            for text in ('#include "talus.h"\n#include "talus.h"\nint talus_header_is_complete;\n',
                         '#define TL_BUILDING\n#include "talus.h"\nint talus_header_is_complete;\n'):
                with open(unit, "w", encoding="ascii") as file:
                    file.write(text)
                run(*command, "-I", os.path.dirname(HEADER), unit)
            with open(unit, "w", encoding="ascii") as file:
                file.write('#include "talus.h"\ntl_no_such_type x;\n')
            run(*command, "-I", os.path.dirname(HEADER), unit, fails=True)
            checked += 1
    assert checked, "no compiler"


def public_functions():
    with open(HEADER, encoding="utf-8") as file:
        text = re.sub(r"/\*.*?\*/|^#[^\n]*", " ", file.read(), flags=re.S | re.M)
    names = re.findall(r"\bTL_API\b[^;]*?\b(\w+)\s*\([^;]*\)\s*;", text)
    assert len(names) > 20 and len(names) == len(set(names)) == len(re.findall(r"\bTL_API\b", text)), names
    return set(names)


def exported_functions(_):
    library = glob.glob(os.path.join(BUILD, "lib", "libtalus.so*[0-9]"))
    lines = run("nm", "-D", "--defined-only", sorted(library)[-1]).splitlines()
    found = {line.split()[-1] for line in lines}
    missing, surplus = public_functions() - found, found - public_functions()
    assert not missing, f"in the header but not in the library: {sorted(missing)}"
    assert not surplus, f"in the library but not in the header: {sorted(surplus)}"


def kernels_call_nothing(_):
    """No function of libm, whose last bit differs between C libraries; copying memory and failing are allowed."""
    archives = glob.glob(os.path.join(BUILD, "fbm", "libfbm-*.a"))
    assert any("plain" in name for name in archives)
    allowed = {"memcpy", "memset", "memmove", "__assert_fail", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}
    for archive in archives:
        for obj in glob.glob(os.path.join(archive + ".p", "*.o")):
            words = [line.split()[-1] for line in run("nm", "-u", obj).splitlines() if line.strip()]
            called = {word for word in words if not word.startswith(("fbm_", "__cpu", "__asan", "__ubsan"))} - allowed
            assert not called, f"{os.path.basename(obj)} calls {sorted(called)}"


def installed_program(folder):
    destination = os.path.join(folder, "root")
    run("meson", "install", "-C", BUILD, "--no-rebuild", "--destdir", destination, "--quiet")
    files = {os.path.relpath(os.path.join(where, name), destination)
             for where, _, names in os.walk(destination) for name in names}
    headers = [name for name in files if name.endswith(".h")]
    assert [os.path.basename(name) for name in headers] == ["talus.h"], f"installed headers: {headers}"
    config = [name for name in files if name.endswith("talus.pc")]
    assert len(config) == 1 and any(name.endswith("bin/talus") for name in files), f"{sorted(files)}"
    pc = os.path.join(destination, os.path.dirname(config[0]))
    environment = {**os.environ, "PKG_CONFIG_PATH": pc, "PKG_CONFIG_SYSROOT_DIR": destination}
    version = run("pkg-config", "--modversion", "talus", env=environment).strip()
    # without the sysroot, pkg-config's paths lie outside of the folder, and libraries of the system have none
    flags = run("pkg-config", "--cflags", "--libs", "talus", env=environment).split()
    libraries = os.path.dirname(pc)
    environment["LD_LIBRARY_PATH"] = libraries
    program = os.path.join(folder, "api_synth")
    run(*CC, "-std=c11", *STRICT, os.path.join(SOURCE, "examples", "api_synth.c"), "-o", program, *flags)
    said = run(program, os.path.join(SOURCE, "examples", "jacksboro.tif"), os.path.join(folder, "a.raw"), "2",
               env=environment)
    assert said == f"talus {version}: 1612 x 1376 samples\n", said
    talus = os.path.join(destination, next(name for name in files if name.endswith("bin/talus")))
    run(talus, "synth", os.path.join(SOURCE, "examples", "jacksboro.tif"), "-l", 2, "-q", "-o", "b.raw", env=environment,
        cwd=folder)
    with open(os.path.join(folder, "a.raw"), "rb") as a, open(os.path.join(folder, "b.raw"), "rb") as b:
        assert a.read() == b.read(), "the library and the program make different files"
    said = run(program, "absent.tif", "c.exr", "2", fails=True, env=environment, cwd=folder)
    assert said == "absent.tif: cannot read: No such file or directory\n", said
    verify = os.path.join(folder, "api_verify_fbm")
    run(*CC, "-std=c11", *STRICT, os.path.join(SOURCE, "examples", "api_verify_fbm.c"), "-o", verify, *flags)
    said = run(verify, env=environment)
    assert said.startswith("H 0.") and said.count("\n") == 1, said
    said = run(verify, os.path.join(SOURCE, "examples", "jacksboro.tif"), "0.7", "16", fails=True, env=environment)
    assert "standard error" in said, said


def main():
    tests = (header_alone, exported_functions, kernels_call_nothing, installed_program)
    failed = 0
    for test in tests:
        with tempfile.TemporaryDirectory(prefix="talus-test-") as folder:
            try:
                test(folder)
                print(f"[       OK ] {test.__name__}")
            except AssertionError as error:
                failed += 1
                print(f"[  FAILED  ] {test.__name__}: {error}")
    print(f"[==========] {len(tests)} test(s) run.\n[  PASSED  ] {len(tests) - failed} test(s).")
    if failed:
        print(f"[  FAILED  ] {failed} test(s), listed above")
    sys.exit(failed > 0)


main()
