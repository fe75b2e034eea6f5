"""Photographs with poses as shots, views and scenes: the common steps of their loaders."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.images import ImageCache, image_size, refuse_other_size
from gsx.core.data.reduction import Reduction
from gsx.core.data.resize import ResizeRule, Size, training_size
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.errors import InputError
from gsx.core.files import expand_home
from gsx.core.shapes import Float
from gsx.lenses import lens_of
from gsx.scenes.depth_files import depth_file
from gsx.scenes.masked import mask_of, masks_named
from gsx.scenes.options import SceneOptions
from gsx.scenes.orientation import AFTER_MIRROR, Turned, Turns, TurnsOf, of_model, oriented_camera, oriented_size
from gsx.scenes.photo_source import PhotoSource
from gsx.scenes.pose_files import some_names
from gsx.scenes.splits import refuse_shared
from gsx.scenes.undistort import StoredUndistortion, camera_of, cut_of, pinhole_of, undistorted_size

MIN_IMAGES = 2  # one photo leaves depth undetermined
FARTHEST = 1e9  # a camera at a larger coordinate is a mistake: single precision cannot separate it from its neighbours
STRAY = 1e4
"""A camera so many times as far from the middle of all as the next farthest is a mistake: its view is a speck to the
others. A city from the street to the sky spans some 1e2."""
SAME_PLACE = 1e-3  # units: cameras no farther apart, as on a tripod, say nothing about the size of a scene


# -- shots -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """A photo on disk and the camera that took it."""

    name: str
    photo: Path
    whole: Camera
    """Camera of the whole photo, once undistorted, at the photo's own resolution."""
    expected_size: Size
    """(width, height) of the photo by the poses file."""
    remap: StoredUndistortion | None = None
    mask: Path | None = None
    """Its mask, if the poses file names one."""
    depth: Path | None = None
    """Its depth map, if the poses file names one."""
    turns: Turns = Turns()
    """Turns from the stored photo to the raster of `whole`, and from there upright."""

    def __post_init__(self) -> None:
        if not (self.whole.rotation.isfinite().all() and self.whole.translation.abs().max() <= FARTHEST):
            far = f"is more than {FARTHEST:g} units away, or has a rotation that is not finite"
            raise InputError(f"The camera of '{self.photo}' {far}: correct or remove its pose.")
        focal, principal = (self.whole.fx, self.whole.fy), (self.whole.cx, self.whole.cy)
        if not (all(0 < f <= FARTHEST for f in focal) and all(abs(c) <= FARTHEST for c in principal)):
            stated = f"has focal lengths {focal} and principal point {principal} px"
            raise InputError(f"The camera of '{self.photo}' {stated}: correct its intrinsics.")


def shot_through(
    intrinsics: Any,
    name: str,
    photo: Path,
    rotation: Float[Tensor, "3 3"],
    translation: Float[Tensor, "3"],
    turns_of: TurnsOf = of_model,
    native: bool = False,
) -> Shot:
    """Return a photo taken by the pycolmap camera `intrinsics`, undistorted to a pinhole's or with its lens (`native`).

    `turns_of` finds its turns by the file and the raster of `intrinsics` (`gsx.scenes.orientation.RULES`).

    Raises:
        InputError: the photo's size is no uniform reduction of the camera's, or that has no pinhole equivalent, or its
            lens is not rendered.
    """
    expected = intrinsics.width, intrinsics.height
    try:
        lens = lens_of(intrinsics) if native else None
        pinhole = intrinsics if native else pinhole_of(intrinsics)
    except InputError as problem:
        if native:
            raise InputError(f"'{photo}': {problem}") from None
        raise InputError(f"'{photo}' cannot be undistorted: {problem}") from None
    turns = turns_of(photo, expected)
    size = oriented_size(image_size(photo), turns.first)
    refuse_other_size(photo, size, expected)
    size = undistorted_size(intrinsics, pinhole, size)
    return Shot(
        name=name,
        photo=photo,
        whole=replace(camera_of(pinhole, rotation, translation).resize(*size), lens=lens),
        expected_size=expected,
        remap=None if pinhole is intrinsics else StoredUndistortion(photo, intrinsics, pinhole, size, turns.first),
        turns=turns,
    )


def shot_notes(shots: Sequence[Shot]) -> list[str]:
    """Return notes on photos that are undistorted, turned upright or mirrored."""
    turned = [shot for shot in shots if shot.turns.exif != 1]
    laid = [shot for shot in shots if shot.turns.exif == 1 and shot.turns.first != 1]
    mirrored = [shot.name for shot in shots if shot.turns.exif in AFTER_MIRROR and shot.turns.first == 1]
    notes = lens_notes(shots)
    if turned:
        notes.append(f"EXIF turns {len(turned)} of {len(shots)} photos upright (scene.orientation).")
    if laid:
        notes.append(f"{len(laid)} photos that a tool has turned share the camera of the others of their lens.")
    if mirrored:
        notes.append(
            f"EXIF mirrors {len(mirrored)} photos, but their cameras are those of the stored photos: they stay "
            f"mirrored ({some_names(mirrored)})."
        )
    return notes


def lens_notes(shots: Sequence[Shot]) -> list[str]:
    """Return one note for each kind of camera that is undistorted, and one on those that are not."""
    native = sum(shot.whole.lens is not None for shot in shots)
    if native:
        return [f"{native} of {len(shots)} photos are rendered through their lens (scene.lens=native)."]
    kinds = {
        (remap.intrinsics.model_name, shot.expected_size, shot.whole.size, cut_note(remap.intrinsics))
        for shot in shots
        if (remap := shot.remap)
    }
    return [
        f"Photos of {name} cameras of {width}x{height} are undistorted to {new_width}x{new_height}{cut}."
        for name, (width, height), (new_width, new_height), cut in sorted(kinds)
    ]


def cut_note(intrinsics: Any) -> str:
    """Describe the cut of photos of a pycolmap camera whose lens folds, as the end of a sentence."""
    cut = cut_of(intrinsics)
    if cut is None:
        return ""
    ends = f", {cut.radius:.0f} px from the principal point" if math.isfinite(cut.radius) else ""
    pixels = f"of its {intrinsics.width * intrinsics.height} px {cut.pixels} are used"
    return f", cut to where the lens does not fold: it ends within the photo{ends}, and {pixels}"


# -- views and scenes --------------------------------------------------------------------------------------------------


def views_of(shots: Sequence[Shot], options: SceneOptions) -> list[View]:
    """Return views at training size with a common image cache; InputError: a mask is missing, or a camera far off."""
    refuse_stray(shots)
    red, green, blue = options.background
    rule = ResizeRule(filter=options.resize_filter, light=options.resize_light, background=(red, green, blue))
    cache = ImageCache(int(options.cache_gb * 1e9))
    return [_view(shot, options, rule, cache) for shot in shots]


def refuse_stray(shots: Sequence[Shot]) -> None:
    """Raise InputError for a camera more than `STRAY` times as far from the middle of all as any other."""
    centres = torch.stack([shot.whole.centre.double() for shot in shots])
    distances, order = (centres - centres.median(dim=0).values).norm(dim=1).sort()
    if len(shots) < 3 or not distances[-1] > STRAY * distances[-2] > STRAY * SAME_PLACE:
        return
    raise InputError(
        f"The camera of '{shots[int(order[-1])].photo}' is {distances[-1] / distances[-2]:.2g} times as far from the "
        f"middle of all cameras as the next farthest (more than {STRAY:g}): correct its pose, or remove it."
    )


def _view(shot: Shot, options: SceneOptions, rule: ResizeRule, cache: ImageCache) -> View:
    whole, turns = shot.whole, shot.turns
    if options.principal_point == "centred":  # as 3D-GS assumes (dataset_readers.py)
        whole = replace(whole, cx=whole.width / 2, cy=whole.height / 2)
    size = training_size(
        *whole.size, options.downscale, options.max_width
    )  # the same for one lens in either orientation
    source = PhotoSource(
        path=shot.photo,
        rule=rule,
        cache=cache,
        whole=oriented_camera(whole, turns.last),
        expected_size=turns.stored_size(shot.expected_size),
        remap=turns.around(shot.remap),
        mask=mask_of(shot.photo, shot.name, shot.mask, shot.remap, shot.expected_size, options, turns),
        depth=shot.depth or depth_file(shot.name, options),
    )
    return View(shot.name, oriented_camera(whole.resize(*size), turns.last), source)


def check_sides(sides: tuple[Sequence[View], Sequence[View]], place: Path) -> None:
    """Raise InputError if there are too few training images, or a test image is trained on."""
    train, test = sides
    if len(train) < MIN_IMAGES:
        needed = f"but training needs at least {MIN_IMAGES} images: add some, or hold out fewer with scene.split"
        raise InputError(f"'{place}' leaves {len(train)} image to train on, {needed}.")
    refuse_shared(train, test, place)


def scene_of(
    options: SceneOptions,
    folder: Path,
    views: Sequence[View],
    sides: tuple[Sequence[View], Sequence[View]],
    points: PointCloud,
    notes: Sequence[str],
    details: Mapping[str, Any],
) -> Scene:
    """Return the scene in a folder; `views`: all that were read; `sides`: those to train and to test on.

    The provenance describes all views, and holds the details.
    """
    train, test = sides
    return Scene(
        name=folder.resolve().name,
        train=train,
        test=test,
        points=points,
        background=torch.tensor(list(options.background), dtype=torch.float32),
        reduction=Reduction(filter=options.resize_filter, light=options.resize_light),
        extent=extent_of([view.camera for view in train]),
        notes=notes,
        provenance={**provenance(options, views), **details},
    )


def provenance(options: SceneOptions, views: Sequence[View]) -> dict[str, Any]:
    """Describe the images of an evaluation, for `Scene.provenance`.

    Masks and turned photos are left out if there are none: such protocols keep their hash.
    """
    sources = [view.source for view in views if isinstance(view.source, PhotoSource)]
    turned = sum(isinstance(source.remap, Turned) for source in sources)
    return {
        "format": options.name,
        "path": expand_home(options.path).resolve().name,
        "principal_point": options.principal_point,
        "downscale": options.downscale,
        "max_width": options.max_width,
        "resize": {"filter": options.resize_filter, "light": options.resize_light},
        "split": options.split,
        "background": list(options.background),
        "number_of_images": len(views),
        **masks_named(views),
        **({"turned": turned} if turned else {}),
        **({"lens": options.lens} if options.lens != "undistort" else {}),
    }
