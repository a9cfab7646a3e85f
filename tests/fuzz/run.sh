#!/bin/sh
# Fuzzes the readers for a while: builds the targets with clang, makes the corpus, runs both, one process each.
#   tests/fuzz/run.sh SECONDS [FOLDER]    (default: build-fuzz beside the sources)
# Prints the number of executions and, as files, what was found; exits 1 when there is a finding. The corpus grows in
# FOLDER/grown, so that the next run goes on where this one ended.
set -eu
seconds=${1:?how many seconds?}
here=$(cd "$(dirname "$0")/../.." && pwd)
folder=${2:-$here/build-fuzz}
mkdir -p "$folder/grown/raster" "$folder/grown/exr" "$folder/findings"

build=$folder/build
[ -f "$build/build.ninja" ] || CC=clang CXX=clang++ meson setup "$build" "$here" -Dfuzz=true \
    -Db_sanitize=address,undefined -Db_lundef=false -Dbuildtype=debugoptimized >"$folder/setup.log" 2>&1 || {
    cat "$folder/setup.log"
    exit 1
}
ninja -C "$build" --quiet tests/fuzz/fuzz_raster tests/fuzz/fuzz_exr tests/fuzz/corpus

# A small quarantine and short traces: three times as many executions. What a file may cost: 256 MB at once and 5 s.
ASAN_OPTIONS=quarantine_size_mb=16:malloc_context_size=6
UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1
export ASAN_OPTIONS UBSAN_OPTIONS

run() { # NAME LENGTH
    "$build/tests/fuzz/fuzz_$1" -max_total_time="$seconds" -max_len="$2" -malloc_limit_mb=256 -rss_limit_mb=2048 \
        -timeout=5 -print_final_stats=1 -artifact_prefix="$folder/findings/$1-" \
        "$folder/grown/$1" "$build/tests/fuzz/corpus/$1" "$here/tests/fuzz/found/$1" >"$folder/$1.log" 2>&1
}

run raster 2048 &
raster=$!
run exr 4096 &
exr=$!
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
report raster $raster
report exr $exr
ls "$folder/findings"
exit $failed
