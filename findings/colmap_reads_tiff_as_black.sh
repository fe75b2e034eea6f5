#!/usr/bin/env bash
# Package: pycolmap 4.2.1 (PyPI, wheel for Linux).
# Input: TIFF photos, plain RGB of 8 bits, with a compression that its libtiff was built without.
# Expected: such a photo is refused, as a damaged one is: Bitmap.read returns None for what it cannot read.
# Behaviour: for Zstandard, WebP and JPEG XL inside of TIFF it returns a picture of the right size that is black
#   everywhere. Feature extraction then finds nothing in these photos, and reports no error.
# Output seen:
#   mean value of the picture: 130.1
#       None: pycolmap reads a mean of 130.1
#        lzw: pycolmap reads a mean of 130.1
#       lzma: pycolmap reads a mean of 130.1
#       zstd: pycolmap reads a mean of 0.0
#       webp: pycolmap reads a mean of 0.0
#     jpegxl: pycolmap reads a mean of 0.0
#   features found: {'lzw.tif': 626, 'zstd.tif': 0}
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    pycolmap==4.2.1 tifffile==2026.3.3 imagecodecs==2026.3.6 numpy==2.2.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import numpy as np
import pycolmap
import tifffile

pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
blocks = np.random.default_rng(0).integers(0, 256, (24, 32, 3))
picture = np.kron(blocks, np.ones((10, 10, 1))).astype(np.uint8)
means, names = {}, {}
for compression in (None, "lzw", "lzma", "zstd", "webp", "jpegxl"):
    names[compression] = f"{compression}.tif"
    tifffile.imwrite(names[compression], picture, photometric="rgb", compression=compression)
    assert np.abs(tifffile.imread(names[compression]).astype(int) - picture).mean() < 3
    bitmap = pycolmap.Bitmap.read(names[compression], True)
    means[compression] = None if bitmap is None else float(bitmap.to_array().mean())
print("mean value of the picture:", round(float(picture.mean()), 1))
for compression, mean in means.items():
    print(f"{compression!s:>8}: pycolmap reads", "nothing" if mean is None else f"a mean of {mean:.1f}")

options = pycolmap.FeatureExtractionOptions()
options.use_gpu = False
pycolmap.Database.open("database.db").close()
used = [names["lzw"], names["zstd"]]
pycolmap.import_images("database.db", ".", image_names=used)
pycolmap.extract_features("database.db", ".", image_names=used, extraction_options=options)
with pycolmap.Database.open("database.db") as database:
    found = {image.name: len(database.read_keypoints(image.image_id)) for image in database.read_all_images()}
print("features found:", found)
black = all(means[one] == 0.0 for one in ("zstd", "webp", "jpegxl"))
decoded = all(abs(means[one] - picture.mean()) < 1 for one in (None, "lzw", "lzma"))
sys.exit(0 if black and decoded and found[names["zstd"]] == 0 < found[names["lzw"]] else 1)
PYTHON
