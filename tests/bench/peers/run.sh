#!/bin/sh
# All comparisons with peers, as the tables of doc/accuracy.md: meshes, amplification, noise.
#   tests/bench/peers/run.sh TALUS DEM FOLDER     (FOLDER is for npm's packages, fetched where they are missing)
# Debian's nodejs, npm, gdal-bin, libnoise-dev, g++ and python3-numpy are needed, and some ten minutes. No test runs this.
set -eu
here=$(dirname "$0")
talus=${1:?which program?} dem=${2:?which DEM?} folder=${3:?where may packages go?}
install=
[ -d "$folder/node_modules/delatin" ] || install=--install
"$here/meshes.py" "$talus" "$dem" "$folder" $install
echo
"$here/resampling.py" "$talus" "$dem"
echo
"$here/noise.py" "$talus"
