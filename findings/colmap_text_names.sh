#!/bin/bash
# pycolmap 4.2.1: names of images do not survive COLMAP's own text format.
# Guess: a model that is written by Reconstruction.write_text and read again has the same images.
# Seen: the writer puts a name with spaces into images.txt as it is, the reader ends it at the first space, without an
#   error or a warning: two photos "SITE 1.jpg" and "SITE 2.jpg" become two images with the one name "SITE". The binary
#   format keeps both names. Lines of comments before them make no difference.
# Output seen: binary ['SITE 1.jpg', 'SITE 2.jpg'] text ['SITE', 'SITE']
# Prints what it sees and exits 1 if that changes.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check pycolmap==4.2.1 numpy
"$work/venv/bin/python" - "$work" <<'PYTHON'
import sys
from pathlib import Path

import pycolmap

options = pycolmap.SyntheticDatasetOptions()
options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 2
options.num_points3D = 20
model = pycolmap.synthesize_dataset(options)
for number, image in enumerate(model.images.values(), 1):
    image.name = f"SITE {number}.jpg"
names = {}
for kind, write in (("binary", model.write_binary), ("text", model.write_text)):
    folder = Path(sys.argv[1]) / kind
    folder.mkdir()
    write(folder)
    names[kind] = sorted(image.name for image in pycolmap.Reconstruction(folder).images.values())
print("binary", names["binary"], "text", names["text"])
assert "SITE 1.jpg" in (Path(sys.argv[1]) / "text" / "images.txt").read_text()
sys.exit(names != {"binary": ["SITE 1.jpg", "SITE 2.jpg"], "text": ["SITE", "SITE"]})
PYTHON
