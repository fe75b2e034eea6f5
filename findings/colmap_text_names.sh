#!/usr/bin/env bash
# Package: pycolmap 4.2.1 (PyPI).
# Expected: a model that is written by Reconstruction.write_text and read again has the same images.
# Behaviour: the writer puts a name with spaces into images.txt as it is, the reader ends it at the first space,
#   without an error or a warning: two photos "SITE 1.jpg" and "SITE 2.jpg" become two images with the one name
#   "SITE". The binary format keeps both names. Lines of comments before them make no difference.
# Output seen:
#   binary ['SITE 1.jpg', 'SITE 2.jpg'] text ['SITE', 'SITE']
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pycolmap==4.2.1 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
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
