#!/bin/sh
# Makes the page in a folder of its own, which needs nothing from elsewhere any more: CesiumJS, three.js and
# 3d-tiles-renderer come from npm once.
#   examples/viewer/build.sh [FOLDER]    (default: dist beside this script)
# Then: talus serve SITE --viewer FOLDER
set -eu
here=$(cd "$(dirname "$0")" && pwd)
target=${1:-$here/dist}
command -v npm >/dev/null || { echo "npm is needed, once: apt-get install nodejs npm" >&2; exit 1; }
work=$(mktemp -d "${TMPDIR:-/tmp}/talus-viewer-XXXXXX")
trap 'rm -rf "$work"' EXIT
cp "$here/package.json" "$work/"
if [ -n "${TALUS_NPM:-}" ]; then # a folder whose modules are here already
    ln -s "$TALUS_NPM/node_modules" "$work/node_modules"
else
    npm install --prefix "$work" --silent --no-fund --no-audit >&2
fi
mkdir -p "$target"
rm -rf "$target/cesium" "$target/three" "$target/tiles"
modules=$work/node_modules
cp -r "$modules/cesium/Build/Cesium" "$target/cesium"
addons=$target/three/addons
mkdir -p "$addons/loaders" "$addons/utils" "$addons/libs" "$target/tiles"
cp "$modules"/three/build/three.module.js "$modules"/three/build/three.core.js "$target/three/"
cp "$modules/three/examples/jsm/loaders/GLTFLoader.js" "$addons/loaders/"
cp "$modules"/three/examples/jsm/utils/*.js "$addons/utils/"
cp "$modules/three/examples/jsm/libs/meshopt_decoder.module.js" "$addons/libs/"
cp "$modules"/3d-tiles-renderer/build/index.three.js "$modules"/3d-tiles-renderer/build/index.core-plugins.js \
    "$modules"/3d-tiles-renderer/build/renderer-*.js "$modules"/3d-tiles-renderer/build/plugins-*.js "$target/tiles/"
cp "$here"/*.html "$here/viewer.js" "$here/three.js" "$here/viewer.css" "$target/"
echo "$target"
