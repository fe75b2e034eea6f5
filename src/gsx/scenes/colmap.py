"""Scenes from a COLMAP model and its photos (3D-GS, dataset_readers.py and getNerfppNorm and camera_utils.py)."""

import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.images import image_size, is_reduction
from gsx.core.data.scene import Depths, Scene, View
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import InputError
from gsx.core.files import expand_home, is_file
from gsx.core.ranges import Range
from gsx.core.shapes import Float
from gsx.scenes.adjust import WHEN, adjust_model, camera_lines, fit_line
from gsx.scenes.colmap_folders import (
    AUTO,
    find_model,
    model_folders,
    other_model_folders,
    photo_folders,
    photo_folders_above,
)
from gsx.scenes.colmap_model import Model, ModelImage, error_words, read_model
from gsx.scenes.keypoint_fit import Unmeasured, counted, known, straight_keypoints, with_rays
from gsx.scenes.masked import IMAGES, mask_notes
from gsx.scenes.options import SceneOptions, refuse_other
from gsx.scenes.orientation import RULES, TurnsOf, of_model, oriented_size
from gsx.scenes.pose_files import refuse_partial, similar_photo, some_names
from gsx.scenes.posed import MIN_IMAGES, Shot, check_sides, scene_of, shot_notes, shot_through, views_of
from gsx.scenes.splits import photos_of, refuse_file_twice, split_names
from gsx.scenes.undistort import METHOD, pinhole_of

MIN_VISIBLE_FRACTION = 0.5  # of the points, where the model keeps no observations that could be compared instead


@dataclass(frozen=True, kw_only=True)
class ColmapOptions(SceneOptions):
    """Options of `conf/scene/colmap.yaml`."""

    images: str
    """Image folder, relative to `path`; it may hold reduced images, such as `images_4`."""
    model: str = AUTO
    """Folder of the model, relative to `path`; auto: the one with the most images (gsx.scenes.colmap_folders)."""
    adjust: str = "never"
    """never | auto | always: whether the model's observations adjust poses and intrinsics (gsx.scenes.adjust)."""
    max_reprojection_px: Annotated[float, Range(0, 1e6)]
    """The scene is refused when the median reprojection error exceeds this, in pixels of the model's cameras."""

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_other("adjust", self.adjust, WHEN)


def load(options: ColmapOptions) -> Scene:
    """Load a COLMAP scene; InputError: a file is missing or corrupt, or the poses contradict the observations."""
    path, images = expand_home(options.path), options.images
    folder, notes = find_model(path, options.model)
    stated = read_model(folder)
    if images == IMAGES and not (folder in model_folders(path) and (path / IMAGES).is_dir()):
        images = image_folder(path, stated)
    model, adjustment = adjust_model(stated, options.adjust, path / images)
    notes += [f"Photos are those in {images}."] if images != options.images else []
    return build(model, path / images, replace(options, images=images), [*notes, *adjustment])


def build(
    model: Model, photos: Path, options: ColmapOptions, notes: Sequence[str], turns_of: TurnsOf | None = None
) -> Scene:
    """Return the scene of a model with its images in the folder `photos`; InputError as `load`.

    `notes` come first among the scene's; `turns_of` finds the turns of a photo (None: by `options.orientation`).
    """
    path, turns_of = expand_home(options.path), turns_of or RULES[options.orientation]
    present, absent_note = present_images(model, photos, options.missing)
    shots = [
        shot_through(
            model.cameras[image.camera_id],
            image.name,
            photos / image.name,
            image.rotation,
            image.translation,
            turns_of,
            options.lens == "native",
        )
        for image in present
    ]
    views = [
        replace(view, sparse=depths_of(view, one)) for view, one in zip(views_of(shots, options), present, strict=True)
    ]
    fit = check_cameras(model, present, shots, views, options.max_reprojection_px)
    train, test = split_names([view.name for view in views], options.split, path, photos_of(views))
    sides = [views[index] for index in train], [views[index] for index in test]
    check_sides(sides, path)
    notes = [*notes, *model.notes, *absent_note, *shot_notes(shots), *mask_notes(views, options), fit]
    details = {
        "image_folder": Path(options.images).name,
        "camera_models": sorted({camera.model_name for camera in model.cameras.values()}),
        "undistortion": METHOD if any(shot.remap is not None for shot in shots) else None,
        **({} if options.adjust == "never" else {"adjust": options.adjust}),
    }
    return scene_of(options, path, views, sides, model.points, notes, details)


def depths_of(view: View, image: ModelImage) -> Depths | None:
    """Return the depths of the points that a view observes, weighted by their reprojection errors e; None: unknown.

    Weights are exp(-(e / mean e)^2), as in DS-NeRF (Deng et al. 2022, load_llff.py), and 1 where e is unknown.
    """
    if not len(image.observed):
        return None
    pixels, z = (values.float() for values in view.camera.project(image.observed))
    used, mean = view.camera.shows(pixels, z), image.errors.nanmean().clamp_min(torch.finfo(torch.float32).tiny)
    weights = (-(image.errors / mean).square()).exp().nan_to_num(1.0).float()
    return Depths(pixels=pixels[used], z=z[used], weights=weights[used])


# -- images ------------------------------------------------------------------------------------------------------------


def present_images(model: Model, photos: Path, missing: float) -> tuple[list[ModelImage], list[str]]:
    """Return the images with a photo, and a note on the others; InputError: too few, or two are one file."""
    present = [image for image in model.images if is_file(photos / image.name)]
    if not present and model.images:
        names = [image.name for image in model.images]
        raise InputError(
            f"None of the {len(names)} images of {model.folder} is in {photos} (looked for {some_names(names)}): "
            f"{similar_photo(photos, names) or 'set scene.images to the folder that holds them'}."
        )
    if len(present) < MIN_IMAGES:
        raise InputError(
            f"{model.folder} has {len(model.images)} registered images, {len(present)} of them in {photos}, but "
            f"training needs at least {MIN_IMAGES}: add photos and reconstruct again."
        )
    absent = _absent(model, present)
    hint = similar_photo(photos, absent) if len(absent) > missing * len(model.images) else ""
    refuse_partial(absent, len(model.images), model.folder, missing, remedy=hint or "complete them")
    refuse_file_twice([image.name for image in present], [photos / image.name for image in present], model.folder)
    note = f"Skipped {len(absent)} images whose photos are missing: {some_names(absent)}."
    return present, [note] if absent else []


def _absent(model: Model, present: Sequence[ModelImage]) -> list[str]:
    """Return names of the other images."""
    return sorted({image.name for image in model.images} - {image.name for image in present})


# -- cameras -----------------------------------------------------------------------------------------------------------


def check_cameras(
    model: Model, images: Sequence[ModelImage], shots: Sequence[Shot], views: Sequence[View], limit: float
) -> str:
    """Compare the training cameras with the model's observations, and return a note; InputError: they disagree."""
    # views without their centring, if any: that is an approximation that the user chose, not a mistake
    sizes = [oriented_size(view.camera.size, shot.turns.last) for shot, view in zip(shots, views, strict=True)]
    cameras = [shot.whole.resize(*size) for shot, size in zip(shots, sizes, strict=True)]
    lenses = [model.cameras[image.camera_id] for image in images]
    errors = [reprojection_errors(*fit) for fit in zip(images, lenses, cameras, strict=True)]
    rest = counted([image.name for image in images], [~one.isnan() for one in errors], [one.isinf() for one in errors])
    measured = torch.cat([one[~one.isnan()] for one in errors])
    if not len(measured):
        return _check_visible(model, cameras, rest)
    median = float(measured.median())
    if not median <= limit:
        behind = "have most of the points that they observe behind them"
        missed = behind if math.isinf(median) else f"miss the observed keypoints by {median:.3g} px"
        raise InputError(
            f"The cameras of {model.folder} {missed} (median; the limit is scene.max_reprojection_px={limit:g}{rest}): "
            "poses, intrinsics or files of different reconstructions are mixed. If they are only inexact, "
            f"scene.adjust=auto estimates them anew from these observations.{model.conflict and ' '}{model.conflict}"
        )
    return (
        f"Reprojection error {median:.2f} px (median of {len(measured)} observations, at the model's resolution){rest}."
    )


def reprojection_errors(image: ModelImage, intrinsics: Any, camera: Camera) -> Float[Tensor, "K"]:
    """Return distances of projected points from their keypoints in pixels of the model.

    Points behind the camera have infinity, keypoints without a ray NaN. `camera` is the image's camera on any raster,
    `intrinsics` the model's pycolmap camera.
    """
    undistorted = camera.lens is None
    pinhole = pinhole_of(intrinsics) if undistorted else intrinsics
    observed = straight_keypoints(image, intrinsics) if undistorted else with_rays(image.keypoints, intrinsics)
    projected, depth = camera.project(image.observed)
    to_model = projected.new_tensor([pinhole.width / camera.width, pinhole.height / camera.height])
    errors = (projected * to_model - observed).norm(dim=1)
    ahead = (depth > 0) & errors.isfinite()  # a point in the plane of the camera's centre projects to infinity
    return torch.where(known(observed), torch.where(ahead, errors, torch.inf), torch.nan)


def _check_visible(model: Model, cameras: Sequence[Camera], rest: Unmeasured) -> str:
    """Return a note on the share of points in view; InputError: it is below `MIN_VISIBLE_FRACTION`."""
    visible = torch.stack([camera.sees(model.points.positions) for camera in cameras]).any(dim=0)
    fraction = float(visible.double().mean())
    if fraction < MIN_VISIBLE_FRACTION:
        raise InputError(
            f"Only {fraction:.0%} of the points of {model.folder} are in view of any camera (at least "
            f"{MIN_VISIBLE_FRACTION:.0%} should be): points and poses belong to different reconstructions."
        )
    why = "No keypoint can check the cameras" if rest.no_ray else "The model keeps no observations to check the cameras"
    return f"{why}; {fraction:.0%} of its points are in view{rest}."


# -- folders -----------------------------------------------------------------------------------------------------------


def facts(path: Path) -> Iterator[str]:
    """Yield lines on the model, its cameras and its images."""
    folder = find_model(path)[0]
    model = read_model(folder)
    yield f"model     {folder}: {len(model.images)} images, {error_words(model.mean_error)}"
    yield f"fit       {fit_line(model)}"
    cameras = [model.cameras[image.camera_id] for image in model.images]
    kinds = Counter((camera.model_name, camera.width, camera.height) for camera in cameras)
    for (name, width, height), count in sorted(kinds.items()):
        yield f"camera    {name} {width}x{height}, {count} images"
    images = image_folder(path, model)
    yield from (f"cameras   {line}" for line in camera_lines(model, path / images))
    present = [image for image in model.images if is_file(path / images / image.name)]
    absent = _absent(model, present)
    missing = f", absent: {some_names(absent)}" if absent else ""
    yield f"images    {len({image.name for image in present})} of {len(model.images)} in {images}{missing}"


def overrides(path: Path) -> dict[str, str]:
    """Return the folder of the images, if that is not `images`."""
    images = image_folder(path, read_model(find_model(path)[0]))
    return {} if images == IMAGES else {"images": images}


def image_folder(path: Path, model: Model) -> str:
    """Return the folder with most of the model's images, relative to `path`; `images` where no folder has any.

    Of equals it is the first whose photos have the size of their camera, or a uniform reduction of it.
    """
    for folders in (photo_folders(path, model.folder), photo_folders_above(path, model.folder)):
        counts = {folder: sum(is_file(folder / image.name) for image in model.images) for folder in folders}
        most = max(counts.values(), default=0)
        likely = [folder for folder, count in counts.items() if count == most > 0]
        if likely:
            best = next((folder for folder in likely if _fits(folder, model)), likely[0])
            return Path(os.path.relpath(best, path)).as_posix()
    return IMAGES


def _fits(folder: Path, model: Model) -> bool:
    """Return whether the first photo has its camera's size or a reduction of it."""
    image = next(image for image in model.images if is_file(folder / image.name))
    camera, photo = model.cameras[image.camera_id], folder / image.name
    raster = camera.width, camera.height
    with suppress(InputError):
        return is_reduction(oriented_size(image_size(photo), of_model(photo, raster).first), raster)
    return False


def recognise(path: Path) -> bool:
    """Recognise a model in any of its places; a transforms.json comes before the model that it was made from."""
    if not path.is_dir():
        return False
    transforms = any((path / name).is_file() for name in ("transforms.json", "transforms_train.json"))
    return bool(model_folders(path)) or (not transforms and bool(other_model_folders(path)))


FORMAT = SceneFormat(
    meaning="COLMAP model with photos",
    sign="COLMAP model (sparse/)",
    recognise=recognise,
    facts=facts,
    overrides=overrides,
)
