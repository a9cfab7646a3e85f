#!/bin/sh
# Builds the Debian packages from a copy of the tree, lets lintian judge them (an error fails), and uses what is in them.
#   tests/judges/package.sh [FOLDER]    (default: build-package beside the sources; made anew)
# DEB_BUILD_OPTIONS=nocheck leaves out the tests within the build. Needs debhelper, lintian and debian/control's Build-Depends.
set -eu
here=$(cd "$(dirname "$0")/../.." && pwd)
folder=${1:-$here/build-package}
rm -rf "$folder"
mkdir -p "$folder/talus" "$folder/unpacked"
folder=$(cd "$folder" && pwd)
(cd "$here" && tar -c --exclude='./build*' --exclude='./.git' .) | tar -x -C "$folder/talus"

(cd "$folder/talus" && dpkg-buildpackage -us -uc -b) >"$folder/build.log" 2>&1 || {
    tail -n 40 "$folder/build.log"
    exit 1
}
lintian --fail-on error "$folder"/talus_*.changes

for package in "$folder"/talus_*.deb "$folder"/libtalus*.deb; do
    dpkg-deb -x "$package" "$folder/unpacked"
done
library=$(dirname "$(find "$folder/unpacked/usr/lib" -name 'libtalus.so.0')")
if readelf -d "$folder/unpacked/usr/bin/talus" | grep -E 'RPATH|RUNPATH'; then
    echo "the program tells the loader where to look, as nothing under /usr should"
    exit 1
fi
cd "$folder"
export LD_LIBRARY_PATH="$library"
"$folder/unpacked/usr/bin/talus" version
"$folder/unpacked/usr/bin/talus" synth "$here/examples/jacksboro.tif" --levels 1 -q -o program.raw
export PKG_CONFIG_PATH="$library/pkgconfig" PKG_CONFIG_SYSROOT_DIR="$folder/unpacked"
cc -o api_synth "$folder"/unpacked/usr/share/doc/libtalus-dev/examples/api_synth.c $(pkg-config --cflags --libs talus)
./api_synth "$here/examples/jacksboro.tif" library.raw 1
cmp program.raw library.raw
echo "packages: $(cd "$folder" && echo *.deb)"
