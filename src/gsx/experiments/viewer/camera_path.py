"""Camera paths: keyframes in time, gsx's own JSON and nerfstudio's.

Own files: {"gsx_camera_path": 1, "size": [width, height], "fps": 24, "keyframes": [{"time": 0.0, "position": [x, y, z],
"wxyz": [w, x, y, z], "fov": degrees}, ...]}. Positions are in the coordinates of the scene's files, times scene.unit;
rotations take camera axes (x right, y down, z ahead) to the world; fov is vertical. nerfstudio's (`ns-render
camera-path`): `camera_path` with `camera_to_world` (y up, z back) and `fov`, a frame each, taken to be in the same
world.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from gsx.core.data.camera import Camera, pinhole
from gsx.core.errors import InputError
from gsx.core.files import read_json, write_json
from gsx.core.gaussians.quaternions import quaternions_of, rotation_matrices
from gsx.experiments.run_folder.shapes import is_number

OWN = "gsx_camera_path"
MOST_FRAMES = 100_000
LARGEST_EDGE = 16_384
"""Longest side of pictures, px."""
VERSION = 1
"""Version of our files."""
LEAST_VOLUME = 0.99
"""Least volume of the box that a rotation's axes span: 1, but nerfstudio rounds them."""
PARALLEL = 1e-6
"""Quaternions this near to each other are interpolated along the chord."""


@dataclass(frozen=True)
class Keyframe:
    """Camera pose at a time."""

    time: float
    """Seconds."""
    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    """Camera to world; x right, y down, z ahead."""
    fov: float
    """Vertical field of view, radians."""


@dataclass(frozen=True)
class CameraPath:
    """Keyframes in order of time, size and frame rate."""

    size: tuple[int, int]
    """Width and height of the pictures, px."""
    fps: float
    keyframes: tuple[Keyframe, ...]

    def cameras(self, zoom: float = 1.0) -> list[Camera]:
        """Returns a camera for every frame from the first keyframe to the last; `zoom`: times the raster."""
        frames = self.keyframes
        count = 1 + round((frames[-1].time - frames[0].time) * self.fps)
        times = [min(frames[0].time + number / self.fps, frames[-1].time) for number in range(count)]
        return [self.camera(between(frames, time)).zoom(zoom) for time in times]

    def camera(self, frame: Keyframe) -> Camera:
        """Returns the pinhole camera of a keyframe."""
        return posed(frame.position, frame.wxyz, frame.fov, *self.size)


def posed(position: Sequence[float], wxyz: Sequence[float], fov: float, width: int, height: int) -> Camera:
    """Returns a camera of square pixels; `wxyz`: camera to world, `fov`: vertical, radians."""
    rotation = rotation_matrices(torch.tensor([wxyz], dtype=torch.float64))[0].T
    translation = -rotation @ torch.tensor(position, dtype=torch.float64)
    return pinhole(rotation, translation, height / (2 * math.tan(fov / 2)), width, height)


def between(frames: Sequence[Keyframe], time: float) -> Keyframe:
    """Interpolates keyframes at a time: positions on a cubic with finite differences as slopes, rotations on the
    shortest arc, the logarithm of tan(fov / 2) linearly."""
    after = min(bisect_left(frames, time - 1e-9, key=lambda frame: frame.time), len(frames) - 1)
    if after == 0 or math.isclose(frames[after].time, time, abs_tol=1e-9):
        return replace(frames[after], time=time)
    a, b = frames[after - 1], frames[after]
    t = (time - a.time) / (b.time - a.time)
    fov = math.exp((1 - t) * math.log(math.tan(a.fov / 2)) + t * math.log(math.tan(b.fov / 2)))
    return Keyframe(
        time=time,
        position=hermite(frames, after, t),
        wxyz=slerp(a.wxyz, b.wxyz, t),
        fov=2 * math.atan(fov),
    )


def hermite(frames: Sequence[Keyframe], after: int, t: float) -> tuple[float, float, float]:
    """Interpolates the position at a share t of the way to keyframe `after`."""
    a, b = frames[after - 1], frames[after]
    start, end = (torch.tensor(frame.position, dtype=torch.float64) for frame in (a, b))
    lead, trail = ((b.time - a.time) * slope(frames, i) for i in (after - 1, after))
    s = 1 - t
    x, y, z = (s * s * (1 + 2 * t) * start + t * s * s * lead - t * t * s * trail + t * t * (3 - 2 * t) * end).tolist()
    return x, y, z


def slope(frames: Sequence[Keyframe], i: int) -> torch.Tensor:
    """Returns the velocity at a keyframe, from one neighbour to the other."""
    a, b = frames[max(0, i - 1)], frames[min(len(frames) - 1, i + 1)]
    way = torch.tensor(b.position, dtype=torch.float64) - torch.tensor(a.position, dtype=torch.float64)
    return way / (b.time - a.time)


def slerp(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float], t: float
) -> tuple[float, float, float, float]:
    """Interpolates the rotation at a share of the shortest arc from a to b (Shoemake 1985)."""
    p, q = (torch.tensor(one, dtype=torch.float64) / math.hypot(*one) for one in (a, b))
    cosine = float(p @ q)
    q, cosine = (-q, -cosine) if cosine < 0 else (q, cosine)
    angle = math.acos(min(1.0, cosine))
    if angle < PARALLEL:
        mixed = (1 - t) * p + t * q
    else:
        mixed = (math.sin((1 - t) * angle) * p + math.sin(t * angle) * q) / math.sin(angle)
    w, x, y, z = (mixed / mixed.norm()).tolist()
    return w, x, y, z


def write_camera_path(path: Path, made: CameraPath) -> None:
    """Writes a file of gsx."""
    frames = [{"time": frame.time, "position": list(frame.position), "wxyz": list(frame.wxyz),
               "fov": math.degrees(frame.fov)} for frame in made.keyframes]  # fmt: skip
    write_json(path, {OWN: VERSION, "size": list(made.size), "fps": made.fps, "keyframes": frames})


def read_camera_path(path: Path) -> CameraPath:
    """Reads a file of gsx or nerfstudio.

    Raises:
        InputError: it is neither, or holds values that no camera has.
    """
    try:
        content = read_json(path)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"camera path '{path}' cannot be read ({error}): give a JSON file") from error
    try:
        made = of_gsx(content) if isinstance(content, dict) and OWN in content else of_nerfstudio(content)
        refuse_odd(made)
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"camera path '{path}' {what}: give one that gsx view has saved, or a camera path of nerfstudio"
        ) from error
    return made


def refuse_odd(path: CameraPath) -> None:
    """Raises ValueError for a path that cannot be rendered."""
    times = [frame.time for frame in path.keyframes]
    if not times or any(later <= earlier for earlier, later in pairwise(times)):
        raise ValueError("has no keyframes whose times increase")
    if not all(1 <= side <= LARGEST_EDGE for side in path.size) or not 0 < path.fps <= 1000:
        raise ValueError(f"has size {path.size} and {path.fps} frames a second")
    if (times[-1] - times[0]) * path.fps >= MOST_FRAMES:
        raise ValueError(f"has {(times[-1] - times[0]) * path.fps:,.0f} frames, more than {MOST_FRAMES:,}")
    if not all(0 < frame.fov < math.pi for frame in path.keyframes):
        raise ValueError("has a field of view that is not between 0 and 180 degrees")
    if not all(math.hypot(*frame.wxyz) > 0 for frame in path.keyframes):
        raise ValueError("has a rotation that is none")


def of_gsx(content: dict[str, Any]) -> CameraPath:
    """Reads the content of a file of gsx."""
    if content[OWN] != VERSION:
        raise ValueError(f"is of version {content[OWN]}, and this gsx reads version {VERSION}")
    frames = [
        Keyframe(time=number(one["time"]), position=numbers(one["position"], 3), wxyz=numbers(one["wxyz"], 4),
                 fov=math.radians(number(one["fov"])))
        for one in listed(content["keyframes"])
    ]  # fmt: skip
    width, height = numbers(content["size"], 2)
    return CameraPath(size=(int(width), int(height)), fps=number(content["fps"]), keyframes=tuple(frames))


def of_nerfstudio(content: Any) -> CameraPath:
    """Reads the content of a file of nerfstudio, a keyframe for each frame."""
    if not isinstance(content, dict) or content.get("camera_type", "perspective") != "perspective":
        raise ValueError("is no path of perspective cameras")
    entries = listed(content["camera_path"])
    pace = "fps" if "fps" in content else "seconds"
    if not (value := number(content[pace])) > 0:
        raise ValueError(f"has {value:g} for {pace}, which no film has")
    fps = value if pace == "fps" else len(entries) / value
    frames = []
    for i, entry in enumerate(entries):
        matrix = torch.tensor(numbers(entry["camera_to_world"], 16), dtype=torch.float64).view(4, 4)
        axes = matrix[:3, :3] * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
        axes = axes / axes.norm(dim=0)
        if not float(torch.linalg.det(axes)) > LEAST_VOLUME:
            raise ValueError(f"has a camera_to_world (entry {i}) that is no rotation")
        x, y, z = matrix[:3, 3].tolist()
        w, *xyz = quaternions_of(axes[None])[0].tolist()
        frames.append(Keyframe(i / fps, (x, y, z), (w, *xyz), math.radians(number(entry["fov"]))))
    size = int(number(content["render_width"])), int(number(content["render_height"]))
    return CameraPath(size=size, fps=fps, keyframes=tuple(frames))


def number(value: Any) -> float:
    """Returns a finite number; raises ValueError for others."""
    if not is_number(value):
        raise ValueError(f"has {value!r} where a number should be")
    return float(value)


def listed(value: Any) -> list[Any]:
    """Returns a list; raises ValueError for others."""
    if not isinstance(value, list):
        raise ValueError(f"has {value!r} where a list should be")
    return value


def numbers(values: Any, count: int) -> Any:
    """Returns `count` finite numbers of a list or of lists in it; raises ValueError for others."""
    flat = [one for row in listed(values) for one in (row if isinstance(row, list) else [row])]
    if len(flat) != count:
        raise ValueError(f"has {len(flat)} numbers where {count} should be")
    return tuple(number(one) for one in flat)
