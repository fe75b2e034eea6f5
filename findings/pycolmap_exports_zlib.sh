#!/usr/bin/env bash
# Package: pycolmap 4.2.1 (PyPI, Linux x86_64), with `nm` and `readelf` of binutils.
# Input: none; the files of the wheel are looked at.
# Expected: a library that a wheel links in statically stays inside of it, and nothing in the wheel needs another copy.
# Behaviour: the extension exports the functions of its own zlib, and a library next to it needs the system's libz.
#   Which of both copies a call inside of the system's libz reaches then depends on who loaded that first. Mixed, the two
#   have ended a process here. Python's own zlib, imported before, keeps them apart.
# Output seen:
#   zlib functions that pycolmap exports: adler32 crc32 deflate deflateEnd deflateInit2_ inflate inflateEnd inflateInit2_
#   libraries of the wheel that need libz.so.1: libgfortran
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip download --quiet --no-deps --only-binary :all: --dest "$folder" pycolmap==4.2.1
python3 -m zipfile -e "$folder"/pycolmap-*.whl "$folder/wheel"
names='adler32|crc32|deflate|deflateEnd|deflateInit2_|inflate|inflateEnd|inflateInit2_'
exported=$(nm -D --defined-only "$folder"/wheel/pycolmap/_core*.so | awk '{print $3}' | grep -xE "$names" | sort | xargs)
needing=$(for file in "$folder"/wheel/pycolmap.libs/*.so*; do
    if readelf -d "$file" | grep -q 'NEEDED.*libz\.so'; then basename "$file" | sed 's/-.*//'; fi
done | xargs)
echo "zlib functions that pycolmap exports: $exported"
echo "libraries of the wheel that need libz.so.1: $needing"
[ "$exported" = "adler32 crc32 deflate deflateEnd deflateInit2_ inflate inflateEnd inflateInit2_" ] && [ "$needing" = libgfortran ]
