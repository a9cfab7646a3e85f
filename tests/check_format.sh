#!/bin/sh
# Whether clang-format would change a C or C++ file: check_format.sh SOURCE_ROOT. Skipped (77) where clang-format is missing.
set -eu
cd "$1"
command -v clang-format >/dev/null || {
    echo "clang-format is not installed"
    exit 77
}
# git knows what belongs to the project; without it, all but build folders (debhelper's is obj-MACHINE) and hidden ones
list() {
    git ls-files -- '*.c' '*.h' '*.cpp' 2>/dev/null | grep . ||
        find . \( -name '.?*' -o -name 'build*' -o -name 'obj-*' \) -prune -o \( -name '*.c' -o -name '*.h' -o -name '*.cpp' \) -print
}
# a check that cannot fail is none
if printf 'int  a ;\n' | clang-format --style=file --assume-filename=a.c --dry-run -Werror 2>/dev/null; then
    echo "clang-format finds nothing wrong in 'int  a ;'"
    exit 1
fi
list | while read -r file; do [ ! -f "$file" ] || echo "$file"; done | xargs clang-format --style=file --dry-run -Werror
