#!/usr/bin/env bash
# Package: pycolmap 4.2.1 (PyPI).
# Input: SIMPLE_RADIAL, f = 120 px, k = -0.25, a photo of 200 x 150 px. It maps a slope r to f r (1 - r^2 / 4), which
#   stops growing at r = 1.155, 92 px from the middle. Pixels farther out have no ray, and cam_from_img says so (NaN).
# Expected: undistort_camera, which leaves no blank pixels by default, stays within that, or refuses.
# Behaviour: it proposes 400 x 170 px, twice the photo's width. The outer columns show the photo again, mirrored. A
#   lens with k = -0.18, whose photo reaches past the fold in its corners only, is undistorted rightly.
# Output seen:
#   pixels without a ray: 19.2 %
#   k = -0.25: proposed 400 x 170, mirrored pixels 35.1 %
#   k = -0.18: proposed 244 x 162, mirrored pixels 0.0 %
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.2.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import numpy as np
import pycolmap


def pixel_centres(camera):
    grid = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack(grid, axis=-1)


def mirrored_share(lens):
    proposed = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    rays = (pixel_centres(proposed) - [proposed.principal_point_x, proposed.principal_point_y]) / 120
    seen = lens.img_from_cam(np.concatenate([rays, np.ones_like(rays[..., :1])], -1).reshape(-1, 3))
    seen = seen.reshape(rays.shape)
    across, down = np.diff(seen, axis=1)[:-1], np.diff(seen, axis=0)[:, :-1]
    area = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]
    return proposed, float((area < 0).mean())


shares = []
for k in (-0.25, -0.18):
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=200, height=150, params=[120, 100, 75, k])
    if k == -0.25:
        lost = ~np.isfinite(lens.cam_from_img(pixel_centres(lens).reshape(-1, 2))).all(1)
        print(f"pixels without a ray: {100 * lost.mean():.1f} %")
    proposed, share = mirrored_share(lens)
    print(f"k = {k}: proposed {proposed.width} x {proposed.height}, mirrored pixels {100 * share:.1f} %")
    shares.append(share)
sys.exit(0 if shares[0] > 0.3 and shares[1] == 0 else 1)
PYTHON
