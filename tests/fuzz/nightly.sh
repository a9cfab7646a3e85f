#!/bin/sh
# Ten minutes of fuzzing, for a nightly run.
#   tests/fuzz/nightly.sh [FOLDER]
exec "$(dirname "$0")/run.sh" 600 "$@"
