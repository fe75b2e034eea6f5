#!/usr/bin/env bash
# Package: pycolmap 4.2.1 (PyPI).
# Expected: VisualIndex.query, which finds the indexed images most similar to given descriptors, fills the list of
#   ImageScore that it takes as its last argument, as the C++ function does.
# Behaviour: the binding copies the list into a C++ vector, fills that, and drops it. The caller's list keeps its length
#   and its values, the return value is None, and no error says so. So an index that Python builds answers no query from
#   Python: pycolmap.match_vocabtree, which queries in C++, is the only way to its results.
# Output seen:
#   4 images in the index
#   an empty list after the query: [], returned None
#   a list of one score after the query: image -1, score 0.0
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.2.6
"$folder/venv/bin/python" - 2> /dev/null <<'PYTHON'
import sys

import numpy as np
import pycolmap


def descriptors(*images: int) -> pycolmap.FeatureDescriptorsFloat:
    """Return 400 made-up descriptors for each image."""
    rows = [np.abs(np.random.default_rng(image).normal(size=(400, 128))) * 50 for image in images]
    values = np.concatenate(rows).astype(np.float32)
    return pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, values)


building = pycolmap.VisualIndex.BuildOptions()
building.num_visual_words, building.num_threads = 32, 1
index = pycolmap.VisualIndex.create(128, 64)
index.build(building, descriptors(1, 2, 3, 4))
for image in (1, 2, 3, 4):
    keypoints = [pycolmap.FeatureKeypoint() for _ in range(400)]
    index.add(pycolmap.VisualIndex.IndexOptions(), image, keypoints, descriptors(image))
index.prepare()
print(f"{index.num_images()} images in the index")
empty, one = [], [pycolmap.ImageScore()]
returned = index.query(pycolmap.VisualIndex.QueryOptions(), descriptors(1), empty)
print(f"an empty list after the query: {empty}, returned {returned}")
index.query(pycolmap.VisualIndex.QueryOptions(), descriptors(1), one)
print(f"a list of one score after the query: image {one[0].image_id}, score {one[0].score}")
as_described = empty == [] and returned is None and one[0].score == 0 and index.num_images() == 4
sys.exit(0 if as_described else 1)
PYTHON
