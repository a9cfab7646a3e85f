#!/bin/sh
# Analysis that is too slow for tests/run.sh: cppcheck, valgrind's memcheck over the golden command lines, the thread
# sanitizer over four threads, and the coverage of lib, dem and fbm by the tests. Each prints what it found.
#   tests/analysis/run.sh [FOLDER]    (default: build-analysis beside the sources)
set -eu
here=$(cd "$(dirname "$0")/../.." && pwd)
folder=${1:-$here/build-analysis}
mkdir -p "$folder/cppcheck"
failed=0

build() { # NAME OPTION...
    name=$1
    shift
    [ -f "$folder/$name/build.ninja" ] || meson setup "$folder/$name" "$here" "$@" >"$folder/$name.log" 2>&1 ||
        { cat "$folder/$name.log"; exit 1; }
    ninja -C "$folder/$name" --quiet
}

echo "== cppcheck"
(cd "$here" && cppcheck --enable=warning,portability --std=c11 -I . -DTL_HAVE_CAIRO -DTL_HAVE_MICROHTTPD -DTL_HAVE_SQLITE \
    --include=tests/analysis/cppcheck.h --quiet --error-exitcode=1 \
    --suppressions-list=tests/analysis/cppcheck.supp --cppcheck-build-dir="$folder/cppcheck" \
    --template='{file}:{line}: {id}: {message}' lib dem fbm cmd) || failed=1

echo "== valgrind"
build plain --buildtype=debugoptimized -Dtests=false
"$here/tests/cli/cli_test.py" "$folder/plain/cmd/talus" --valgrind || failed=1

echo "== thread sanitizer"
build threads -Db_sanitize=thread -Db_lundef=false --buildtype=debugoptimized -Dtests=false
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp "$here/examples/jacksboro.tif" "$work/dem.tif"
while read -r words; do
    if (cd "$work" && TSAN_OPTIONS=halt_on_error=1 "$folder/threads/cmd/talus" $words -t 4 -q >out 2>&1); then
        echo "clean: $words"
    else
        echo "FOUND: $words"
        head -n 40 "$work/out"
        failed=1
    fi
done <<'END'
synth dem.tif --window 40,30,150,110 -l 2 -o a.exr
simplify dem.tif -e 20 -o a.glb
simplify dem.tif -e 20 --mesh tin -o a.ply
tiles dem.tif -l 9..11 -o t
tiles dem.tif -f 3dtiles -o t3
view dem.tif --eye -84.3179,36.5171,6000 --pitch -89 --viewport 200x120 -l 2 -o v.glb --picture v.png
END

echo "== coverage"
build coverage -Db_coverage=true --buildtype=debugoptimized
meson test -C "$folder/coverage" --no-rebuild --timeout-multiplier 4 >"$folder/coverage-tests.log" 2>&1 || failed=1
(cd "$folder/coverage" && gcovr --root "$here" --filter "$here/lib/" --filter "$here/dem/" --filter "$here/fbm/" --print-summary |
    tail -n 4)
exit $failed
