#!/usr/bin/env bash
# Package: @playcanvas/splat-transform 3.7.0 (npm).
# Expected: COLOR_0 of a GLB, which viewers without KHR_gaussian_splatting draw as points, is linear, as glTF has it.
#   The extension says so: for srgb_rec709_display the colours are to be decoded from sRGB to linear.
# Behaviour: the bytes are those of sRGB, not decoded. Points come out too bright: 0.50 is drawn as 0.74.
# Output seen:
#   COLOR_0 of a splat of sRGB 0.782 0.500 0.218: 199 128 56 (linear would be 146 55 10)
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm init -y >/dev/null
npm install --silent --no-audit --no-fund --ignore-scripts @playcanvas/splat-transform@3.7.0 >/dev/null 2>&1
python3 - <<'PYTHON'
import struct

names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
         "rot_0", "rot_1", "rot_2", "rot_3"]
header = ["ply", "format binary_little_endian 1.0", "element vertex 1", *(f"property float {name}" for name in names)]
row = struct.pack("<14f", 1, 2, 3, 1, 0, -1, 2, -3, -3, -3, 1, 0, 0, 0)
open("a.ply", "wb").write("\n".join([*header, "end_header", ""]).encode() + row)
PYTHON
node_modules/.bin/splat-transform --quiet a.ply a.glb
python3 - <<'PYTHON'
import json
import struct
import sys

content = open("a.glb", "rb").read()
size = struct.unpack_from("<I", content, 12)[0]
document, body = json.loads(content[20 : 20 + size]), content[28 + size :]
primitive = document["meshes"][0]["primitives"][0]
space = primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"]
view = document["bufferViews"][document["accessors"][primitive["attributes"]["COLOR_0"]]["bufferView"]]
stored = list(body[view.get("byteOffset", 0) :][:3])
shown = [0.5 + 0.28209479177387814 * coefficient for coefficient in (1, 0, -1)]
linear = [round(255 * ((value + 0.055) / 1.055) ** 2.4) for value in shown]
print("COLOR_0 of a splat of sRGB", *(f"{value:.3f}" for value in shown), end=": ")
print(*stored, "(linear would be", *linear, end=")\n")
sys.exit(0 if space == "srgb_rec709_display" and stored == [199, 128, 56] else 1)
PYTHON
