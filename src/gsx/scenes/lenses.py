"""Cameras of frames in transforms files (keys of nerfstudio and instant-ngp) as pycolmap cameras."""

import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsx.core.data.images import image_size
from gsx.core.data.resize import Size
from gsx.core.errors import InputError, nearest
from gsx.scenes.colmap_records import LARGEST_SIDE
from gsx.scenes.pose_files import finite_number

BENDING = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
"""Keys of distortion; their meaning depends on the camera model."""
PARAMETERS = "distortion_params"  # nerfstudio's list in place of these for FISHEYE624 (Project Aria)
FOCAL = {"x": ("x_fov", "fl_x", "camera_angle_x"), "y": ("y_fov", "fl_y", "camera_angle_y")}
"""Keys of a focal length by axis, in order of precedence: degrees (instant-ngp), pixels, radians."""


@dataclass(frozen=True)
class Lens:
    """Camera model of a transforms file as one of pycolmap's."""

    model: str
    keys: tuple[str, ...] = ()
    """Keys of distortion in the order of pycolmap's parameters; further parameters are 0."""
    fisheye: bool = False
    """It distorts the picture even if all parameters are 0."""


OPENCV = Lens("OPENCV", ("k1", "k2", "p1", "p2", "k3"))
FISHEYE = ("k1", "k2", "k3", "k4")
LENSES = {
    "OPENCV": OPENCV,
    "PINHOLE": Lens("PINHOLE"),
    "SIMPLE_PINHOLE": Lens("PINHOLE"),
    "SIMPLE_RADIAL": Lens("OPENCV", ("k1",)),
    "RADIAL": Lens("OPENCV", ("k1", "k2")),
    "FULL_OPENCV": Lens("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": Lens("OPENCV_FISHEYE", FISHEYE, fisheye=True),
    "RADIAL_FISHEYE": Lens("OPENCV_FISHEYE", FISHEYE[:2], fisheye=True),
    "SIMPLE_RADIAL_FISHEYE": Lens("OPENCV_FISHEYE", FISHEYE[:1], fisheye=True),
    "FISHEYE624": Lens("RAD_TAN_THIN_PRISM_FISHEYE", (PARAMETERS,), fisheye=True),
}
"""Supported camera models: nerfstudio's perspective and fisheye ones, and COLMAP's with the same keys."""
AROUND = "sees too wide for a pinhole: cut the photos into perspective views, and export those"
FOREIGN = "is not read from transforms files: undistort the photos, or load their COLMAP model with scene=colmap"
OTHERS = {
    **dict.fromkeys(("EQUIRECTANGULAR", "LATLONG", "VR180_L", "VR180_R"), AROUND),
    **dict.fromkeys(("OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R"), AROUND),
    "ORTHOPHOTO": "has no perspective: export perspective photos",
    **dict.fromkeys(("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "FTHETA"), FOREIGN),
    **dict.fromkeys(("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM"), FOREIGN),
}
"""Reasons against the other camera models of nerfstudio, instant-ngp and COLMAP, with remedies."""
MODES = {"equirectangular": "EQUIRECTANGULAR", "latlong": "LATLONG", "ftheta_p0": "FTHETA"}
"""Keys of instant-ngp that name a lens."""


def complete_frame(content: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """Return a frame with the file's common values; its own focal length, in any unit, replaces the common one."""
    common = dict(content)
    for keys in FOCAL.values():
        if any(frame.get(key) is not None for key in keys):
            common = {key: value for key, value in common.items() if key not in keys}
    return {**common, **frame}


def states_lens(content: Mapping[str, Any]) -> bool:
    """Return whether a file or frame states more of its camera than an angle of view."""
    keys = ("x_fov", "fl_x", "fl_y", "cx", "cy", "camera_angle_y", "camera_model", PARAMETERS)
    return any(content.get(key) is not None for key in keys) or any(content.get(key) for key in BENDING)


def angle_of(content: Mapping[str, Any]) -> float | None:
    """Return the horizontal angle of view (camera_angle_x) in radians; None: the file has no valid one."""
    angle = finite_number(content.get("camera_angle_x"))
    return angle if angle is not None and 0 < angle / 2 < math.pi / 2 else None  # its half is what has a tangent


def beyond_angle(content: Mapping[str, Any], frame: Mapping[str, Any]) -> list[str]:
    """Return the keys, sorted, by which a frame's camera differs from the file's camera_angle_x."""
    angle, node = angle_of(content), {**content, **frame}
    if angle is None:
        return sorted(key for key in (*FOCAL["x"][:2], *BENDING) if node.get(key))
    width, height = (finite_number(node.get(key)) or 0.0 for key in ("w", "h"))
    focal = width / (2 * math.tan(angle / 2))
    own = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    stated = {key: finite_number(node.get(key)) for key in own}
    other = [key for key, value in stated.items() if value is not None and abs(value - own[key]) > 0.01 * own[key]]
    named = str(node.get("camera_model")).upper()
    other += ["camera_model"] * (named in OTHERS or (named in LENSES and LENSES[named].fisheye))
    return sorted({*other, *(key for key in (*BENDING, "is_fisheye") if node.get(key))})


def lens_of(entry: Mapping[str, Any], photo: Path, place: str) -> Any:
    """Return the pycolmap camera of a completed frame; without distortion it is a PINHOLE.

    The size defaults to the photo's, the focal length to that of an angle of view, the principal point to the middle.

    Raises:
        InputError: the camera model is none of `LENSES`, or a value is missing, contradictory or invalid.
    """
    import pycolmap

    name = model_of(entry, place)
    lens = LENSES[name]
    width, height = _size(entry, photo, place)
    focal = _focal(entry, name, width, height, place)
    centre = [_number(entry, "cx", width / 2, place), _number(entry, "cy", height / 2, place)]
    bend = _distortion(entry, name, place)
    model = lens.model if lens.fisheye or any(bend) else "PINHOLE"
    if lens is OPENCV and any(bend[4:]):
        model = "FULL_OPENCV"
    if model not in pycolmap.CameraModelId.__members__:
        raise InputError(f"{place} has camera_model {name}, which pycolmap {pycolmap.__version__} lacks: upgrade it.")
    camera = pycolmap.Camera.create_from_model_name(1, model, focal[0], width, height)
    count = len(camera.params)
    camera.params = [*focal, *centre, *bend, *[0.0] * count][:count]
    return camera


def model_of(entry: Mapping[str, Any], place: str) -> str:
    """Return the name of the camera model; files of instant-ngp name none and mean OPENCV, or fisheye."""
    stated = entry.get("camera_model")
    mode = next((name for key, name in MODES.items() if entry.get(key) is not None and entry[key] is not False), None)
    fisheye = bool(entry.get("is_fisheye"))
    name = mode or (stated.upper() if isinstance(stated, str) else "OPENCV_FISHEYE" if fisheye else "OPENCV")
    if stated is not None and not isinstance(stated, str):
        raise InputError(f"{place} has camera_model {reprlib.repr(stated)}: give a name, {', '.join(LENSES)}.")
    if name in OTHERS:
        raise InputError(f"{place} has camera_model {name}, which {OTHERS[name]}.")
    if name not in LENSES:
        raise InputError(
            f"{place} has camera_model {reprlib.repr(stated)[1:-1]}, but only {', '.join(LENSES)} can be used: correct "
            f"it.{nearest(name, LENSES)}"
        )
    if fisheye and not LENSES[name].fisheye:
        raise InputError(f"{place} is {name} and has is_fisheye: remove the wrong one of the two.")
    return name


def _distortion(entry: Mapping[str, Any], name: str, place: str) -> list[float]:
    """Return the distortion of a camera model in pycolmap's order; InputError: the model lacks a parameter."""
    keys = LENSES[name].keys
    others = {key: _number(entry, key, 0.0, place) for key in BENDING if key not in keys}
    if odd := [key for key, value in others.items() if value]:
        other = "set camera_model to the lens that has it, or remove it"
        remedy = "undistort the photos" if name == "OPENCV" else other
        known = ", ".join(keys) or "none"
        raise InputError(f"{place} is {name} and has distortion {', '.join(odd)}, of which that has {known}: {remedy}.")
    return _parameters(entry, place) if keys == (PARAMETERS,) else [_number(entry, key, 0.0, place) for key in keys]


def _parameters(entry: Mapping[str, Any], place: str) -> list[float]:
    """Return the twelve numbers of FISHEYE624: six radial, two tangential, four of a thin prism."""
    values = entry.get(PARAMETERS, [0.0] * 12)
    numbers = [finite_number(value) for value in values] if isinstance(values, list) else []
    if len(numbers) != 12 or None in numbers:
        raise InputError(f"{place} has {PARAMETERS} {reprlib.repr(values)}: give a list of 12 finite numbers.")
    return [number for number in numbers if number is not None]


def _size(entry: Mapping[str, Any], photo: Path, place: str) -> Size:
    width, height = (_number(entry, name, math.nan, place) for name in ("w", "h"))
    if math.isnan(width) or math.isnan(height):
        return image_size(photo)
    if not 1 <= min(width, height) <= max(width, height) <= LARGEST_SIDE:
        raise InputError(f"{place} has size {width:g} x {height:g}, correct w and h.")
    return round(width), round(height)


def _focal(entry: Mapping[str, Any], name: str, width: int, height: int, place: str) -> tuple[float, float]:
    """Return focal lengths in pixels; the vertical one defaults to the horizontal one."""
    fl_x, fl_y = (_focal_of(entry, axis, side, name, place) for axis, side in (("x", width), ("y", height)))
    if math.isnan(fl_x):
        raise InputError(f"{place} has neither fl_x nor camera_angle_x, add the focal length in pixels as fl_x.")
    fl_y = fl_x if math.isnan(fl_y) or name == "SIMPLE_PINHOLE" else fl_y
    if min(fl_x, fl_y) <= 0:
        raise InputError(f"{place} has focal lengths {fl_x:g}, {fl_y:g}, they must be above 0.")
    return fl_x, fl_y


def _focal_of(entry: Mapping[str, Any], axis: str, side: int, name: str, place: str) -> float:
    """Return the focal length of one axis in pixels by its first key that is there; NaN: none is."""
    degrees, pixels, _ = FOCAL[axis]
    key = next((key for key in FOCAL[axis] if entry.get(key) is not None), pixels)
    value = _number(entry, key, math.nan, place)
    if key == pixels:
        return value
    if LENSES[name].fisheye:
        raise InputError(f"{place} is {name}, whose focal length {key} does not give: add it in pixels as fl_x.")
    angle = math.radians(value) if key == degrees else value
    if angle / 2 <= 0 or angle >= math.pi:  # its half is what the tangent is taken of
        raise InputError(f"{place} has {key} {angle:g}, no angle between 0 and pi: give fl_x and fl_y instead.")
    return side / (2 * math.tan(angle / 2))


def _number(entry: Mapping[str, Any], key: str, default: float, place: str) -> float:
    """Return a finite number of the file; `default`: it has none."""
    value = entry.get(key)
    if value is None:
        return default
    number = finite_number(value)
    if number is None:
        raise InputError(f"{place} has {key} {reprlib.repr(value)}, which is no finite number.")
    return number
