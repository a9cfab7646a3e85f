#!/usr/bin/env python3
"""Command lines and what they must print: cli_test.py PROGRAM [--update] [--valgrind] [NAME...]

A case is NAME.args in tests/golden, a command line; beside it NAME.out and NAME.err hold what it prints (none: nothing) and
NAME.status its exit status (none: 0). {example} stands for examples/jacksboro.tif, {tmp} for the fresh folder in which the
program runs and in which the inputs of prepare() lie, {version} for the program's version; times and speeds are T and R.
--valgrind runs it under memcheck, whose findings, leaks too, are failures.
--update writes what the program does now; read the difference before you commit it.
"""
import glob
import math
import os
import re
import shlex
import subprocess
import sys

sys.dont_write_bytecode = True  # the sources may lie in a folder that must stay clean
import harness
from harness import EXAMPLE, ROOT, expect, run_tests
from raster_files import write_tiff

GOLDEN = os.path.join(ROOT, "tests", "golden")


def prepare(case):
    with open(EXAMPLE, "rb") as file:
        example = file.read()
    contents = {"empty.tif": b"", "text.tif": b"this is no elevation model\n", "cut.tif": example[:len(example) // 2],
                "exists.exr": b"precious", "exists.glb": b"precious", "exists.tif": b"precious",
                "exists.png": b"precious", "beside.json": b"precious"}
    for name, content in contents.items():
        with open(case.path(name), "wb") as file:
            file.write(content)
    os.mkdir(case.path("folder"))
    wave = [100 + 20 * math.sin(0.7 * (k % 20)) * math.cos(0.4 * (k // 20)) for k in range(20 * 15)]
    holed = [math.nan if k % 7 == 3 else z for k, z in enumerate(wave)]
    utm = {"epsg": 32611, "origin": (400000, 3800000), "cell": (30, 30)}
    write_tiff(case.path("bare.tif"), 20, 15, wave)
    write_tiff(case.path("point.tif"), 20, 15, wave, point=True, **utm)
    write_tiff(case.path("area.tif"), 20, 15, wave, point=False, **utm)
    write_tiff(case.path("holes.tif"), 20, 15, holed, point=False, **utm)
    write_tiff(case.path("flat.tif"), 20, 15, [7.0] * 300, point=False, **utm)
    write_tiff(case.path("void.tif"), 6, 5, [math.nan] * 30, point=False, **utm)
    write_tiff(case.path("nodata.tif"), 6, 5, [-9999.0] * 30, point=False, nodata="-9999", **utm)
    write_tiff(case.path("one.tif"), 1, 1, [5.0], point=False, **utm)
    write_tiff(case.path("row.tif"), 20, 1, wave[:20], point=False, **utm)
    write_tiff(case.path("east.tif"), 20, 15, wave, point=False, epsg=32611, origin=(400600, 3800000), cell=(30, 30))
    write_tiff(case.path("coarse.tif"), 20, 15, wave, point=False, epsg=32611, origin=(400000, 3799550), cell=(60, 60))
    write_tiff(case.path("zone12.tif"), 20, 15, wave, point=False, **{**utm, "epsg": 32612})
    with open(case.path("tiles.txt"), "w", encoding="utf-8") as file:
        file.write("# two tiles\narea.tif\neast.tif\n")


def normalise(printed, case, version):
    printed = printed.replace(EXAMPLE, "{example}").replace(case.folder, "{tmp}").replace(version, "{version}")
    printed = re.sub(r"\b\d+\.\d\d s\b", "T s", printed)
    return re.sub(r"\b\d+\.\d M samples/s", "R M samples/s", printed)


def content(path, default):
    if not os.path.exists(path):
        return default
    with open(path, encoding="utf-8") as file:
        return file.read()


def store(path, text, default):
    if text != default:
        with open(path, "w", encoding="utf-8") as file:
            file.write(text)
    elif os.path.exists(path):
        os.remove(path)


def golden_case(stem, version, update):
    def test(case):
        prepare(case)
        line = content(stem + ".args", "").replace("{example}", EXAMPLE).replace("{tmp}", case.folder)
        result = case.run(*shlex.split(line), status=None)
        got = {".out": normalise(result.out, case, version), ".err": normalise(result.err, case, version),
               ".status": f"{result.status}\n"}
        for ending, text in got.items():
            default = "0\n" if ending == ".status" else ""
            if update:
                store(stem + ending, text, default)
            want = content(stem + ending, default)
            expect(text == want, f"talus {line}{ending[1:]} is\n{text}where {os.path.basename(stem)}{ending} has\n{want}")

    test.name = os.path.basename(stem)
    return test


def main():
    program = os.path.abspath(sys.argv[1])
    update = "--update" in sys.argv[2:]
    if "--valgrind" in sys.argv[2:]:
        harness.WRAPPER = ["valgrind", "--quiet", "--error-exitcode=99", "--leak-check=full", "--errors-for-leak-kinds=definite",
                           f"--suppressions={ROOT}/tests/analysis/valgrind.supp"]
    names = [word for word in sys.argv[2:] if not word.startswith("-")]
    version = subprocess.run([program, "version"], stdout=subprocess.PIPE, check=True).stdout.decode().split()[1]
    stems = sorted(path[:-len(".args")] for path in glob.glob(os.path.join(GOLDEN, "*.args")))
    stems = [stem for stem in stems if not names or os.path.basename(stem) in names]
    sys.exit(run_tests(program, [golden_case(stem, version, update) for stem in stems]))


main()
