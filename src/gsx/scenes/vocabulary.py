"""A visual vocabulary learnt from the photos themselves: COLMAP's index of similar photos without a download.

Source: Sivic and Zisserman 2003, "Video Google"; COLMAP adds Hamming embedding (Jegou et al. 2008) to the index.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gsx.core.shapes import Float

WORDS = 1024  # 99 % of the office's pairs that share 30 points are among 20 similar photos of each (measured)
SAMPLES = 50  # descriptors for each word
ROUNDS = 20  # of k-means
EMBEDDING = 64  # bits of Hamming embedding, COLMAP's default


def learn_vocabulary(database: Any, path: Path, seed: int) -> bool:
    """Learn visual words from the descriptors in an open pycolmap.Database and write them to `path`.

    One thread: words depend on the number of threads. Returns False, and writes nothing, if there are too few
    descriptors for words.
    """
    import pycolmap

    sample = sample_descriptors(database, WORDS * SAMPLES, np.random.default_rng(seed))
    if len(sample) < 2 * EMBEDDING:
        return False
    pycolmap.set_random_seed(seed)  # of this thread, for the Hamming embedding
    building = pycolmap.VisualIndex.BuildOptions()
    building.num_visual_words = min(WORDS, len(sample) // 2)
    building.num_iterations, building.num_rounds, building.num_threads = ROUNDS, 1, 1
    index = pycolmap.VisualIndex.create(sample.shape[1], EMBEDDING)
    with silent_stderr():  # faiss would prefer more descriptors for its lists of words
        index.build(building, pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, sample))
    index.write(path)
    return True


def sample_descriptors(database: Any, count: int, generator: np.random.Generator) -> Float[np.ndarray, "rows 128"]:
    """Return up to `count` descriptors (rows, 128) as float32, equally many of each photo if it has enough."""
    images = sorted(database.read_all_images(), key=lambda image: image.name)
    share = -(-count // max(1, len(images)))
    parts = []
    for image in images:
        if database.exists_descriptors(image.image_id):
            rows = database.read_descriptors(image.image_id).data
            parts.append(rows[np.sort(generator.permutation(len(rows))[:share])])
    return np.concatenate([np.empty((0, 128)), *parts])[:count].astype(np.float32)


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Discard what libraries print to file descriptor 2; there is no other switch for faiss."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
