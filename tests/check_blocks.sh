#!/bin/sh
# Programs that print the frameworks of the same rasters, built for blocks of different sizes: all print the same.
set -u
first=$("$1") || exit 1
[ "$(printf '%s\n' "$first" | wc -l)" -gt 50 ] || { echo "too few frameworks: $first"; exit 1; }
other=$("$2") || exit 1
[ "$first" = "$other" ] && { echo "[  PASSED  ] 1 test(s)."; exit 0; }
echo "frameworks differ by the size of blocks:"
printf '%s\n' "$first" >blocks-first.txt
printf '%s\n' "$other" | diff blocks-first.txt - | head -n 6
rm -f blocks-first.txt
exit 1
