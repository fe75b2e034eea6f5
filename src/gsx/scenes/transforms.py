"""Scenes of a single transforms.json as nerfstudio and instant-ngp write it.

Poses are camera-to-world with OpenGL axes. Poses and points are used in the frame they are stored in: what
nerfstudio records as `applied_transform` is already applied to both. Photos of OPENCV cameras are undistorted as
those of COLMAP scenes are.
"""

import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gsx.core.data.images import image_size
from gsx.core.data.resize import Size
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import InputError, nearest
from gsx.core.files import at_home
from gsx.core.ranges import Points, Seed
from gsx.scenes.duplicates import photos_of, refuse_shared
from gsx.scenes.masked import mask_notes
from gsx.scenes.options import SceneOptions
from gsx.scenes.points import random_points, read_points
from gsx.scenes.posed import (
    Shot,
    finite_number,
    frames_line,
    lens_notes,
    plain_name,
    pose_from_opengl,
    present_frames,
    provenance,
    read_frames,
    reduction_of,
    refuse_too_few,
    shot_through,
    views_of,
)
from gsx.scenes.splits import Split, split_names
from gsx.scenes.undistort import METHOD

FILE = "transforms.json"
LARGEST_SIDE = 2**20
"""Of photographs, px: larger numbers are none."""
CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
FURTHER_DISTORTION = ("k4", "k5", "k6", "s1", "s2", "s3", "s4")
FALLBACK_SPLIT = "every:8"  # with split=json, for files without lists of names


@dataclass(frozen=True, kw_only=True)
class TransformsOptions(SceneOptions):
    """What `conf/scene/transforms.yaml` sets; `path` is the folder of transforms.json, or such a file itself.

    `split` can be `json` as well: the file's own train_filenames and test_filenames, else every:8.
    """

    points: str
    """auto: the file's ply_file_path if it has one, else random | random | a PLY file, relative to the folder."""
    random_points: Points
    """Random points are uniform in the smallest cube around the middle of the cameras that holds them all."""
    seed: Seed
    """Of the random points."""


def load(options: TransformsOptions) -> Scene:
    """Loads a transforms.json scene.

    Raises:
        InputError: a file is missing or damaged, a camera cannot be used, or there are fewer than two training images.
    """
    file = _file(at_home(options.path))
    content, frames = read_frames(file)
    present, notes = present_frames(file.parent, frames, file, options.missing)
    shots = [_shot({**content, **frame}, photo, file) for frame, photo in present]
    views = views_of(shots, options)
    (train, test), split_notes = _split(content, views, options.split, file)
    refuse_too_few(train, file)
    refuse_shared(train, test, file)
    points, points_note = _points(content, views, options, file)
    bent = any(shot.remap is not None for shot in shots)
    return Scene(
        name=file.parent.resolve().name,
        train=train,
        test=test,
        points=points,
        background=torch.tensor(list(options.background), dtype=torch.float32),
        reduction=reduction_of(options),
        extent=extent_of([view.camera for view in train]),
        notes=[*notes, *lens_notes(shots), *mask_notes(views, options), *split_notes, points_note],
        provenance=provenance(options, views, points=options.points, undistortion=METHOD if bent else None),
    )


def _file(path: Path) -> Path:
    """The transforms file that `path` is or holds."""
    file = path if path.is_file() else path / FILE
    if not file.is_file() and (path / "transforms_train.json").is_file():
        raise InputError(f"'{path}' has transforms_train.json and no {FILE}: it is a scene=blender folder.")
    return file


def _shot(entry: Mapping[str, Any], photo: Path, file: Path) -> Shot:
    """A shot from a frame completed by the file's common values."""
    name = plain_name(entry["file_path"])
    place = f"Frame '{name}' of '{file}'"
    rotation, translation = pose_from_opengl(entry.get("transform_matrix"), place)
    shot = shot_through(lens_of(entry, photo, place), name, photo, rotation, translation)
    mask = entry.get("mask_path")
    return shot if mask is None else replace(shot, mask=file.parent / plain_name(str(mask)))


def lens_of(entry: Mapping[str, Any], photo: Path, place: str) -> Any:
    """The pycolmap camera of a frame: PINHOLE, OPENCV or, with k3, FULL_OPENCV.

    The size defaults to the photo's, focal lengths to those of camera_angle_x and camera_angle_y, the principal
    point to the middle.

    Raises:
        InputError: the camera model is none of `CAMERA_MODELS`, or a value is missing, contradictory or senseless.
    """
    import pycolmap

    model = _model(entry, place)
    width, height = _size(entry, photo, place)
    focal = _focal(entry, width, height, place)
    centre = [_number(entry, "cx", width / 2, place), _number(entry, "cy", height / 2, place)]
    bend = [_number(entry, name, 0.0, place) for name in DISTORTION]
    if model != "OPENCV" and any(bend):
        raise InputError(f"{place} is {model} and has distortion {bend}, set camera_model to OPENCV or remove it.")
    if not any(bend):
        return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[*focal, *centre])
    k1, k2, p1, p2, k3 = bend
    params = [*focal, *centre, k1, k2, p1, p2, *([k3, 0, 0, 0] if k3 else [])]
    return pycolmap.Camera(model="FULL_OPENCV" if k3 else "OPENCV", width=width, height=height, params=params)


def _model(entry: Mapping[str, Any], place: str) -> str:
    """The camera model; instant-ngp files name none and mean OPENCV, or a fisheye by `is_fisheye`."""
    model = "OPENCV_FISHEYE" if entry.get("is_fisheye") else str(entry.get("camera_model", "OPENCV"))
    if model not in CAMERA_MODELS:
        raise InputError(
            f"{place} has camera_model {model}, but only {', '.join(CAMERA_MODELS)} can be used: undistort the photos"
            f" beforehand, or load their COLMAP model with scene=colmap.{nearest(model, CAMERA_MODELS)}"
        )
    further = [name for name in FURTHER_DISTORTION if _number(entry, name, 0.0, place)]
    if further:
        raise InputError(f"{place} has distortion {', '.join(further)}, but only {', '.join(DISTORTION)} are known.")
    return model


def _size(entry: Mapping[str, Any], photo: Path, place: str) -> Size:
    width, height = (_number(entry, name, math.nan, place) for name in ("w", "h"))
    if math.isnan(width) or math.isnan(height):
        return image_size(photo)
    if not 1 <= min(width, height) <= max(width, height) <= LARGEST_SIDE:
        raise InputError(f"{place} has size {width:g} x {height:g}, correct w and h.")
    return round(width), round(height)


def _focal(entry: Mapping[str, Any], width: int, height: int, place: str) -> tuple[float, float]:
    """Focal lengths in pixels: fl_x, fl_y, else from the angles of view, else fl_y as fl_x."""
    fl_x = _number(entry, "fl_x", _focal_of_angle(entry, "camera_angle_x", width, place), place)
    fl_y = _number(entry, "fl_y", _focal_of_angle(entry, "camera_angle_y", height, place), place)
    if math.isnan(fl_x):
        raise InputError(f"{place} has neither fl_x nor camera_angle_x, add the focal length in pixels as fl_x.")
    fl_y = fl_x if math.isnan(fl_y) or entry.get("camera_model") == "SIMPLE_PINHOLE" else fl_y
    if min(fl_x, fl_y) <= 0:
        raise InputError(f"{place} has focal lengths {fl_x:g}, {fl_y:g}, they must be above 0.")
    return fl_x, fl_y


def _focal_of_angle(entry: Mapping[str, Any], key: str, side: int, place: str) -> float:
    angle = _number(entry, key, math.nan, place)
    if angle / 2 <= 0 or angle >= math.pi:  # its half is what the tangent is taken of
        raise InputError(f"{place} has {key} {angle:g}, no angle between 0 and pi: give fl_x and fl_y instead.")
    return side / (2 * math.tan(angle / 2))


def _number(entry: Mapping[str, Any], key: str, default: float, place: str) -> float:
    """A finite number of the file, or `default` where it is missing."""
    value = entry.get(key)
    if value is None:
        return default
    number = finite_number(value)
    if number is None:
        raise InputError(f"{place} has {key} {reprlib.repr(value)}, which is no finite number.")
    return number


def _split(
    content: Mapping[str, Any], views: Sequence[View], rule: str, file: Path
) -> tuple[tuple[list[View], list[View]], list[str]]:
    """Training and test views, and a note where `json` had to fall back."""
    names = [view.name for view in views]
    notes = []
    if rule != "json":
        train, test = split_names(names, rule, file.parent, photos_of(views))
    elif "train_filenames" in content:
        train, test = _listed_split(content, names, file)
    else:
        train, test = split_names(names, FALLBACK_SPLIT)
        notes = [f"{file.name} lists no train_filenames: the split is {FALLBACK_SPLIT}."]
    return ([views[i] for i in train], [views[i] for i in test]), notes


def _listed_split(content: Mapping[str, Any], names: Sequence[str], file: Path) -> Split:
    """Positions of the names in the file's lists; names of photos that are not on disk are passed over."""
    test_key = "test_filenames" if "test_filenames" in content else "val_filenames"
    known = {plain_name(frame["file_path"]) for frame in content["frames"]}
    train, test = (_listed(content, key, known, file) for key in ("train_filenames", test_key))
    if train & test:
        raise InputError(f"'{min(train & test)}' is in train_filenames and {test_key} of '{file}', remove it from one.")
    split = [i for i, name in enumerate(names) if name in train], [i for i, name in enumerate(names) if name in test]
    if not split[1]:
        raise InputError(f"{test_key} of '{file}' names no image that is on disk, use another scene.split.")
    return split


def _listed(content: Mapping[str, Any], key: str, known: set[str], file: Path) -> set[str]:
    names = content.get(key, [])
    if not isinstance(names, list):
        raise InputError(f"{key} of '{file}' is {reprlib.repr(names)}: give a list, or another scene.split.")
    listed = {plain_name(str(name)) for name in names}
    unknown = sorted(listed - known)
    if unknown:
        raise InputError(f"{key} of '{file}' names '{unknown[0]}', which is no frame.{nearest(unknown[0], known)}")
    return listed


def _points(
    content: Mapping[str, Any], views: Sequence[View], options: TransformsOptions, file: Path
) -> tuple[PointCloud, str]:
    """Points and a note on where they come from."""
    stored = content.get("ply_file_path") if options.points == "auto" else options.points
    if stored is not None and stored != "random":
        cloud = read_points(file.parent / plain_name(str(stored)))
        return cloud, f"Starts from the {len(cloud)} points of {stored}."
    centres = torch.stack([view.camera.centre for view in views])
    low, high = centres.amin(0), centres.amax(0)
    middle, half = (low + high) / 2, (high - low).max() / 2
    generator = torch.Generator().manual_seed(options.seed)
    cloud = random_points(options.random_points, middle - half, middle + half, generator)
    return cloud, f"Starts from {len(cloud)} random points in the cube around the cameras."


FORMAT = SceneFormat(
    meaning="poses in one transforms.json (nerfstudio, instant-ngp)",
    sign=FILE,
    recognise=lambda path: (path / FILE).is_file() or (path.suffix == ".json" and path.is_file()),
    facts=lambda path: [frames_line(path if path.is_file() else path / FILE)],
)
