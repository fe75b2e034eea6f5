"""What the loaders of photographs with poses share: reading, axes, lenses, views, provenance."""

import math
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, centred
from gsx.core.data.images import ImageCache, image_size, refuse_other_size
from gsx.core.data.photo_source import PhotoSource
from gsx.core.data.reduction import Reduction
from gsx.core.data.resize import ResizeRule, Size, training_size
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import at_home, refuse_lfs_pointer
from gsx.core.files import read_json as parsed
from gsx.core.shapes import Float
from gsx.scenes.duplicates import refuse_file_twice
from gsx.scenes.frame_names import find_photo, lies_there, plain_name
from gsx.scenes.masked import mask_of, masks_named
from gsx.scenes.options import SceneOptions, refuse_unknown
from gsx.scenes.orientation import AFTER_MIRROR, Turned, Turns, TurnsOf, of_model, oriented_camera, oriented_size
from gsx.scenes.undistort import StoredUndistortion, camera_of, cut_of, pinhole_of, undistorted_size

MIN_IMAGES = 2  # one photo leaves depth undetermined
NAMED_AT_MOST = 5  # file names spelt out in a note
FARTHEST = 1e9
"""A camera at a larger coordinate is a mistake: single precision could not tell it from its neighbours."""
STRAY = 1e4
"""A camera so many times as far from the middle of all as the next farthest is a mistake: what one of them sees is a
speck to the others. A city from the street to the sky spans some 1e2."""
SAME_PLACE = 1e-3  # units: cameras that are no farther apart, as on a tripod, say nothing of how large a scene is
ROTATION_TOLERANCE = 0.01  # of the axes' lengths: text formats round, but a scaled camera is another camera
LAST_ROW = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """A photo on disk and the camera that took it."""

    name: str
    photo: Path
    whole: Camera
    """Camera of the whole photo, once undistorted, at the photo's own resolution."""
    expected_size: Size
    """(width, height) that the poses file states for the photo."""
    remap: StoredUndistortion | None = None
    mask: Path | None = None
    """Its mask, where the poses file names one."""
    turns: Turns = Turns()
    """Turns from the stored photo to the raster of `whole`, and from there upright."""

    def __post_init__(self) -> None:
        if not (self.whole.rotation.isfinite().all() and self.whole.translation.abs().max() <= FARTHEST):
            raise InputError(
                f"The camera of '{self.photo}' is more than {FARTHEST:g} units away, or turned by no number: correct "
                "or remove its pose."
            )
        focal, principal = (self.whole.fx, self.whole.fy), (self.whole.cx, self.whole.cy)
        if not (all(0 < f <= FARTHEST for f in focal) and all(abs(c) <= FARTHEST for c in principal)):
            raise InputError(
                f"The camera of '{self.photo}' has focal lengths {focal} and principal point {principal} px: correct "
                "its intrinsics."
            )


def shot_through(
    intrinsics: Any,
    name: str,
    photo: Path,
    rotation: Float[Tensor, "3 3"],
    translation: Float[Tensor, "3"],
    turns_of: TurnsOf = of_model,
) -> Shot:
    """A photo taken through `intrinsics`, a pycolmap camera, as the pinhole photo that gsx uses.

    `turns_of` finds its turns by the file and the raster of `intrinsics` (`gsx.scenes.orientation.RULES`).

    Raises:
        InputError: the photo's size is no uniform reduction of theirs, or that has no pinhole equivalent.
    """
    try:
        pinhole, expected = pinhole_of(intrinsics), (intrinsics.width, intrinsics.height)
    except InputError as problem:
        raise InputError(f"'{photo}' cannot be undistorted: {problem}") from None
    turns = turns_of(photo, expected)
    size = oriented_size(image_size(photo), turns.first)
    refuse_other_size(photo, size, expected)
    size = undistorted_size(intrinsics, pinhole, size)
    return Shot(
        name=name,
        photo=photo,
        whole=camera_of(pinhole, rotation, translation).resize(*size),
        expected_size=expected,
        remap=None if pinhole is intrinsics else StoredUndistortion(photo, intrinsics, pinhole, size, turns.first),
        turns=turns,
    )


def lens_notes(shots: Sequence[Shot]) -> list[str]:
    """Return one note for each kind of camera that is undistorted."""
    kinds = {
        (remap.intrinsics.model_name, shot.expected_size, shot.whole.size, cut_note(remap.intrinsics))
        for shot in shots
        if (remap := shot.remap)
    }
    return [
        f"Photos of {name} cameras of {width}x{height} are undistorted to {new_width}x{new_height}{cut}."
        for name, (width, height), (new_width, new_height), cut in sorted(kinds)
    ]


def turn_notes(shots: Sequence[Shot]) -> list[str]:
    """Return notes on photos that are turned upright, and on mirrored ones whose cameras saw them mirrored."""
    turned = [shot for shot in shots if shot.turns.exif != 1]
    laid = [shot for shot in shots if shot.turns.exif == 1 and shot.turns.first != 1]
    mirrored = [shot.name for shot in shots if shot.turns.exif in AFTER_MIRROR and shot.turns.first == 1]
    notes = [f"EXIF turns {len(turned)} of {len(shots)} photos upright (scene.orientation)."] if turned else []
    mirrors = f"EXIF mirrors {len(mirrored)} photos, but the cameras are stated for them as stored: they stay mirrored"
    if laid:
        notes.append(f"{len(laid)} photos that a tool has turned share the camera of those of their lens that are not.")
    return [*notes, *([f"{mirrors} ({named(mirrored)})."] if mirrored else [])]


def cut_note(intrinsics: Any) -> str:
    """Return what is cut off the photos of a pycolmap camera whose lens folds, as the end of a sentence."""
    cut = cut_of(intrinsics)
    if cut is None:
        return ""
    ends = f", {cut.radius:.0f} px from the principal point" if math.isfinite(cut.radius) else ""
    return (
        f", cut to where the lens does not fold: it ends within the photo{ends}, and of its "
        f"{intrinsics.width * intrinsics.height} px {cut.pixels} are used"
    )


def read_json(path: Path) -> dict[str, Any]:
    """The object that a JSON file holds.

    Raises:
        InputError: the file is missing or is no JSON object.
    """
    if not path.is_file():
        raise InputError(f"'{path}' does not exist: scene.path must be the folder that holds it.")
    refuse_lfs_pointer(path)
    try:
        content = parsed(path)
    except (OSError, ValueError) as problem:
        raise InputError(f"'{path}' is no valid JSON ({problem}), copy or export it anew.") from None
    if not isinstance(content, dict):
        raise InputError(f"'{path}' holds no JSON object, copy or export it anew.")
    return content


def read_frames(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the content of a transforms file and its frames, each with a file name.

    Raises:
        InputError: the file is missing or damaged, or lists no frames.
    """
    content = read_json(path)
    return content, frames_in(content, path)


def frames_in(content: Mapping[str, Any], path: Path, key: str = "frames") -> list[dict[str, Any]]:
    """Return the frames that a transforms file lists under a key, each with a file name.

    Raises:
        InputError: there are none, or one has no name, one that is no text, or that of another.
    """
    frames = content.get(key)
    if not isinstance(frames, list) or not frames:
        raise InputError(f"'{path}' lists no {key}, export it anew.")
    if not all(isinstance(frame, dict) and isinstance(frame.get("file_path"), str) for frame in frames):
        if any(isinstance(frame, dict) and "rgb_path" in frame for frame in frames):
            raise InputError(f"'{path}' is of SDFStudio (rgb_path), which gsx does not read: export transforms.json.")
        raise InputError(f"'{path}' has a frame without 'file_path', export it anew.")
    masks = [frame["mask_path"] for frame in frames if isinstance(frame.get("mask_path"), str)]
    refuse_no_text([*(frame["file_path"] for frame in frames), *masks], path)
    refuse_twice([frame["file_path"] for frame in frames], path)
    return frames


def refuse_twice(names: Sequence[str], path: Path) -> None:
    """Raise InputError if two names of a poses file are one."""
    for name, count in Counter(map(plain_name, names)).items():
        if count > 1:
            raise InputError(f"'{path}' has '{name}' twice, perhaps to train on and to test on: remove one.")


def refuse_no_text(names: Sequence[str], path: Path) -> None:
    """Raise InputError for a file name that holds a NUL character, or half of a character."""
    for name in names:
        if any(letter == "\0" or "\ud800" <= letter <= "\udfff" for letter in name):
            raise InputError(f"'{path}' names a photo {name!a}, which is no text: rename the photo, and it here.")


def finite_number(value: Any) -> float | None:
    """A number of a file; None for what is no number, not finite, or larger than those of double precision."""
    try:
        number = float(value) if isinstance(value, float | int) else math.nan
    except OverflowError:  # an integer of hundreds of digits
        return None
    return number if math.isfinite(number) else None


def refuse_partial(
    missing: Sequence[str],
    count: int,
    place: Path,
    allowed: float,
    fault: str = "are not on disk",
    remedy: str = "complete them",
) -> None:
    """Raise InputError if more than the share `allowed` of the `count` images of `place` cannot be used."""
    share = len(missing) / count
    if share > allowed:
        raise InputError(
            f"{len(missing)} of the {count} images of '{place}' {fault} ({named(missing)}): {remedy}, or train on what "
            f"is there with scene.missing={math.ceil(100 * share) / 100:g} or more."
        )


def present_frames(
    folder: Path, frames: list[dict[str, Any]], file: Path, allowed: float
) -> tuple[list[tuple[dict[str, Any], Path]], list[str]]:
    """The frames whose photo is on disk with its path, and a note that names the others.

    Raises:
        InputError: no photo is there, more than the share `allowed` is not, or one is there under two names.
    """
    photos = [find_photo(folder, frame["file_path"]) for frame in frames]
    present = [(frame, photo) for frame, photo in zip(frames, photos, strict=True) if photo is not None]
    missing = [plain_name(frame["file_path"]) for frame, photo in zip(frames, photos, strict=True) if photo is None]
    remedy = renaming(folder, missing, {photo for _, photo in present}) if len(missing) > allowed * len(frames) else ""
    if not present:
        raise InputError(
            f"None of the {len(frames)} images of '{file}' is in '{folder}' (looked for {named(missing)}): "
            f"{remedy or 'put them there or correct the names in the file'}."
        )
    refuse_partial(missing, len(frames), file, allowed, remedy=remedy or "complete them")
    refuse_file_twice([plain_name(frame["file_path"]) for frame, _ in present], [photo for _, photo in present], file)
    note = f"Skipped {len(missing)} of the {len(frames)} images of {file.name}, not on disk: {named(missing)}."
    return present, [note] if missing else []


def renaming(folder: Path, missing: Sequence[str], taken: Container[Path]) -> str:
    """Return what to do about missing photos if one lies there under another name, which no other frame has taken."""
    found = ((name, lies_there(folder, name)) for name in missing[:NAMED_AT_MOST])
    right = (pair for pair in found if pair[1] and folder / pair[1] not in taken)
    return next((f"'{there}' is there, correct '{name}' in the file" for name, there in right), "")


def pose_from_opengl(matrix: Any, place: str) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Rotation and translation camera_from_world, float64, of an OpenGL camera-to-world matrix (3D-GS).

    `matrix` holds 3 or 4 rows of 4 numbers; OpenGL cameras have x right, y up, z back. Rotations that text has
    rounded are replaced by the nearest exact ones.

    Raises:
        InputError: it is no such matrix, not finite, or no rigid motion; `place` says where it stands.
    """
    try:
        world_from_camera = torch.tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"{place} has a pose that is no matrix of numbers, export it anew.") from None
    if world_from_camera.shape not in ((3, 4), (4, 4)) or not world_from_camera.isfinite().all():
        raise InputError(f"{place} has a pose that is not 3 x 4 or 4 x 4 finite numbers, remove or repair it.")
    if len(world_from_camera) == 4 and (world_from_camera[3] - LAST_ROW).abs().max() > ROTATION_TOLERANCE:
        raise InputError(f"{place} has a pose whose fourth row is not 0 0 0 1: is the matrix transposed?")
    u, stretch, vh = torch.linalg.svd(world_from_camera[:3, :3])
    if (stretch - 1).abs().max() > ROTATION_TOLERANCE or torch.linalg.det(u @ vh) < 0:
        raise InputError(f"{place} has a pose that scales or mirrors, export cameras without scale.")
    rotation = (u @ vh @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))).T
    return rotation, -rotation @ world_from_camera[:3, 3]


def views_of(shots: Sequence[Shot], options: SceneOptions) -> list[View]:
    """Views at training size, in the order of `shots`, sharing one image cache.

    Raises:
        ConfigError: an option of the resize rule, of masks or the principal point is unknown.
        InputError: a mask that the scene names is not there, or a camera is far off all others.
    """
    refuse_unknown(options)
    refuse_stray(shots)
    red, green, blue = rgb(options.background)
    rule = ResizeRule(filter=options.resize_filter, light=options.resize_light, background=(red, green, blue))
    cache = ImageCache(int(options.cache_gb * 1e9))
    return [_view(shot, options, rule, cache) for shot in shots]


def refuse_stray(shots: Sequence[Shot]) -> None:
    """Raise InputError for a camera that is more than `STRAY` times as far from the middle of all as any other."""
    centres = torch.stack([shot.whole.centre.double() for shot in shots])
    distances, order = (centres - centres.median(dim=0).values).norm(dim=1).sort()
    if len(shots) < 3 or not distances[-1] > STRAY * distances[-2] > STRAY * SAME_PLACE:
        return
    raise InputError(
        f"The camera of '{shots[int(order[-1])].photo}' is {distances[-1] / distances[-2]:.2g} times as far from the "
        f"middle of all cameras as the next farthest (more than {STRAY:g}): correct its pose, or remove it."
    )


def reduction_of(options: SceneOptions) -> Reduction:
    """How training pictures come from finer ones: by the resize rule."""
    return Reduction(filter=options.resize_filter, light=options.resize_light)


def rgb(background: Sequence[float]) -> tuple[float, float, float]:
    """The background as a triple.

    Raises:
        ConfigError: it has not three values.
    """
    if len(background) != 3:
        raise ConfigError(f"scene.background is {list(background)}, give red, green and blue in [0, 1].")
    red, green, blue = background
    return red, green, blue


def _view(shot: Shot, options: SceneOptions, rule: ResizeRule, cache: ImageCache) -> View:
    whole = centred(shot.whole) if options.principal_point == "centred" else shot.whole
    size = training_size(*whole.size, options.downscale, options.max_width)  # of one lens alike, however it was held
    turns = shot.turns
    source = PhotoSource(
        path=shot.photo,
        rule=rule,
        cache=cache,
        whole=oriented_camera(whole, turns.last),
        expected_size=turns.stored_size(shot.expected_size),
        remap=turns.around(shot.remap),
        mask=mask_of(shot.photo, shot.name, shot.mask, shot.remap, shot.expected_size, options, turns),
    )
    return View(shot.name, oriented_camera(whole.resize(*size), turns.last), source)


def refuse_too_few(train: Sequence[View], place: Path) -> None:
    """Raises InputError unless there are images enough to train on."""
    if len(train) < MIN_IMAGES:
        raise InputError(
            f"'{place}' leaves {len(train)} image to train on, but training needs at least {MIN_IMAGES} images: add"
            " some, or hold out fewer with scene.split."
        )


def provenance(options: SceneOptions, views: Sequence[View], **details: Any) -> dict[str, Any]:
    """What an evaluation has to say about its images, for `Scene.provenance`."""
    return {
        "format": options.name,
        "path": at_home(options.path).resolve().name,
        "principal_point": options.principal_point,
        "downscale": options.downscale,
        "max_width": options.max_width,
        "resize": {"filter": options.resize_filter, "light": options.resize_light},
        "split": options.split,
        "background": list(options.background),
        "number_of_images": len(views),
        **masks_named(views),
        **turned_named(views),
        **details,
    }


def turned_named(views: Sequence[View]) -> dict[str, int]:
    """Return the number of turned photos for the provenance; nothing without any, so that protocols keep their hash."""
    sources = [view.source for view in views if isinstance(view.source, PhotoSource)]
    turned = sum(isinstance(source.remap, Turned) for source in sources)
    return {"turned": turned} if turned else {}


def named(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = len(names) - NAMED_AT_MOST
    return ", ".join(names[:NAMED_AT_MOST]) + (f" and {more} more" if more > 0 else "")


def frames_line(file: Path) -> str:
    """How many images of a transforms file are there, for `gsx scenes`."""
    names = [frame["file_path"] for frame in read_frames(file)[1]]
    absent = [name for name in names if find_photo(file.parent, name) is None]
    return f"images    {len(names) - len(absent)} of {len(names)} of {file.name}" + (
        f", absent: {named(absent)}" if absent else ""
    )
