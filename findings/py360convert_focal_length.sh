#!/usr/bin/env bash
# Package: py360convert 1.0.4 (PyPI), which cuts pinhole pictures out of panoramas, for COLMAP and splats among others.
# Input: a panorama whose pixels hold the direction that they look in; so each pixel of a cut tells its ray.
# Expected: a cut of N pixels and 90 degrees (e2p), or a face of its cube (e2c), is that of a camera with
#   f = N / 2: the outer edges of the picture lie 45 degrees to the sides, and the six faces meet without overlap.
# Behaviour: the centres of the outer pixels lie there, which makes f = (N - 1) / 2. A camera with the guessed f is
#   half a pixel off at the borders, and neighbouring faces share a column. It is the same at other angles. The README
#   and the docstrings say nothing of it. The panorama itself is read with its pixels' centres half a pixel inside.
# Output seen:
#   e2p, 64 px, 90 degrees: f = 31.50 (guessed 32.00), first pixel at -45.00 degrees (guessed -44.55)
#   e2c, 64 px, 90 degrees: f = 31.50 (guessed 32.00), first pixel at -45.00 degrees (guessed -44.55)
#   e2p, 64 px, 120 degrees: f = 18.19 (guessed 18.48), first pixel at -60.00 degrees (guessed -59.61)
#   last column of the front face less the first of the right one: 0.0000
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check py360convert==1.0.4 numpy==2.2.6 scipy==1.17.1
"$folder/venv/bin/python" - <<'PYTHON'
import math
import sys

import numpy as np
import py360convert

SIZE = 64
height, width = 1024, 2048
longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * math.pi
latitude = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * math.pi
ray = (np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude, np.cos(latitude) * np.cos(longitude))
panorama = np.stack(ray, axis=-1).astype(np.float32)
faces = py360convert.e2c(panorama, SIZE, cube_format="dict")
cuts = {
    ("e2p", 90): py360convert.e2p(panorama, 90, 0, 0, (SIZE, SIZE)),
    ("e2c", 90): faces["F"],
    ("e2p", 120): py360convert.e2p(panorama, 120, 0, 0, (SIZE, SIZE)),
}
right = True
for (name, degrees), cut in cuts.items():
    slopes = (cut[..., 0] / cut[..., 2]).mean(axis=0)
    focal, middle = np.polyfit(slopes, np.arange(SIZE) + 0.5, 1)
    guessed = SIZE / 2 / math.tan(math.radians(degrees / 2))
    first, corner = (math.degrees(math.atan(slope)) for slope in (slopes[0], (0.5 - SIZE / 2) / guessed))
    print(f"{name}, {SIZE} px, {degrees} degrees: f = {focal:.2f} (guessed {guessed:.2f}),", end=" ")
    print(f"first pixel at {first:.2f} degrees (guessed {corner:.2f})")
    right &= abs(focal - guessed * (SIZE - 1) / SIZE) < 0.002 and abs(middle - SIZE / 2) < 0.002
shared = np.abs(faces["F"][:, -1] - faces["R"][:, 0]).max()
print(f"last column of the front face less the first of the right one: {shared:.4f}")
sys.exit(0 if right and shared < 1e-4 else 1)
PYTHON
