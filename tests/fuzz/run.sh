#!/bin/sh
# Fuzzes for a while: builds the targets with clang, makes the corpus, and runs all of them, two at a time.
#   tests/fuzz/run.sh SECONDS [FOLDER]    (default: build-fuzz beside the sources)
# SECONDS are those of the whole, but for building. Prints the number of executions and, as files, what was found; exits
# 1 when there is a finding. The corpus grows in FOLDER/grown, so that the next run goes on where this one ended.
set -eu
seconds=${1:?how many seconds?}
here=$(cd "$(dirname "$0")/../.." && pwd)
folder=${2:-$here/build-fuzz}
# Beside the targets the longest inputs that they try.
targets="raster:2048 exr:4096 views:768 meshes:2400 heights:2048 frameworks:3000 records:2200 options:512"
count=$(echo $targets | wc -w)
each=$((seconds * 2 / count))
[ "$each" -ge 1 ] || each=1
mkdir -p "$folder/findings"

build=$folder/build
# A double that its integer does not hold is no error to either group of checks by itself.
[ -f "$build/build.ninja" ] || CC=clang CXX=clang++ meson setup "$build" "$here" -Dfuzz=true \
    -Db_sanitize=address,undefined -Db_lundef=false -Dbuildtype=debugoptimized \
    -Dc_args=-fsanitize=float-cast-overflow >"$folder/setup.log" 2>&1 || {
    cat "$folder/setup.log"
    exit 1
}
# A small quarantine and short traces: three times as many executions. What a file may cost: 256 MB at once and 5 s.
ASAN_OPTIONS=quarantine_size_mb=16:malloc_context_size=6
UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1
export ASAN_OPTIONS UBSAN_OPTIONS

# A fault in making the seeds ends it, too.
ninja -C "$build" --quiet tests/fuzz/corpus $(for t in $targets; do echo "tests/fuzz/fuzz_${t%:*}"; done)

run() { # NAME LENGTH
    found=$here/tests/fuzz/found/$1
    [ -d "$found" ] || found=
    mkdir -p "$folder/grown/$1"
    "$build/tests/fuzz/fuzz_$1" -max_total_time="$each" -max_len="$2" -malloc_limit_mb=256 -rss_limit_mb=2048 \
        -timeout=5 -print_final_stats=1 -artifact_prefix="$folder/findings/$1-" \
        "$folder/grown/$1" "$build/tests/fuzz/corpus/$1" $found >"$folder/$1.log" 2>&1
}

failed=0
report() { # NAME PROCESS
    if wait "$2"; then
        result="no finding"
    else
        result="FOUND"
        failed=1
        tail -n 40 "$folder/$1.log"
    fi
    echo "fuzz_$1: $(sed -n 's/^stat::number_of_executed_units: *//p' "$folder/$1.log") executions, $result"
}
set -- $targets
while [ $# -gt 0 ]; do
    one=${1%:*}
    run "$one" "${1#*:}" &
    first=$!
    other=
    shift
    if [ $# -gt 0 ]; then
        other=${1%:*}
        run "$other" "${1#*:}" &
        second=$!
        shift
    fi
    report "$one" $first
    [ -z "$other" ] || report "$other" $second
done
ls "$folder/findings"
exit $failed
