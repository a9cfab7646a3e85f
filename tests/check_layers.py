#!/usr/bin/env python3
"""The rules of the house that a program can check: check_layers.py SOURCE_ROOT

One way down (cmd -> lib/{scene,out} -> {dem, fbm} -> lib/base; fbm includes nothing of ours but its own; the program sees
only the public header), unique file names, no printing and no exit below cmd/, nothing that makes results depend on the
machine, and no path of a machine. Each rule is first tried on a line that breaks it.
"""
import os
import re
import subprocess
import sys

MAY_INCLUDE = {
    "cmd": {"cmd", "lib"},
    "lib": {"lib"},
    "lib/scene": {"lib/scene", "lib/out", "dem", "fbm", "lib/base", "lib"},
    "lib/out": {"lib/scene", "lib/out", "dem", "fbm", "lib/base", "lib"},
    "lib/base": {"lib/base", "lib"},
    "dem": {"dem", "lib/base", "lib"},
    "fbm": {"fbm"},
    "examples": set(),
}
SHARED_NAMES = {"meson.build", "run.sh"}  # the README names both run.sh
SOURCE = (".c", ".h", ".cpp", ".hpp", ".in")
TEXT = SOURCE + (".py", ".sh", ".build", ".txt", ".md", ".scd", ".json", ".yml", ".yaml", ".html", ".css", ".js", ".svg")
PRINTING = re.compile(r"\b(v?printf|v?fprintf|v?dprintf|puts|fputs|putchar|putc|fputc|perror|psignal|exit|_exit|_Exit|quick_exit|"
                      r"abort)\s*\(|\b(stdout|stderr)\b|\bstd::(cout|cerr|clog)\b")
LIBM = re.compile(r"\b(a?(sin|cos|tan)h?|atan2|exp|exp2|expm1|log|log2|log10|log1p|pow|sqrt|cbrt|hypot|floor|ceil|round|rint|"
                  r"nearbyint|trunc|lround|fma|fmod|remainder|ldexp|frexp|scalbn|erf|erfc|tgamma|lgamma|fmin|fmax|fabs)[fl]?\s*\(")
# put together here, so that this file does not hold what it looks for
MACHINE_DEPENDENT = re.compile("-f" + "fast-math|-O" + "fast|-funsafe-" + "math|-march=" + "native|pragma\\s+" + "omp|<" +
                               "omp\\.h>|<" + "threads\\.h>")
MACHINE_PATH = re.compile(r"(?<![\w.$}])/" + r"(home|root|work|Users|builds?|mnt)/" + r"\w")


def area(path):
    """The room that a file lies in."""
    parts = os.path.dirname(path).split("/")
    two = "/".join(parts[:2])
    return two if two in MAY_INCLUDE else parts[0]


def code(text):
    """C without comments and the content of strings."""
    pattern = r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\''
    return re.sub(pattern, lambda found: '""' if found.group()[0] == '"' else " ", text, flags=re.S)


def includes(text):
    return re.findall(r'^[ \t]*#[ \t]*include[ \t]*"([^"]+)"', text, flags=re.M)


def layers(path, text):
    here = area(path)
    for name in includes(text) if here in MAY_INCLUDE and path.endswith(SOURCE) else ():
        if area(name) not in MAY_INCLUDE[here]:
            yield f"{here} must not include {name}"
        elif area(name) == "lib" and name != "lib/talus.h":
            yield f"{name} is no public header"


def printing(path, text):
    if area(path) in set(MAY_INCLUDE) - {"cmd", "examples"} and path.endswith(SOURCE):
        for found in PRINTING.finditer(code(text)):
            yield f"{found.group().strip('( ')} below cmd/"


def kernels(path, text):
    if re.fullmatch(r"fbm/kernel\w*\.[ch]", path):
        for found in LIBM.finditer(code(text)):
            yield f"{found.group().strip('( ')} of libm in a kernel: its last bit differs between C libraries"
        if re.search(r"#\s*include\s*<(tg)?math\.h>", text) and path == "fbm/kernel.c":
            yield "math.h in a kernel"


def machines(path, text):
    for found in MACHINE_DEPENDENT.finditer(text):
        yield f"{found.group()}: results would depend on the machine, or threads on the C library"


def paths(path, text):
    for found in MACHINE_PATH.finditer(text):
        yield f"{found.group()}...: a path of some machine"


RULES = (layers, printing, kernels, machines, paths)
BROKEN = (  # for each rule a file that breaks it, and one that is near but does not
    (layers, "fbm/a.c", '#include "lib/talus.h"\n', '#include "fbm/rng.h"\n#include <math.h>\n'),
    (layers, "dem/a.c", '#include "fbm/rng.h"\n', '#include "lib/talus.h"\n#include "lib/base/size.h"\n'),
    (layers, "lib/base/a.c", '#include "dem/crs.h"\n', '#include "lib/base/size.h"\n'),
    (layers, "lib/scene/a.c", '#include "cmd/options.h"\n', '#include "dem/crs.h"\n'),
    (layers, "cmd/a.c", '#include "lib/base/size.h"\n', '#include "lib/talus.h"\n'),
    (printing, "dem/a.c", 'void f(void) { fprintf(stderr, "x"); }\n', "/* printf( */ snprintf(a, b); g(\"exit(1)\");\n"),
    (printing, "lib/out/a.cpp", "std::cerr << 1;\n", "tl_output_abort(output);\n"),
    (printing, "fbm/a.c", "exit(1);\n", "on_exit_of(x);\n"),
    (kernels, "fbm/kernel.c", "y = sqrtf(x);\n", "y = square(x); /* sqrt( */\n"),
    (machines, "meson.build", "'-f" + "fast-math'\n", "'-ffp-contract=off'\n"),
    (paths, "doc/a.md", "see /" + "home/me/x\n", "https://example.org/home/me and $HOME/work/x\n"),
)


def self_test():
    for rule, path, bad, good in BROKEN:
        if not list(rule(path, bad)):
            sys.exit(f"check_layers.py: {rule.__name__} does not see what is wrong in {bad!r}")
        if list(rule(path, good)):
            sys.exit(f"check_layers.py: {rule.__name__} sees a fault in {good!r}")


def files(root):
    """What belongs to the project: git's list, or else all but build folders."""
    listed = subprocess.run(["git", "-C", root, "ls-files", "-z"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                            check=False) if os.path.exists(os.path.join(root, ".git")) else None
    if listed and listed.returncode == 0:
        return [name for name in listed.stdout.decode().split("\0") if name and os.path.exists(os.path.join(root, name))]
    found = []
    for folder, folders, names in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith((".", "build", "obj-"))]
        found += [os.path.relpath(os.path.join(folder, name), root) for name in names]
    return found


def main():
    self_test()
    root, faults, seen = sys.argv[1], [], {}
    names = files(root)
    for path in names:
        name = os.path.basename(path)
        if name in seen and name not in SHARED_NAMES:
            faults.append(f"{path}: {seen[name]} has the same name")
        seen[name] = path
        if not path.endswith(TEXT) and not path.startswith(".ci/"):
            continue
        with open(os.path.join(root, path), encoding="utf-8") as file:
            text = file.read()
        faults += [f"{path}: {fault}" for rule in RULES for fault in rule(path, text)]
        for include in includes(text) if path.endswith(SOURCE) else ():
            if "/" in include and not os.path.exists(os.path.join(root, include)):
                faults.append(f"{path}: there is no {include}")
    print("".join(f"{fault}\n" for fault in faults), end="")
    print(f"{len(names)} files, {len(faults)} faults")
    sys.exit(bool(faults) or len(names) < 50)


main()
