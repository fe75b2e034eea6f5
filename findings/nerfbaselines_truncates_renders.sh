#!/usr/bin/env bash
# Package: nerfbaselines 1.2.12 (PyPI), whose evaluation turns renders into bytes by `image_to_srgb` (utils.py).
# Input: a photo with the levels 1 to 254, a render 0.9 of a level brighter, and one 0.1 of a level darker.
# Expected: bytes are rounded, as the comment in that function says ("Round to 8-bit for fair comparisons") and as
#   torchvision's save_image does in the evaluation of 3D-GS: the darker render is the photo, the brighter one a level off.
# Behaviour: bytes are truncated. The brighter render is the photo, and the darker one a whole level off: 48 dB. Any render
#   is measured half a level darker on average, which costs a model of 44 dB about half a decibel.
# Output seen:
#   0.9 of a level brighter: 0 levels off, PSNR inf dB
#   0.1 of a level darker: 1 levels off, PSNR 48.13 dB
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.2.6 pillow tqdm typing-extensions click
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps nerfbaselines==1.2.12
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys

import numpy as np
from nerfbaselines import metrics
from nerfbaselines.utils import convert_image_dtype, image_to_srgb

levels = np.arange(1, 255)
photo = np.tile(levels.astype(np.uint8), (3, 12, 1)).transpose(1, 2, 0)
found = []
for words, shift in (("0.9 of a level brighter", 0.9), ("0.1 of a level darker", -0.1)):
    render = ((photo + shift) / 255).astype(np.float32)
    stored = image_to_srgb(render, np.uint8, color_space="srgb")
    off = int(np.abs(stored.astype(int) - photo).max())
    pictures = (convert_image_dtype(picture, np.float32)[None] for picture in (stored, photo))
    level = float(metrics.psnr(*pictures)[0])
    print(f"{words}: {off} levels off, PSNR {level:.2f} dB")
    found.append((off, round(level, 2)))
sys.exit(found != [(0, float("inf")), (1, 48.13)])
PYTHON
