#!/usr/bin/env bash
# Program: OpenSplat 1.1.5 (github.com/pierotofy/OpenSplat, 15b7e80), built for the CPU; OPENSPLAT=PROGRAM names it.
# Expected: its renders (--val-render) are those of the file that it writes, with Gaussians sorted by depth.
# Behaviour: rasterizer/gsplat-cpu/gsplat_cpu.cpp takes depths as a column of a matrix, and reads the pointer of that
#   view as if its values stood one after another: it sorts by x, y and z of other Gaussians. Programs that sort by
#   depth show its files otherwise than it trained them. `.contiguous()` after `pProj.index({"...", 2})` repairs it.
# Output seen:
#   OpenSplat's render against that of its file by gsx: 24.7 dB
#   sorted by another number than depth, as recorded
# Exit status 1: it behaves otherwise now.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
PYTHONPATH=benchmarks "${PYTHON:-.venv/bin/python}" - "$folder" "$OPENSPLAT" <<'PYTHON'
import sys
from pathlib import Path

import gsx
from gsx.builtin import plugins
from gsx.core.data.images import read_image
from gsx.core.quality.metrics import psnr
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from measuring.opensplat import file_of, run_opensplat, write_scene

SCENE = "scene=demo scene.width=128 scene.height=96 scene.train_views=10 scene.test_views=2 scene.points=1500"
BACKGROUND = (0.6130, 0.0101, 0.3984)  # OpenSplat's own, model.hpp
WORDS = ["--num-iters", "10", "--num-downscales", "0", "--val-image", "0003.png", "--val-render"]
folder, program = Path(sys.argv[1]), Path(sys.argv[2])
scene = load_scene(compose([*SCENE.split(), "scene.samples=1"], plugins()))
renders = folder / "renders"
place = folder / "model"
run_opensplat(program, write_scene(scene, folder / "scene"), place, [*WORDS, str(renders)], {}, folder / "log.txt")
render = gsx.load(file_of(place)).render(scene.train[2], BACKGROUND).clamp(0, 1)
difference = psnr(render, read_image(renders / "10.png").float() / 255)
print(f"OpenSplat's render against that of its file by gsx: {difference:.1f} dB")
if difference > 40:
    print("CHANGED: sorted by depth")
    sys.exit(1)
print("sorted by another number than depth, as recorded")
PYTHON
