"""Scenes from a folder with nothing but photos: reconstructed once, kept in the cache, then a COLMAP scene."""

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

from gsx.core.data.scene import Scene
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import InputError
from gsx.core.files import expand_home
from gsx.core.quality.sharpness import sharpness_line
from gsx.core.ranges import Range
from gsx.engine.cache import cache_folder, content_key, file_stamp
from gsx.formats.suffixes import is_sog_folder
from gsx.scenes import colmap, sfm, sfm_copies
from gsx.scenes.cached_models import cached_model, holds_whole_model
from gsx.scenes.colmap_folders import count_images, model_folders, place, unusual_model_folders
from gsx.scenes.colmap_model import error_words, read_model
from gsx.scenes.exif import NO_LENS, lens_of, orientation_of
from gsx.scenes.masked import FOLDER, IMAGES
from gsx.scenes.options import SceneOptions, refuse_other
from gsx.scenes.orientation import ON_SIDE, as_stored, of_own_model, oriented_size
from gsx.scenes.pose_files import refuse_partial, some_names
from gsx.scenes.readable import readable_size

logger = logging.getLogger(__name__)

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
"""Suffixes that gsx reads; COLMAP gets copies of photos that it reads otherwise (gsx.scenes.sfm_copies)."""
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw")
FOREIGN = {".heic": "HEIC", ".heif": "HEIC", ".hif": "HEIC", ".avif": "AVIF"} | dict.fromkeys(RAW, "raw")
"""Kinds of photos that neither library decodes, by suffix."""
REMEDIES = {
    "HEIC": "which neither OpenImageIO nor COLMAP reads here: convert them, for example by "
    "'magick mogrify -format jpg *.heic', and set the phone to take JPEG",
    "AVIF": "which neither OpenImageIO nor COLMAP reads here: convert them, for example by "
    "'magick mogrify -format png *.avif'",
    "raw": "which are not developed here: export them as JPEG or PNG from a raw converter",
}
MATCHERS = ("auto", "exhaustive", "sequential", "retrieval")
CAMERA_MODES = ("auto", "single", "per_image")
MIN_PHOTOS = 2
METHOD = "sfm/2"  # part of the cache key: raise the number when the reconstruction changes
METHOD_WITH_RETRIES = "sfm/4"  # likewise, for every matcher but `exhaustive`
COPIES = "copies/1"  # likewise, where photos are converted for COLMAP
RULES = {"auto": of_own_model, "stored": as_stored}  # turns of a photo by `scene.orientation`
UNREAD_POSES = {
    "poses_bounds.npy": "LLFF", "cameras.xml": "Metashape", "cameras.sfm": "Meshroom", "sfm_data.json": "OpenMVG",
    "reconstruction.json": "OpenSfM", "bundle.out": "Bundler", "*.nvm": "VisualSFM",
    "corrected_cameras/*.json": "Polycam", "cameras/*.json": "Polycam",
}  # fmt: skip
"""Programs whose files of poses gsx does not read, by patterns of these below a folder."""


@dataclass(frozen=True, kw_only=True)
class PhotosOptions(SceneOptions, sfm.SfmOptions):
    """Options of `conf/scene/photos.yaml`."""

    max_reprojection_px: Annotated[float, Range(0, 1e6)]
    """As of scene=colmap."""


def load(options: PhotosOptions) -> Scene:
    """Load photos by their reconstruction, made or read from the cache; ConfigError: an option has no such value.

    Raises:
        InputError: too few photos can be read, or they cannot be reconstructed.
    """
    refuse_unknown(options)
    path = expand_home(options.path)
    folder, photos = find_photos(path)
    sizes, notes = readable_sizes(folder, photos)
    notes += unused_folder(path, folder)
    broken = sorted({*photos} - sizes.keys())
    refuse_partial(broken, len(photos), folder, options.missing, "cannot be read", remedy_of(folder, broken))
    model = read_model(reconstruct(folder, sizes, options, options.orientation))
    placed = f"{len(model.images)} of {len(sizes)} photos: {len(model.points)} points"
    notes.append(f"Reconstructed {placed}, {error_words(model.mean_error)}.")
    if lost := sorted(sizes.keys() - {image.name for image in model.images}):
        notes.insert(0, lost_photos(lost, len(sizes), sfm.chosen_matcher(len(sizes), options)))
    common = {field.name: getattr(options, field.name) for field in fields(SceneOptions)}
    as_model = colmap.ColmapOptions(**common, images=folder.name, max_reprojection_px=options.max_reprojection_px)
    scene = colmap.build(model, folder, as_model, notes, RULES[options.orientation])
    name = folder.resolve().parent.name if folder.name == IMAGES else folder.resolve().name
    return replace(scene, name=name, provenance=scene.provenance | {"sfm": settings(options, len(sizes))})


def lost_photos(lost: Sequence[str], count: int, matcher: str) -> str:
    """Return a note with the share and names of photos that could not be placed, and what would help."""
    every = "" if matcher == "exhaustive" else "scene.matcher=exhaustive matches every pair; "
    return (
        f"{len(lost)} of {count} photos ({len(lost) / count:.0%}) could not be placed and are not used: "
        f"{', '.join(lost)}. What would help: {every}a larger scene.max_feature_size finds finer texture; photos "
        "between these and the others, with 60 to 80 % overlap."
    )


def refuse_unknown(options: PhotosOptions) -> None:
    """Raise ConfigError for a word that is none of its option's values."""
    import pycolmap

    models = [name for name in pycolmap.CameraModelId.__members__ if name not in ("INVALID", "EQUIRECTANGULAR")]
    words = {"matcher": MATCHERS, "camera_mode": CAMERA_MODES, "camera_model": models, "orientation": tuple(RULES)}
    for key, known in words.items():
        refuse_other(key, getattr(options, key), known)


def find_photos(path: Path) -> tuple[Path, list[str]]:
    """Return the folder with photos (`path`, else `path`/images) and their sorted names; InputError: too few."""
    if not path.is_dir():
        raise InputError(f"scene.path '{path}' is no folder: name the folder that holds the photos.")
    if is_sog_folder(path):
        raise InputError(f"{path} is an unbundled SOG, whose pictures hold splats: open it by gsx view or gsx eval.")
    folder = path / IMAGES if not photos_in(path, "*") and (path / IMAGES).is_dir() else path
    names = photos_in(folder, "*") or photos_in(folder, "**/*")
    if len(names) < MIN_PHOTOS:
        others = sorted({file.suffix for file in folder.rglob("*") if file.is_file()} - {*PHOTO_SUFFIXES, ""})
        convert = f", or convert others to JPEG (found: {', '.join(others)})" if others else ""
        count = f"{len(names)} photo{'s' * (len(names) != 1)}"
        if foreign := foreign_sentences(folder):
            raise InputError(f"{folder} holds {len(names)} photos in other formats, and {' '.join(foreign)}")
        raise InputError(
            f"{folder} holds {count} ({', '.join(PHOTO_SUFFIXES)}), but reconstruction needs at least {MIN_PHOTOS}: "
            f"add photos, 30 to 200 of a scene{convert}."
        )
    return folder, names


def unused_folder(path: Path, folder: Path) -> list[str]:
    """Return a note if a folder has photos at its top, which are used, and others in `images`."""
    others = len(photos_in(path / IMAGES, "**/*")) if folder == path and (path / IMAGES).is_dir() else 0
    used = f"{others} photos in {IMAGES} are not used, as there are some in {path}"
    return [f"{used}: set scene.path to the folder to use."] if others else []


def photos_in(folder: Path, pattern: str) -> list[str]:
    """Return sorted names of photos below `folder` that match `pattern`, without masks and `foreign_to_user` files."""
    files = (file.relative_to(folder) for file in folder.glob(pattern) if file.suffix.lower() in PHOTO_SUFFIXES)
    return sorted(
        file.as_posix() for file in files if file.parts[0] != FOLDER and not any(map(foreign_to_user, file.parts))
    )


def foreign_to_user(name: str) -> bool:
    """Recognise a file or folder that a system has made: hidden, or thumbnails of a NAS or of macOS."""
    return name.startswith(".") or name in ("@eaDir", "__MACOSX")


def foreign_sentences(folder: Path) -> list[str]:
    """Return a sentence with the remedy for each kind of unreadable photo in a folder.

    A raw file next to a photo of the same name is a copy of it, and does not count.
    """
    files = [file for file in folder.iterdir() if not foreign_to_user(file.name)]
    stems = {file.stem for file in files if file.suffix.lower() in PHOTO_SUFFIXES}
    alone = [file.suffix.lower() for file in files if not (file.suffix.lower() in RAW and file.stem in stems)]
    counts = Counter(FOREIGN[suffix] for suffix in alone if suffix in FOREIGN)
    return [f"{count} {kind} photos, {REMEDIES[kind]}." for kind, count in sorted(counts.items())]


def readable_sizes(folder: Path, photos: Sequence[str]) -> tuple[dict[str, tuple[int, int]], list[str]]:
    """Return sizes of the readable photos by name, and notes on the others; InputError: fewer than two."""
    sizes = {}
    for name in photos:
        try:
            sizes[name] = readable_size(folder / name)
        except InputError as problem:
            logger.warning("%s", problem)
    broken = [name for name in photos if name not in sizes]
    if len(sizes) < MIN_PHOTOS:
        raise InputError(
            f"Only {len(sizes)} of the {len(photos)} photos in {folder} can be read: {remedy_of(folder, broken)}."
        )
    notes = [f"Skipped {len(broken)} photos that cannot be read: {some_names(broken)}."] if broken else []
    return sizes, [*notes, *(f"Passed over {sentence}" for sentence in foreign_sentences(folder))]


def remedy_of(folder: Path, broken: Sequence[str]) -> str:
    """Return the remedy for photos that cannot be read, with the reason of the first."""
    try:
        if broken:
            readable_size(folder / broken[0])
    except InputError as problem:
        return f"export them again ({str(problem).rstrip('.')})"
    return "export them again"


def reconstruct(folder: Path, sizes: sfm.Sizes, options: sfm.SfmOptions, orientation: str = "auto") -> Path:
    """Return the folder of the model of these photos, computed once; InputError: no two photos can be placed."""
    import pycolmap

    first = {name: RULES[orientation](folder / name, size).first for name, size in sizes.items()}
    first |= turned_already(folder, sizes, options.camera_mode) if orientation == "auto" else {}
    rasters = {name: oriented_size(size, first[name]) for name, size in sizes.items()}
    doubtful = sfm_copies.candidates(folder, first)
    stamps = [(name, *file_stamp(folder / name)) for name in sizes]
    copies = [(COPIES, *doubtful.items())] if doubtful else []
    exhaustive = sfm.chosen_matcher(len(sizes), options) == "exhaustive"
    method = METHOD if exhaustive else METHOD_WITH_RETRIES
    key = content_key(method, pycolmap.__version__, stamps, settings(options, len(sizes)), *copies)
    final = cache_folder("sfm", key)
    if holds_whole_model(final):
        logger.info("sfm: found the reconstruction of these %d photos in %s", len(sizes), final)
        return final

    def make(work: Path) -> Any:
        best = sfm.reconstruct(
            sfm_copies.folder_for_colmap(folder, list(sizes), doubtful, work), rasters, options, work
        )
        if best is not None and best.num_reg_images() >= MIN_PHOTOS:
            return best
        raise InputError(
            f"None of the {len(sizes)} photos in {folder} could be placed: they need texture, 60 to 80 % overlap and a "
            "camera that moves between shots; try scene.matcher=exhaustive or a larger scene.max_feature_size."
        )

    return cached_model(final, make)


def turned_already(folder: Path, sizes: sfm.Sizes, camera_mode: str) -> dict[str, int]:
    """Return the orientation that turns portraits back on their side which share a camera with landscapes.

    A tool has turned their pixels: they state no orientation, and a lens and focal length of landscapes with the same
    sides (camera_mode=auto), or all photos share one camera (single).
    """
    wide = {size for size in sizes.values() if size[0] > size[1]}
    tall = [name for name, size in sizes.items() if size[::-1] in wide and orientation_of(folder / name) == 1]
    if camera_mode == "auto" and tall:
        lenses = {(lens_of(folder / name), size) for name, size in sizes.items() if size in wide}
        stated = {name: lens_of(folder / name) for name in tall}
        tall = [name for name in tall if stated[name] != NO_LENS and (stated[name], sizes[name][::-1]) in lenses]
    return dict.fromkeys(tall, ON_SIDE) if camera_mode != "per_image" else {}


def settings(options: sfm.SfmOptions, count: int) -> dict[str, Any]:
    """Return the options that decide the reconstruction of `count` photos."""
    without_effect = {"num_threads", *sfm.UNUSED[sfm.chosen_matcher(count, options)]}
    deciding = {field.name for field in fields(sfm.SfmOptions)} - without_effect
    return {key: value for key, value in asdict(options).items() if key in deciding}


def recognise(path: Path) -> bool:
    """Recognise a folder with photographs, or with some in its folder `images`."""
    return path.is_dir() and bool(photos_in(path, "*") or photos_in(path / IMAGES, "**/*"))


def facts(path: Path) -> Iterator[str]:
    """Yield lines on the photographs: sizes, turns, sharpness, problems."""
    folder, names = find_photos(path)
    sizes, notes = readable_sizes(folder, names)
    for (width, height), count in sorted(Counter(sizes.values()).items()):
        yield f"images    {count} of {width}x{height} in {folder}"
    turned = sum(orientation_of(folder / name) != 1 for name in sizes)
    yield from [f"turned    {turned} of {len(sizes)} upright by EXIF (scene.orientation)"] if turned else []
    yield sharpness_line([folder / name for name in sizes])
    yield from (f"note      {note}" for note in notes)


def refuse_existing_poses(path: Path) -> Mapping[str, str]:
    """Warn of unused poses near a folder of photos; returns no options.

    Raises:
        InputError: a COLMAP model or a transforms.json lies below the folder.
    """
    if found := next(_below(path), None):
        raise InputError(
            f"{path} holds photos, and {found}; to reconstruct the photos again: scene=photos scene.path={path}."
        )
    for pattern, program in UNREAD_POSES.items():
        for file in sorted(path.glob(pattern))[:1]:
            again = "which gsx does not read: photos are reconstructed again"
            logger.warning("%s holds cameras of %s, %s. Export a COLMAP model to use them.", file, program, again)
    above, name = path / "..", path.resolve().parent
    if model_folders(above) or (above / "transforms.json").is_file():
        logger.warning("%s has poses of photos, which are not used here: gsx %s uses them.", name, name)
    return {}


def _below(path: Path) -> Iterator[str]:
    """Describe the models and transforms files below a folder."""
    for folder in unusual_model_folders(path):
        name, count = place(path, folder), ""
        with suppress(InputError):
            count = f" ({count_images(folder)} images)"
        yield f"a COLMAP model in {name}{count}: train from it by scene=colmap scene.path={path} scene.model={name}"
    for file in sorted(path.glob("*/transforms*.json")):
        yield f"poses in {place(path, file)}: train from them by gsx {file.parent}"


FORMAT = SceneFormat(
    meaning="photos without poses, which are reconstructed first",
    sign=f"photos ({', '.join(PHOTO_SUFFIXES)})",
    recognise=recognise,
    facts=facts,
    overrides=refuse_existing_poses,
    quick=False,
)
