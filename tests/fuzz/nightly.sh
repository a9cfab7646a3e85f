#!/bin/sh
# Forty minutes of fuzzing, ten for each target, for a nightly run.
#   tests/fuzz/nightly.sh [FOLDER]
exec "$(dirname "$0")/run.sh" 2400 "$@"
