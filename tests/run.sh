#!/bin/sh
# Installs what is missing, builds talus three times (release; address and undefined sanitizers; without SIMD), runs every
# suite in each (without SIMD those that compute), checks warnings with clang, the layers, the format and the public header, and fuzzes what is read for a minute. Ends
# with "N passed, N failed".
#   tests/run.sh [FOLDER]    (default: build-tests beside the sources)
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
. "$here/examples/packages.sh"
need_packages $build_packages $test_packages

builds=${1:-$here/build-tests}
mkdir -p "$builds"
TALUS_SOURCE_ROOT=$here
export TALUS_SOURCE_ROOT

setup() { # FOLDER OPTION...
    folder=$1
    shift
    [ -f "$folder/build.ninja" ] || meson setup "$folder" "$here" "$@" >"$folder.log" 2>&1 || { cat "$folder.log"; exit 1; }
}

suite() { # NAME CHOICE OPTION...: builds and runs the tests chosen; their results are in the build folder
    name=$1 choice=$2
    shift 2
    setup "$builds/$name" --werror "$@"
    ninja -C "$builds/$name" --quiet
    echo "== $name"
    rm -f "$builds/$name/meson-logs/testlog.json" # of an earlier run
    meson test -C "$builds/$name" --no-rebuild --num-processes 2 --timeout-multiplier 4 --print-errorlogs $choice ||
        : # summary.py counts what failed
}

suite release ''
suite sanitize '' -Db_sanitize=address,undefined -Db_lundef=false -Dbuildtype=debugoptimized
suite portable '--no-suite program' -Dsimd=false

echo "== clang"
CC=clang CXX=clang++ setup "$builds/clang" --werror -Dtests=false
clang=ok
ninja -C "$builds/clang" --quiet || clang=failed

echo "== without what talus can do without"
lesser=ok
python3 "$here/tests/lesser.py" "$builds/lesser" || lesser=failed

echo "== fuzzing, a minute in all"
fuzzing=ok
"$here/tests/fuzz/run.sh" 60 "$builds/fuzz" || fuzzing=failed

python3 "$here/tests/summary.py" "clang warnings=$clang" "build without optional parts=$lesser" "fuzzing=$fuzzing" "$builds"/release "$builds"/sanitize "$builds"/portable
