#!/usr/bin/env bash
# Package: nerfbaselines 1.2.12 (PyPI), `project` of nerfbaselines.cameras.
# Input: a pinhole camera with f = 100 px and 200 x 100 px, without a pose, and the corners of a cube around it.
# Expected: points behind the camera have no pixel: they become NaN, as pycolmap has it, or fall outside of the picture.
# Behaviour: each of them gets the principal point, the middle of the picture, and no mask comes along. A test of which
#   points a photo shows, by pixels within its size, counts every point behind the camera as seen, and takes the colour
#   of the middle for it. The docstring says nothing of it; the sign of z has to be tested before.
# Output seen:
#   (1, 0.5, 2): pixel (150, 75), by hand (150, 75)
#   (1, 0.5, -2): pixel (100, 50), by hand none
#   corners of the cube within the picture: 4 by their pixels, 0 by hand
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.2.6 pillow tqdm typing-extensions click
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps nerfbaselines==1.2.12
cd "$folder"
venv/bin/python -W ignore - <<'PYTHON'
import itertools
import sys

import numpy as np
from nerfbaselines import camera_model_to_int, new_cameras
from nerfbaselines.cameras import project

size = np.array([200, 100])
camera = new_cameras(
    poses=np.eye(4)[:3],
    intrinsics=np.array([100.0, 100.0, 100.0, 50.0]),
    camera_models=np.array(camera_model_to_int("pinhole"), dtype=np.int32),
    image_sizes=size.astype(np.int32),
    distortion_parameters=np.zeros(6),
    nears_fars=None,
)
front, behind = project(camera, np.array([[1, 0.5, 2], [1, 0.5, -2]]))
print("(1, 0.5, 2): pixel ({:.0f}, {:.0f}), by hand (150, 75)".format(*front))
print("(1, 0.5, -2): pixel ({:.0f}, {:.0f}), by hand none".format(*behind))

corners = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))
pixels = project(camera, corners)
within = int(((pixels >= 0) & (pixels < size)).all(axis=1).sum())
ahead = corners[corners[:, 2] > 0]
places = 100 * ahead[:, :2] / ahead[:, 2:] + [100, 50]
seen = int(((places >= 0) & (places < size)).all(axis=1).sum())
print(f"corners of the cube within the picture: {within} by their pixels, {seen} by hand")
sys.exit(0 if np.allclose(front, (150, 75)) and np.allclose(behind, (100, 50)) and (within, seen) == (4, 0) else 1)
PYTHON
