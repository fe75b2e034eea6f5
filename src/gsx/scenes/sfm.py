"""Structure from motion with pycolmap, in process and on the CPU.

Features, matches and the incremental reconstruction are COLMAP's. Two runs agree because photos are numbered before
threads start, every estimator has a seed, and one thread does the mapping.

Progress is read from COLMAP's database through pycolmap only: Python's sqlite3 would be a second SQLite library in the
process, and each of the two drops the other's file locks.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from gsx.core.errors import InputError
from gsx.core.ranges import Count, Range
from gsx.scenes.exif import lens_of

logger = logging.getLogger(__name__)

Sizes = Mapping[str, tuple[int, int]]
"""(width, height) by name of photo, relative to their folder."""

LOG_SECONDS = 10.0  # between progress lines
PAIR_BLOCK = 10  # photos whose pairs COLMAP matches before it writes them down: steps of progress


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """Options of a reconstruction; values and sources in `conf/scene/photos.yaml`."""

    matcher: str
    """auto | exhaustive (every pair) | sequential (neighbours in order of name: video frames, walks)."""
    exhaustive_limit: Count
    """Number of photos up to which `auto` matches every pair; of more it matches neighbours."""
    overlap: Annotated[int, Range(1, 1000)]
    """`sequential` matches photos at the distances 1, 2, 4, ... 2^(overlap - 1) in the sorted list."""
    max_feature_size: Annotated[int, Range(16, 1 << 16)]
    """Longer side of the reduced photos on which features are found, px; training is not affected."""
    max_features: Annotated[int, Range(1, 10**6)]
    """Features kept of each photo."""
    camera_mode: str
    """auto (photos of one size by one lens at one focal length, by EXIF, share a camera) | single | per_image."""
    camera_model: str
    """COLMAP's name of the lens model to estimate."""
    num_threads: Annotated[int, Range(-1, 4096)]
    """Threads for features and matches, which do not depend on it; 0: all cores."""
    mapping_threads: Annotated[int, Range(-1, 4096)]
    """Threads for the reconstruction, which is the same bit for bit only with 1; 0: all cores."""
    seed: Annotated[int, Range(0, 2**31 - 1)]


def reconstruct(folder: Path, sizes: Sizes, options: SfmOptions, work: Path) -> Any:
    """Return the largest pycolmap.Reconstruction of the photos in `folder`, None if there is none.

    `work` is an empty folder for intermediate files. InputError: one camera would have photos of several sizes.
    """
    database = work / "database.db"
    with quiet():
        import_photos(database, folder, sizes, options)
        _extract(database, folder, sizes, options)
        _match(database, len(sizes), options)
        models = _map(database, folder, work / "sparse", len(sizes), options)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def import_photos(database: Path, folder: Path, sizes: Sizes, options: SfmOptions) -> None:
    """Number the photos in order of name, and group those that share a camera."""
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = options.camera_model
    shared = options.camera_mode != "per_image"
    mode = pycolmap.CameraMode.SINGLE if shared else pycolmap.CameraMode.PER_IMAGE
    pycolmap.Database.open(database).close()
    for names in _camera_groups(folder, sizes, options.camera_mode):
        pycolmap.import_images(database, folder, camera_mode=mode, image_names=names, options=reader)


def _camera_groups(folder: Path, sizes: Sizes, camera_mode: str) -> list[list[str]]:
    """Return names of photos that share a camera; `auto` compares the lenses of those of one size."""
    if camera_mode == "per_image":
        return [sorted(sizes)]
    kinds: dict[str, Any] = dict(sizes)
    if camera_mode == "auto":
        kinds = {name: (size, lens_of(folder / name)) for name, size in sizes.items()}
    groups = [sorted(name for name in kinds if kinds[name] == kind) for kind in sorted(set(kinds.values()))]
    if camera_mode == "single" and len(groups) > 1:
        found = ", ".join("{}x{} ({})".format(*sizes[group[0]], group[0]) for group in groups)
        raise InputError(f"One camera cannot take photos of several sizes, {found}: use scene.camera_mode=auto.")
    return groups


def _extract(database: Path, folder: Path, sizes: Sizes, options: SfmOptions) -> None:
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options.max_feature_size
    extraction.num_threads = options.num_threads or -1
    extraction.use_gpu = False
    extraction.sift.max_num_features = options.max_features
    extract = partial(
        pycolmap.extract_features,
        database,
        folder,
        image_names=sorted(sizes),
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    with pycolmap.Database.open(database) as reader:
        numbers = [image.image_id for image in reader.read_all_images()]
        run_stage("features of photos", extract, lambda: sum(map(reader.exists_keypoints, numbers)), len(sizes))


def chosen_matcher(count: int, options: SfmOptions) -> str:
    """Return the matcher for a number of photos."""
    if options.matcher != "auto":
        return options.matcher
    return "exhaustive" if count <= options.exhaustive_limit else "sequential"


def pair_count(count: int, options: SfmOptions) -> int:
    """Return the number of pairs of photos to match."""
    if chosen_matcher(count, options) == "exhaustive":
        return count * (count - 1) // 2
    return sum(max(0, count - 2**k) for k in range(options.overlap))


def _match(database: Path, count: int, options: SfmOptions) -> None:
    import pycolmap

    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads = options.num_threads or -1
    matching.use_gpu = False
    verification.ransac.random_seed = options.seed
    matcher = chosen_matcher(count, options)
    match = partial(
        getattr(pycolmap, f"match_{matcher}"),
        database,
        matching_options=matching,
        pairing_options=pairing_options(matcher, options.overlap),
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    with pycolmap.Database.open(database) as reader:
        run_stage("matches of pairs", match, reader.num_matched_image_pairs, pair_count(count, options))


def pairing_options(matcher: str, overlap: int) -> Any:
    """Return pycolmap's options that choose the pairs to match."""
    import pycolmap

    if matcher == "exhaustive":
        every = pycolmap.ExhaustivePairingOptions()
        every.block_size = PAIR_BLOCK
        return every
    neighbours = pycolmap.SequentialPairingOptions()
    neighbours.overlap = overlap
    neighbours.loop_detection = False  # it would need a vocabulary tree, which COLMAP downloads
    return neighbours


def _map(database: Path, folder: Path, sparse: Path, count: int, options: SfmOptions) -> Any:
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads = pipeline.mapper.num_threads = options.mapping_threads or -1
    pipeline.random_seed = pipeline.mapper.random_seed = pipeline.triangulation.random_seed = options.seed
    placed: list[None] = []
    sparse.mkdir()

    def reconstruct(cancellation_token: Any) -> dict[int, Any]:
        pycolmap.set_random_seed(options.seed)  # of this thread
        return pycolmap.incremental_mapping(
            database,
            folder,
            sparse,
            pipeline,
            initial_image_pair_callback=lambda: placed.extend([None, None]),
            next_image_callback=lambda: placed.append(None),
            cancellation_token=cancellation_token,
        )

    return run_stage("placing photos", reconstruct, lambda: len(placed), count)


def run_stage(stage: str, work: Callable[..., Any], done: Callable[[], int], total: int) -> Any:
    """Run `work(cancellation_token=...)` in a thread and log its progress; an interruption (Ctrl-C) cancels it."""
    import pycolmap

    started, token = time.monotonic(), pycolmap.CancellationToken()
    with ThreadPoolExecutor(max_workers=1) as pool:
        future = pool.submit(work, cancellation_token=token)
        try:
            while not wait([future], timeout=LOG_SECONDS).done:
                logger.info("sfm: %s %d/%d, %.0f s", stage, done(), total, time.monotonic() - started)
        except BaseException:
            token.cancel()
            raise
    logger.info("sfm: %s done (%d) in %.1f s", stage, done(), time.monotonic() - started)
    return future.result()


@contextmanager
def quiet() -> Iterator[None]:
    """Silence COLMAP's own log: progress is logged here, and errors are raised."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
