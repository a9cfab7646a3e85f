#!/bin/sh
# Every fault in every command (half an hour on two cores): builds talus and the injector, then fails each allocation and
# call of talus's own code, then the allocations of the libraries.
#   tests/faults/run.sh [FOLDER] [NAME...]    (default: build-faults beside the sources; all commands)
set -eu
here=$(cd "$(dirname "$0")/../.." && pwd)
folder=${1:-$here/build-faults}
[ $# -eq 0 ] || shift
[ -f "$folder/build.ninja" ] || meson setup "$folder" "$here" --buildtype=release >"$folder.log" 2>&1 || { cat "$folder.log"; exit 1; }
ninja -C "$folder" --quiet cmd/talus tests/inject.so
failed=0
"$here/tests/faults/faults.py" "$folder/cmd/talus" "$folder/tests/inject.so" --whole "$@" || failed=1
"$here/tests/faults/faults.py" "$folder/cmd/talus" "$folder/tests/inject.so" --scope-all "$@" || failed=1
exit $failed
