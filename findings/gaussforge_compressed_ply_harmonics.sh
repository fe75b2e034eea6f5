#!/usr/bin/env bash
# Package: gaussforge 0.6.0 (PyPI).
# Expected: a PLY converted to compressed PLY and back keeps its harmonics to the step of the format (1/32).
# Behaviour: the converter writes the coefficients of the compressed file colour by colour within each coefficient (R
#   G B R G B ...), but reads them, as PlayCanvas does, all of red first. Harmonics of degrees 1 to 3 come back mixed.
# Output seen:
#   first bytes of 'sh': 144 128 112 144 128 112 (all of red first would be 144 144 144 144 144 144)
#   red coefficients 1 to 4: 0.5000 0.5000 0.5000 0.5000 -> 0.5156 0.0156 -0.4844 0.5156
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gaussforge==0.6.0
"$folder/venv/bin/python" - <<'PYTHON'
import struct
import sys

import gaussforge

names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45)), "opacity",
         "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
rest = [0.5] * 15 + [0.0] * 15 + [-0.5] * 15  # all of red, then green, then blue
splats = [[float(i), 0, 0, 0, 0, 0, 0, 0, 0, *rest, 2.0, -3, -3, -3, 1, 0, 0, 0] for i in range(3)]
header = ["ply", "format binary_little_endian 1.0", "element vertex 3", *(f"property float {name}" for name in names)]
ply = "\n".join([*header, "end_header", ""]).encode() + b"".join(struct.pack("<62f", *splat) for splat in splats)


def converted(content, source, target):
    result = gaussforge.GaussForge().convert(content, source, target)
    return bytes(result["data"] if isinstance(result, dict) else result)


compressed = converted(ply, "ply", "compressed.ply")
stored = compressed[-3 * 45:]
print("first bytes of 'sh':", *stored[:6], "(all of red first would be", *[144] * 6, end=")\n")
again = converted(compressed, "compressed.ply", "ply")
head, _, body = again.partition(b"end_header\n")
order = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property")]
row = dict(zip(order, struct.unpack_from(f"<{len(order)}f", body)))
found = [row[f"f_rest_{i}"] for i in range(4)]
print("red coefficients 1 to 4:", *(f"{value:.4f}" for value in rest[:4]), "->", *(f"{value:.4f}" for value in found))
mixed = abs(found[1] - rest[1]) > 0.1 and list(stored[:6]) == [144, 128, 112, 144, 128, 112]
sys.exit(0 if mixed else 1)
PYTHON
