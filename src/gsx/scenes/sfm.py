"""Structure from motion with pycolmap, in process and on the CPU.

Features, matches and the incremental reconstruction are COLMAP's. What is set here is what makes two runs agree:
numbers of photos are given out before threads start, every estimator has a seed, and one thread does the mapping.

How far a stage is, is read from COLMAP's database through pycolmap only: Python's sqlite3 would be a second SQLite
library in the process, and each of the two drops the other's file locks.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from gsx.core.errors import InputError
from gsx.core.ranges import Count, Range
from gsx.scenes.exif import lens_of

logger = logging.getLogger(__name__)

T = TypeVar("T")
Sizes = Mapping[str, tuple[int, int]]
"""(width, height) by name of photo, relative to their folder."""

LOG_SECONDS = 10.0  # between progress lines
PAIR_BLOCK = 10  # photos whose pairs COLMAP matches before writing them down, which is when progress shows


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """Options that decide about a reconstruction; values and sources in `conf/scene/photos.yaml`."""

    matcher: str
    """auto | exhaustive (every pair) | sequential (neighbours in order of name: video frames, walks)."""
    exhaustive_limit: Count
    """`auto` matches every pair of up to this many photos, neighbours of more."""
    overlap: Annotated[int, Range(1, 1000)]
    """`sequential` matches photos at the distances 1, 2, 4, ... 2^(overlap - 1) in the sorted list."""
    max_feature_size: Annotated[int, Range(16, 1 << 16)]
    """Features are found on photos reduced to this many pixels on the longer side; training is not affected."""
    max_features: Annotated[int, Range(1, 10**6)]
    """Features kept of each photo."""
    camera_mode: str
    """auto (photos of one size, by one lens at one focal length as EXIF tells, share a camera) | single (all share one)
    | per_image."""
    camera_model: str
    """COLMAP's name of the lens model to estimate."""
    num_threads: Annotated[int, Range(-1, 4096)]
    """For features and matches, which do not depend on it; 0: all cores."""
    mapping_threads: Annotated[int, Range(-1, 4096)]
    """For the reconstruction, which is the same bit for bit only with 1; 0: all cores."""
    seed: Annotated[int, Range(0, 2**31 - 1)]


def reconstruct(folder: Path, sizes: Sizes, options: SfmOptions, work: Path) -> Any:
    """Return the largest pycolmap.Reconstruction of the photos in `folder`, None if there is none.

    `work` is an empty folder for intermediate files. InputError: one camera is to take photos of several sizes.
    """
    database, sparse = work / "database.db", work / "sparse"
    sparse.mkdir()
    with quiet():
        import_photos(database, folder, sizes, options)
        _extract(database, folder, sizes, options)
        _match(database, len(sizes), options)
        models = _map(database, folder, sparse, len(sizes), options)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def import_photos(database: Path, folder: Path, sizes: Sizes, options: SfmOptions) -> None:
    """Number the photos in order of name and decide which of them share a camera."""
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
    if camera_mode == "auto":
        return _alike({name: (size, lens_of(folder / name)) for name, size in sizes.items()})
    groups = _alike(sizes)
    if len(groups) > 1:
        found = ", ".join("{}x{} ({})".format(*sizes[group[0]], group[0]) for group in groups)
        raise InputError(f"One camera cannot take photos of several sizes, {found}: use scene.camera_mode=auto.")
    return groups


def _alike(kinds: Mapping[str, Any]) -> list[list[str]]:
    """Return sorted names of each kind, in the order of the kinds."""
    return [sorted(name for name in kinds if kinds[name] == kind) for kind in sorted(set(kinds.values()))]


def _extract(database: Path, folder: Path, sizes: Sizes, options: SfmOptions) -> None:
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options.max_feature_size
    extraction.num_threads = options.num_threads or -1
    extraction.use_gpu = False
    extraction.sift.max_num_features = options.max_features

    def work(token: Any) -> None:
        pycolmap.extract_features(
            database,
            folder,
            image_names=sorted(sizes),
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        )

    with pycolmap.Database.open(database) as reader:
        numbers = [image.image_id for image in reader.read_all_images()]
        watched("features of photos", work, lambda: sum(map(reader.exists_keypoints, numbers)), len(sizes))


def chosen_matcher(count: int, options: SfmOptions) -> str:
    """Return the matcher for a number of photos, for `auto` as well."""
    if options.matcher != "auto":
        return options.matcher
    return "exhaustive" if count <= options.exhaustive_limit else "sequential"


def pair_count(count: int, options: SfmOptions) -> int:
    """Return how many pairs of photos are matched."""
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
    match: Callable[..., None] = getattr(pycolmap, f"match_{matcher}")

    def work(token: Any) -> None:
        match(
            database,
            matching_options=matching,
            pairing_options=pairing_options(matcher, options.overlap),
            verification_options=verification,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        )

    with pycolmap.Database.open(database) as reader:
        watched("matches of pairs", work, reader.num_matched_image_pairs, pair_count(count, options))


def pairing_options(matcher: str, overlap: int) -> Any:
    """Return pycolmap's options for which pairs to match."""
    import pycolmap

    if matcher == "exhaustive":
        every = pycolmap.ExhaustivePairingOptions()
        every.block_size = PAIR_BLOCK
        return every
    neighbours = pycolmap.SequentialPairingOptions()
    neighbours.overlap = overlap
    neighbours.loop_detection = False  # it would need a vocabulary tree, which COLMAP downloads
    return neighbours


def _map(database: Path, folder: Path, sparse: Path, count: int, options: SfmOptions) -> dict[int, Any]:
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads = pipeline.mapper.num_threads = options.mapping_threads or -1
    pipeline.random_seed = pipeline.mapper.random_seed = pipeline.triangulation.random_seed = options.seed
    placed: list[None] = []

    def work(token: Any) -> dict[int, Any]:
        pycolmap.set_random_seed(options.seed)  # of this thread
        return pycolmap.incremental_mapping(
            database,
            folder,
            sparse,
            pipeline,
            initial_image_pair_callback=lambda: placed.extend([None, None]),
            next_image_callback=lambda: placed.append(None),
            cancellation_token=token,
        )

    return watched("placing photos", work, lambda: len(placed), count)


def watched(stage: str, work: Callable[[Any], T], done: Callable[[], int], total: int) -> T:
    """Run `work` in a thread and log how far it is; an interruption (Ctrl-C) cancels it."""
    import pycolmap

    started, token = time.monotonic(), pycolmap.CancellationToken()
    with ThreadPoolExecutor(max_workers=1) as pool:
        future = pool.submit(work, token)
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
    """Keep COLMAP's own log off the terminal: progress is logged here, errors are raised, lost photos are named."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
