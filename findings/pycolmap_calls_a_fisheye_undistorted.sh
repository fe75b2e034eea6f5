#!/usr/bin/env bash
# Package: pycolmap 4.2.1 (PyPI).
# Expected: a camera for which Camera.is_undistorted() is True maps rays like a pinhole.
# Behaviour: is_undistorted() looks at the distortion parameters alone. It is True for fisheye cameras, which bend every
#   picture: of an OPENCV_FISHEYE camera with k1 = k2 = k3 = k4 = 0 the ray at 45 degrees lies at f * pi / 4 from the
#   principal point and not at f. A program that decides by it whether to undistort photos trains on bent ones.
#   is_perspective_pinhole() distinguishes the two.
# Output seen:
#   OPENCV_FISHEYE: is_undistorted True, is_perspective_pinhole False, 45 degrees at 78.54 px, a pinhole has 100.00
#   THIN_PRISM_FISHEYE: is_undistorted True, is_perspective_pinhole False, 45 degrees at 78.54 px, a pinhole has 100.00
#   RAD_TAN_THIN_PRISM_FISHEYE: is_undistorted True, is_perspective_pinhole False, 45 degrees at 78.54 px, a pinhole has 100.00
#   undistort_camera: 200x160 becomes 308x203
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.2.6
"$folder/venv/bin/python" - <<'PYTHON'
import math
import sys

import numpy as np
import pycolmap

as_described = True
for model in ("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"):
    camera = pycolmap.Camera.create_from_model_name(1, model, 100.0, 200, 160)
    x = float(camera.img_from_cam(np.array([[1.0, 0.0, 1.0]]))[0, 0]) - 100
    print(
        f"{model}: is_undistorted {camera.is_undistorted()}, is_perspective_pinhole {camera.is_perspective_pinhole()}, "
        f"45 degrees at {x:.2f} px, a pinhole has 100.00"
    )
    as_described &= camera.is_undistorted() and not camera.is_perspective_pinhole()
    as_described &= abs(x - 100 * math.pi / 4) < 1e-9
pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
print(f"undistort_camera: 200x160 becomes {pinhole.width}x{pinhole.height}")
as_described &= (pinhole.width, pinhole.height) != (200, 160)
sys.exit(0 if as_described else 1)
PYTHON
