#!/usr/bin/env bash
# Package: mitsuba 3.9.1 (PyPI), variant scalar_rgb; the sensor `perspective`, by which scenes of known truth are made.
# Input: principal_point_offset_x = 0.1, and then principal_point_offset_y = 0.1, on a film of 64 x 48 px.
# Expected: the manual calls it the position of the principal point relative to the middle of the film. So the ray along
#   the optical axis leaves at cx = (0.5 + 0.1) 64 = 38.4, or at cy = (0.5 + 0.1) 48 = 28.8 (y runs downwards).
# Behaviour: it leaves as far on the other side, in both axes: c = (0.5 - offset) of the film. Cameras with the cx and
#   cy that the sign suggests see their pictures shifted by twice the offset. The unit is the film's width and height.
# Output seen:
#   no offset: the axis leaves at (32.00, 24.00)
#   x 0.1: the axis leaves at (25.60, 24.00)
#   y 0.1: the axis leaves at (32.00, 19.20)
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mitsuba==3.9.1 numpy==2.2.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mitsuba
import numpy as np

mitsuba.set_variant("scalar_rgb")
WIDTH, HEIGHT = 64, 48


def axis_pixel(**offsets):
    """Where the ray along the optical axis (z of a camera without a pose) leaves the film, in pixels."""
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    sensor = mitsuba.load_dict({"type": "perspective", "fov": 60, "film": film, **offsets})

    def slopes(x, y):
        ray, _ = sensor.sample_ray(0.0, 0.5, [x, y], [0.5, 0.5])
        direction = np.array(ray.d).ravel()
        return direction[:2] / direction[2]

    first, last = slopes(0, 0), slopes(1, 1)
    return -first / (last - first) * (WIDTH, HEIGHT)  # slopes of a pinhole are linear over the film


tries = {"no offset": {}, "x 0.1": {"principal_point_offset_x": 0.1}, "y 0.1": {"principal_point_offset_y": 0.1}}
recorded = [(32, 24), (0.4 * WIDTH, 24), (32, 0.4 * HEIGHT)]
places = [axis_pixel(**offsets) for offsets in tries.values()]
for name, (x, y) in zip(tries, places):
    print(f"{name}: the axis leaves at ({x:.2f}, {y:.2f})")
sys.exit(0 if np.allclose(places, recorded, atol=0.01) else 1)
PYTHON
