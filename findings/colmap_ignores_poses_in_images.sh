#!/usr/bin/env bash
# Package: pycolmap 4.2.1 (PyPI).
# Input: a model of COLMAP 4, which states each pose twice: in frames.bin with rigs.bin, and in images.bin for older
#   programs. A pose is changed in images.bin, as scripts for COLMAP 3 do it.
# Expected: both have to agree, or the reader warns.
# Behaviour: Reconstruction takes the pose of frames.bin and says nothing. Without frames.bin and rigs.bin the same
#   images.bin counts. Writing the model again restores the old pose in images.bin.
# Output seen:
#   images.bin moved by 7 units; read with frames.bin: moved by 0.0
#   read without frames.bin and rigs.bin: moved by 7.0
#   written again from the first: images.bin is as before the change: True
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pycolmap

work = Path(sys.argv[1])
pycolmap.set_random_seed(1)
options = pycolmap.SyntheticDatasetOptions()
options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 3, 20
made = pycolmap.synthesize_dataset(options)
folders = [work / name for name in ("original", "changed", "old", "again")]
for folder in folders:
    folder.mkdir()
original, changed, old, again = folders
made.write_binary(original)
before = pycolmap.Reconstruction(original)
shutil.copytree(original, changed, dirs_exist_ok=True)

# the first record: after the count of 8 bytes an id of 4, a quaternion of 32, and the translation
data = bytearray((changed / "images.bin").read_bytes())
(number,) = struct.unpack_from("<I", data, 8)
x, y, z = struct.unpack_from("<3d", data, 44)
struct.pack_into("<3d", data, 44, x + 7, y, z)
(changed / "images.bin").write_bytes(data)
for name in ("cameras", "images", "points3D"):
    shutil.copy(changed / f"{name}.bin", old)


def moved(folder):
    translations = [one.image(number).cam_from_world().translation for one in (pycolmap.Reconstruction(folder), before)]
    return float(np.linalg.norm(translations[0] - translations[1]))


print(f"images.bin moved by 7 units; read with frames.bin: moved by {moved(changed):.1f}")
print(f"read without frames.bin and rigs.bin: moved by {moved(old):.1f}")
pycolmap.Reconstruction(changed).write_binary(again)
restored = (again / "images.bin").read_bytes() == (original / "images.bin").read_bytes()
print(f"written again from the first: images.bin is as before the change: {restored}")
sys.exit(0 if moved(changed) == 0 and abs(moved(old) - 7) < 1e-9 and restored else 1)
PYTHON
