#!/bin/sh
# Installs what is missing, builds talus, and makes terrain from examples/jacksboro.tif.
#   examples/run.sh [FOLDER]    (default: build/example beside the sources)
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
. "$here/examples/packages.sh"
need_packages $build_packages

build=$here/build
out=${1:-$build/example}
[ -f "$build/build.ninja" ] || meson setup "$build" "$here" -Dtests=false
ninja -C "$build" --quiet
mkdir -p "$out"

talus=$build/cmd/talus
dem=$here/examples/jacksboro.tif
"$talus" synth "$dem" --levels 4 --seed 1 --overwrite -o "$out/terrain.exr"
"$talus" simplify "$dem" --max-error 5 --verify --overwrite -o "$out/mesh.glb"
"$talus" preview "$dem" --beside "$out/terrain.exr" --overwrite -o "$out/beside.png"
"$talus" preview "$out/terrain.exr" --perspective --overwrite -o "$out/perspective.png"

cat <<END

Done. In $out:
  terrain.exr      the terrain, 16 times finer than the DEM: a 32-bit heightfield in metres
  mesh.glb         the DEM as a mesh, no sample more than 5 m from it
  beside.png       the DEM and the terrain, side by side
  perspective.png  the terrain seen from the south

To try next:
  $talus info "$dem"
  $talus synth "$dem" --levels 3 --seed 2 -o other.tif     another seed, as a GeoTIFF
  $talus synth "$dem" --levels 2 -o terrain.glb            as a mesh for Blender
  $talus help synth
END
