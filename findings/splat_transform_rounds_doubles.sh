#!/usr/bin/env bash
# Package: @playcanvas/splat-transform 3.7.0 (npm).
# Expected: x, y and z that a PLY of georeferenced splats stores as doubles keep their precision until the translation
#   on the command line (-t) has moved them near (0, 0, 0).
# Behaviour: they become float32 when they are read, before the translation, and nothing says so. Steps of 0.1 in z
#   become steps of 0.5, and the translation cannot bring them back.
# Output seen:
#   z of the file less 5400000: 0 0.1 0.2 0.3 0.4
#   after -t 0,0,-5400000:      0 0 0 0.5 0.5
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm init -y >/dev/null
npm install --silent --no-audit --no-fund --ignore-scripts @playcanvas/splat-transform@3.7.0 >/dev/null 2>&1
python3 - <<'PYTHON'
import struct

rest = ["f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
header = ["ply", "format binary_little_endian 1.0", "element vertex 5", *(f"property double {axis}" for axis in "xyz"),
          *(f"property float {name}" for name in rest), "end_header", ""]
rows = [struct.pack("<3d11f", 1, 2, 5400000 + i / 10, 0, 0, 0, 2, -3, -3, -3, 1, 0, 0, 0) for i in range(5)]
open("a.ply", "wb").write("\n".join(header).encode() + b"".join(rows))
PYTHON
node_modules/.bin/splat-transform a.ply -t 0,0,-5400000 b.ply 2>&1 | grep -iE "warn|precision|double" || true
python3 - <<'PYTHON'
import struct
import sys

content = open("b.ply", "rb").read()
head, body = content.split(b"end_header\n", 1)
lines = [line.split() for line in head.decode().splitlines()]
names = [words[2] for words in lines if words[0] == "property"]
assert all(words[1] == "float" for words in lines if words[0] == "property")
found = [row[names.index("z")] for row in struct.iter_unpack(f"<{len(names)}f", body)]
print("z of the file less 5400000:", *(f"{i / 10:g}" for i in range(5)))
print("after -t 0,0,-5400000:     ", *(f"{value:g}" for value in found))
sys.exit(0 if found == [0, 0, 0, 0.5, 0.5] else 1)
PYTHON
