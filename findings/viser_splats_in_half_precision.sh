#!/usr/bin/env bash
# Package: viser 1.1.1 (PyPI); `add_gaussian_splats`, whose handle's `buffer` holds what the browser draws.
# Input: covariances in 64 bits of three splats: a part of a sky, of size 300; a disc of 1 x 1 x 0.001, tilted by 30
#   degrees, as flat surfaces are made of; and a detail of 0.0001 units, a tenth of a millimetre in a scene of metres.
# Expected: the browser draws their sizes; centres go there in 32 bits, and point clouds have a choice of precision.
# Behaviour: covariances are rounded to 16 bits. They are squares: sizes from 256 overflow to infinity, those below
#   0.00017 become 0, and flat splats lose their thickness, for which the differences of large numbers are left. The
#   shader leaves out a splat whose covariance on the screen has a negative eigenvalue. No warning, no word in the docs.
# Output seen:
#   sky: standard deviations 300 300 300 -> inf inf inf
#   disc: 0.001 1 1 -> variance of its thickness 1e-06 -> -8.03e-05
#   detail: standard deviations 0.0001 0.0001 0.0001 -> 0 0 0
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check viser==1.1.1 numpy==2.2.6
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import contextlib
import io
import math
import sys

import numpy as np
import viser

cosine, sine = math.cos(math.radians(30)), math.sin(math.radians(30))
tilt = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
sizes = np.array([[300, 300, 300], [1, 1, 0.001], [1e-4, 1e-4, 1e-4]])
covariances = tilt @ (sizes[:, :, None] ** 2 * np.eye(3)) @ tilt.T
with contextlib.redirect_stdout(io.StringIO()):
    server = viser.ViserServer(host="127.0.0.1", port=18732, verbose=False)
    splats = server.scene.add_gaussian_splats(
        "splats",
        centers=np.zeros((3, 3)),
        covariances=covariances,
        rgbs=np.ones((3, 3)),
        opacities=np.ones((3, 1)),
    )
    server.stop()
sent = np.ascontiguousarray(splats.buffer[:, 4:7]).view(np.float16).astype(float)  # xx xy xz yy yz zz
full = sent[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3, 3)
sky, detail = np.sqrt(np.diagonal(full[0])), np.sqrt(np.diagonal(full[2]))
thickness = np.linalg.eigvalsh(full[1])[0]
print("sky: standard deviations 300 300 300 ->", *(f"{value:g}" for value in sky))
print(f"disc: 0.001 1 1 -> variance of its thickness 1e-06 -> {thickness:.2e}")
print("detail: standard deviations 0.0001 0.0001 0.0001 ->", *(f"{value:g}" for value in detail))
sys.exit(0 if np.isinf(sky).all() and not detail.any() and abs(thickness - 1e-6) > 1e-5 else 1)
PYTHON
