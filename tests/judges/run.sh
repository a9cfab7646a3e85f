#!/bin/sh
# Has every output format read by programs that are not ours, and compares what they find with what was written: GDAL and
# its validator of cloud-optimised files, OpenEXR's own tools, OpenImageIO, Blender, assimp, the glTF validator, gltfpack.
# Installs them where it may (Debian's packages as root, npm's in a folder of its own), and says which it did without.
#   tests/judges/run.sh [PROGRAM]    (default: built from these sources)
set -eu
here=$(cd "$(dirname "$0")/../.." && pwd)
. "$here/examples/packages.sh"
work=$(mktemp -d "${TMPDIR:-/tmp}/talus-judges-XXXXXX")
trap 'rm -rf "$work"' EXIT

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    packages="gdal-bin python3-gdal python3-numpy openexr openimageio-tools blender assimp-utils"
    packages="$packages parallel openmpi-bin slurm-wlm munge"
    command -v npm >/dev/null || packages="$packages nodejs npm"
    for package in $packages; do
        dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q '^install ok' ||
            apt-get install -y --no-install-recommends "$package" >"$work/apt.log" 2>&1 || echo "not installed: $package"
    done
fi
if command -v npm >/dev/null; then
    npm install --silent --no-fund --no-audit --prefix "$work/npm" gltf-validator gltfpack >"$work/npm.log" 2>&1 ||
        echo "not installed: gltf-validator, gltfpack"
fi

if [ $# -gt 0 ]; then
    program=$1
else
    need_packages $build_packages
    meson setup "$work/build" "$here" -Dtests=false >"$work/build.log" && ninja -C "$work/build" --quiet
    program=$work/build/cmd/talus
fi
status=0
TALUS_NPM=$work/npm/node_modules python3 "$here/tests/judges/formats.py" "$program" "$work" || status=1
# Pyramids of tiles in parts and after kills: GNU parallel, Open MPI, a Slurm of its own.
mkdir "$work/tiles"
python3 "$here/tests/judges/tiles.py" "$program" "$work/tiles" || status=1
# 3D Tiles, read by a reader of the judge's own and by the glTF validator.
python3 "$here/tests/judges/tiles3d.py" "$program" "$work/tiles3d" "$work/npm" || status=1
exit $status
