#!/bin/sh
# Makes the page in a folder of its own, which needs nothing from elsewhere any more: CesiumJS comes from npm once.
#   examples/viewer/build.sh [FOLDER]    (default: dist beside this script)
# Then: talus serve SITE --viewer FOLDER
set -eu
here=$(cd "$(dirname "$0")" && pwd)
target=${1:-$here/dist}
command -v npm >/dev/null || { echo "npm is needed, once: apt-get install nodejs npm" >&2; exit 1; }
work=$(mktemp -d "${TMPDIR:-/tmp}/talus-viewer-XXXXXX")
trap 'rm -rf "$work"' EXIT
cp "$here/package.json" "$work/"
npm install --prefix "$work" --silent --no-fund --no-audit >&2
mkdir -p "$target"
rm -rf "$target/cesium"
cp -r "$work/node_modules/cesium/Build/Cesium" "$target/cesium"
cp "$here/index.html" "$here/viewer.js" "$here/viewer.css" "$target/"
echo "$target"
