"""Structure from motion with pycolmap, in process and on the CPU.

Features, matches and the incremental reconstruction are COLMAP's. Two runs agree because photos are numbered before
threads start, every estimator has a seed, and one thread does the mapping.

Progress is read from COLMAP's database through pycolmap only: Python's sqlite3 would be a second SQLite library in the
process, and each of the two drops the other's file locks.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import count as count_from
from pathlib import Path
from typing import Annotated, Any

from gsx.core.errors import InputError
from gsx.core.ranges import Count, Range
from gsx.scenes.exif import lens_of
from gsx.scenes.vocabulary import learn_vocabulary

logger = logging.getLogger(__name__)

Sizes = Mapping[str, tuple[int, int]]
"""(width, height) by name of photo, relative to their folder."""

LOG_SECONDS = 10.0  # between progress lines
FEWEST_INLIERS = 15  # COLMAP: 30; places 3 more of a walk's 300 photos, by 1.2 to 1.6 % of its extent (measured)
INDEXED = 1000  # largest features of each photo by which similar ones are retrieved
COLMAP_MATCHERS = {
    "exhaustive": "exhaustive", "sequential": "sequential", "near": "sequential", "similar": "vocabtree",
}  # fmt: skip
UNUSED = {
    "exhaustive": ("similar", "near", "retry_pairs"), "sequential": ("similar", "near"), "retrieval": ("overlap",),
}  # fmt: skip
"""Options without effect, by matcher."""
STAGES = dict.fromkeys(("exhaustive", "sequential"), "matches of pairs") | {
    "near": "matches of neighbours by name", "similar": "matches of similar photos",
}  # fmt: skip
PAIR_BLOCK = 10  # photos whose pairs COLMAP matches before it writes them down: steps of progress


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """Options of a reconstruction; values and sources in `conf/scene/photos.yaml`."""

    matcher: str
    """auto | exhaustive (every pair) | sequential (neighbours in order of name: video frames, walks) | retrieval
    (similar photos, and the nearest neighbours in order of name)."""
    exhaustive_limit: Count
    """Number of photos up to which `auto` matches every pair; of more it takes `retrieval`."""
    overlap: Annotated[int, Range(1, 1000)]
    """`sequential` matches photos at the distances 1, 2, 4, ... 2^(overlap - 1) in the sorted list."""
    similar: Annotated[int, Range(1, 1000)]
    """`retrieval` matches each photo with this many of the most similar ones."""
    near: Annotated[int, Range(1, 1000)]
    """`retrieval` also matches photos up to this distance in the sorted list."""
    retry_pairs: Annotated[int, Range(0, 10**9)]
    """Bound on the pairs of each attempt to place remaining photos; 0: no attempt. `exhaustive` needs none."""
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
        extract(database, folder, sizes, options)
        _match(database, len(sizes), options)
        best = largest(_map(database, folder, work / "sparse", len(sizes), options))
        return _retry(best, database, folder, sizes, options, work)


def largest(models: Mapping[int, Any]) -> Any:
    """Return the model that places most photos, the first of equals; None if there is none."""
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


def extract(database: Path, folder: Path, sizes: Sizes, options: SfmOptions) -> None:
    """Find the features of imported photos."""
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
    return "exhaustive" if count <= options.exhaustive_limit else "retrieval"


def pair_count(matcher: str, count: int, options: SfmOptions) -> int:
    """Return the number of pairs of photos to match, an upper bound for similar photos."""
    every = count * (count - 1) // 2
    distances = {
        "exhaustive": range(1, count),
        "sequential": [2**k for k in range(options.overlap)],
        "near": range(1, options.near + 1),
    }
    if matcher == "similar":
        return min(every, count * options.similar)
    return sum(max(0, count - distance) for distance in distances[matcher])


def _match(database: Path, count: int, options: SfmOptions) -> None:
    """Match features of pairs; `retrieval` does so in two stages."""
    matcher = chosen_matcher(count, options)
    for kind in ("near", "similar") if matcher == "retrieval" else (matcher,):
        if kind == "similar":
            match_similar(database, options.similar, pair_count(kind, count, options), options)
        else:
            match_pairs(database, kind, pairing_options(kind, options), pair_count(kind, count, options), options)


def match_pairs(database: Path, kind: str, pairing: Any, total: int, options: SfmOptions) -> int:
    """Match the pairs that COLMAP's `pairing` options choose, `total` at most; return the number of new ones."""
    import pycolmap

    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads = options.num_threads or -1
    matching.use_gpu = False
    verification.ransac.random_seed = options.seed
    match = partial(
        getattr(pycolmap, f"match_{COLMAP_MATCHERS[kind]}"),
        database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    with pycolmap.Database.open(database) as reader:
        before = reader.num_matched_image_pairs()
        run_stage(STAGES[kind], match, lambda: reader.num_matched_image_pairs() - before, total)
        return reader.num_matched_image_pairs() - before


def match_similar(database: Path, similar: int, total: int, options: SfmOptions, queries: Sequence[str] = ()) -> int:
    """Match photos, or only `queries`, with the most similar ones; return the number of new pairs.

    The vocabulary lies next to the database, and is learnt at the first call.
    """
    import pycolmap

    words = database.with_name("vocabulary.bin")
    with pycolmap.Database.open(database) as reader:
        if not words.is_file() and not learn_vocabulary(reader, words, options.seed):
            logger.warning("sfm: photos have too few features for a vocabulary: similar photos are not matched")
            return 0
    pairing = pycolmap.VocabTreePairingOptions()
    pairing.vocab_tree_path, pairing.num_images = words, similar + 1  # each photo is the most similar to itself
    pairing.num_nearest_neighbors = 1
    pairing.max_num_features = INDEXED
    pairing.num_threads = 1  # the order of similarity depends on it
    if queries:
        pairing.match_list_path = database.with_name("queries.txt")
        pairing.match_list_path.write_text("".join(f"{name}\n" for name in queries), "utf-8")
    return match_pairs(database, "similar", pairing, total, options)


def pairing_options(kind: str, options: SfmOptions) -> Any:
    """Return pycolmap's options that choose the pairs to match: exhaustive, sequential or near."""
    import pycolmap

    if kind == "exhaustive":
        every = pycolmap.ExhaustivePairingOptions()
        every.block_size = PAIR_BLOCK
        return every
    neighbours = pycolmap.SequentialPairingOptions()
    neighbours.overlap = options.overlap if kind == "sequential" else options.near
    neighbours.quadratic_overlap = kind == "sequential"
    neighbours.loop_detection = False  # it would need a vocabulary tree, which COLMAP downloads
    return neighbours


def _retry(best: Any, database: Path, folder: Path, sizes: Sizes, options: SfmOptions, work: Path) -> Any:
    """Match remaining photos with all others, most similar first, and continue mapping until no more are placed."""
    if chosen_matcher(len(sizes), options) == "exhaustive":
        return best
    for attempt in count_from(1):
        lost = unplaced(best, sizes)
        partners = min(options.retry_pairs // max(1, len(lost)), len(sizes) - 1)
        if not lost or not partners:
            break
        logger.info(
            "sfm: %d of %d photos are not placed: matching each with %d others", len(lost), len(sizes), partners
        )
        if not match_similar(database, partners, partners * len(lost), options, lost):
            break
        again = largest(_map(database, folder, work / f"sparse{attempt}", len(sizes), options, best))
        if again is None or len(unplaced(again, sizes)) >= len(lost):
            break
        best = again
    return best


def unplaced(model: Any, sizes: Sizes) -> list[str]:
    """Return sorted names of the photos that a pycolmap.Reconstruction, or None, does not place."""
    placed = {model.image(number).name for number in model.reg_image_ids()} if model is not None else set()
    return sorted(sizes.keys() - placed)


def _map(database: Path, folder: Path, sparse: Path, count: int, options: SfmOptions, start: Any = None) -> Any:
    """Return pycolmap's models by number; mapping continues from `start`, a pycolmap.Reconstruction, if any.

    Photos that a first mapping has left are placed by fewer points.
    """
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads = pipeline.mapper.num_threads = options.mapping_threads or -1
    pipeline.random_seed = pipeline.mapper.random_seed = pipeline.triangulation.random_seed = options.seed
    placed: list[None] = [None] * (start.num_reg_images() if start is not None else 0)
    sparse.mkdir()
    begin = sparse / "start"
    if start is not None:
        begin.mkdir()
        start.write_binary(begin)
        pipeline.mapper.abs_pose_min_num_inliers = FEWEST_INLIERS

    def reconstruct(cancellation_token: Any) -> dict[int, Any]:
        pycolmap.set_random_seed(options.seed)  # of this thread
        return pycolmap.incremental_mapping(
            database,
            folder,
            sparse,
            pipeline,
            input_path=begin if start is not None else "",
            initial_image_pair_callback=lambda: placed.extend([None, None]),
            next_image_callback=lambda: placed.append(None),
            cancellation_token=cancellation_token,
        )

    return run_stage("placing photos", reconstruct, lambda: min(len(placed), count), count)  # maps begin anew


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
