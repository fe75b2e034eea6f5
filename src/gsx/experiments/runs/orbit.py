"""A closed camera path within the range of the training cameras, and animations.

The path has cylindrical coordinates about the point that the cameras look at: bearing around the mean up direction,
distance from that axis, height along it. Cameras that surround the point give a full circle; cameras on one side give
a small ellipse of bearing and height; cameras that look outward give a turn on the spot they surround.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.images import in_memory
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import Scene
from gsx.core.errors import InputError, nearest
from gsx.core.files import replacing
from gsx.core.shapes import Float, UInt8
from gsx.experiments.viewer.up_direction import upright

PARALLEL = 0.01
"""Mean squared sine of viewing rays against one direction (6 degrees) below which they do not meet reliably."""
OUTWARD = 0.01
"""Share of the scene's depth: cameras whose rays meet nearer in front of them look outward."""
SWING = 0.5
"""Share of the cameras' range that an orbit on one side of the scene uses: in its middle, views are dense."""
LEAST_SWING = math.radians(2)
"""Smallest half-swing, so that a single camera moves as well."""
LARGEST_EDGE = 8192
"""Largest side of a frame, px."""
SLOWEST, FASTEST = 0.1, 1000
"""Frames per second of an animation."""
GIF_FASTEST = 50
"""Frames per second of a GIF: delays are whole hundredths of a second, and viewers slow down below two of them."""


GIF = ".gif"
ENCODINGS = {
    ".webp": ("libwebp_anim", {"quality": "85"}, {"loop": "0"}),
    ".mp4": ("libx264", {"crf": "18"}, {"movflags": "+faststart"}),  # H.264, with its index first
}
"""Codec of FFmpeg, its options, and those of the container, by suffix."""
SUFFIXES = (GIF, *ENCODINGS)


@dataclass(frozen=True, kw_only=True)
class Orbit:
    """A closed path about an axis: position and viewing direction as functions of a phase in [0, 2 pi)."""

    target: Float[Tensor, "3"]
    """World point on the axis."""
    axes: Float[Tensor, "3 3"]
    """Rows: bearing 0, bearing 90 degrees, up; orthonormal, world coordinates."""
    radius: float
    height: float
    """Height above the target, scene units."""
    bearing: float
    """Middle bearing, radians."""
    swing: float
    """Half the range of bearings, radians; pi: all around."""
    rise: float
    """Half the range of heights, scene units."""
    outward: bool
    """True: look away from the axis."""

    def pose(self, phase: float) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Return the eye and a point to look at."""
        full = self.swing >= math.pi
        bearing = self.bearing + (phase if full else self.swing * math.cos(phase))
        height = self.height + self.rise * math.sin(phase)
        side = math.cos(bearing) * self.axes[0] + math.sin(bearing) * self.axes[1]
        eye = self.target + self.radius * side + height * self.axes[2]
        return eye, (eye + side if self.outward else self.target)


def orbit_cameras(scene: Scene, frames: int) -> list[Camera]:
    """Return cameras on a closed orbit with the raster and field of view of the first training camera.

    Raises:
        InputError: frames is below 2, or the cameras look straight along their own up direction.
    """
    if frames < 2:
        raise InputError(f"an orbit of {frames} frames does not move: give at least 2, for example --frames 60")
    path = fit_path([view.camera for view in scene.train], scene.points.positions, scene.extent)
    return [on_path(path, 2 * math.pi * frame / frames, scene.train[0].camera) for frame in range(frames)]


def on_path(path: Orbit, phase: float, model: Camera) -> Camera:
    """Return the camera at a phase, with the intrinsics of `model` around the middle of its raster."""
    eye, goal = path.pose(phase)
    fov_x = 2 * math.atan(model.width / (2 * model.fx))
    try:
        camera = look_at(
            eye.tolist(), goal.tolist(), up=path.axes[2].tolist(), fov_x=fov_x, width=model.width, height=model.height
        )
    except ValueError as error:
        raise InputError(f"no orbit fits these cameras ({error}): render the test views instead") from error
    return replace(
        camera,
        rotation=camera.rotation.to(model.rotation),
        translation=camera.translation.to(model.translation),
        fy=model.fy,
        near=model.near,
    )


def fit_path(cameras: Sequence[Camera], points: Float[Tensor, "P 3"], extent: float) -> Orbit:
    """Fit a path to the cameras; `points` give the depth if viewing rays do not meet."""
    centres = torch.stack([camera.centre for camera in cameras]).double()
    rotations = torch.stack([camera.rotation for camera in cameras]).double()
    forwards = rotations[:, 2]
    up = upright(rotations)
    depth = scene_depth(centres, forwards, points.double(), extent)
    target, inward = look_at_point(centres, forwards, depth)
    axes = axes_about(up, forwards.mean(0))
    offsets = (centres - target) @ axes.T
    sides = offsets if inward else forwards @ axes.T
    bearing, swing = arc(torch.atan2(sides[:, 1], sides[:, 0]).tolist())
    full = swing >= math.pi
    heights = offsets[:, 2]
    middle = heights.median() if full else (heights.max() + heights.min()) / 2
    radius = float(offsets[:, :2].norm(dim=1).median())
    swing = swing if full else max(SWING * swing, LEAST_SWING)
    return Orbit(
        target=target,
        axes=axes,
        radius=radius,
        height=float(middle),
        bearing=bearing,
        swing=swing,
        rise=0.0 if full else max(SWING * float(heights.max() - heights.min()) / 2, swing * radius / 4),
        outward=not inward,
    )


def scene_depth(
    centres: Float[Tensor, "K 3"], forwards: Float[Tensor, "K 3"], points: Float[Tensor, "P 3"], extent: float
) -> float:
    """Return the median depth of the points in front of the mean camera, scene units."""
    mean = forwards.mean(0)
    depths = (points - centres.mean(0)) @ mean / mean.norm().clamp_min(1e-9)
    front = depths[depths > 0]
    return float(front.median()) if len(front) else max(extent, 1.0)


def nearest_to_rays(
    centres: Float[Tensor, "K 3"], forwards: Float[Tensor, "K 3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Return A, b of A x = b for the point x nearest to all viewing rays; A is singular if they are parallel."""
    across = torch.eye(3, dtype=centres.dtype) - forwards[:, :, None] * forwards[:, None, :]
    return across.sum(0), (across @ centres[:, :, None]).sum(0)[:, 0]


def look_at_point(
    centres: Float[Tensor, "K 3"], forwards: Float[Tensor, "K 3"], depth: float
) -> tuple[Float[Tensor, "3"], bool]:
    """Return (point closest to all viewing rays, True if it lies in front of the cameras).

    For nearly parallel rays: the point at `depth` in front of the mean camera.
    """
    system, right = nearest_to_rays(centres, forwards)
    if float(torch.linalg.eigvalsh(system / len(centres))[0]) < PARALLEL:
        return centres.mean(0) + depth * forwards.mean(0) / forwards.mean(0).norm(), True
    point = torch.linalg.solve(system, right)
    ahead = ((point - centres) * forwards).sum(1).mean()
    return point, float(ahead) > OUTWARD * depth


def axes_about(up: Float[Tensor, "3"], hint: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return right-handed orthonormal rows with `up` last and the first as near to `hint` as possible."""
    level = hint - (hint @ up) * up
    if level.norm() < 1e-3:
        level = torch.eye(3, dtype=up.dtype)[up.abs().argmin()]
        level = level - (level @ up) * up
    first = level / level.norm()
    return torch.stack([first, torch.linalg.cross(up, first), up])


def arc(bearings: Sequence[float]) -> tuple[float, float]:
    """Return middle and half-width, radians, of the shortest arc with all bearings; half-width pi: all around."""
    ordered = sorted(bearings)
    following = [*ordered[1:], ordered[0] + 2 * math.pi]
    gap, start = max((b - a, b) for a, b in zip(ordered, following, strict=True))
    if gap < math.pi:
        return 0.0, math.pi
    half = (2 * math.pi - gap) / 2
    return start + half, half


def write_animation(path: Path, frames: Iterable[Float[Tensor, "3 H W"]], fps: float) -> None:
    """Write frames, display values in [0, 1], one at a time: .gif; .webp and .mp4 need the extra `video`.

    Raises:
        InputError: the suffix, the speed or a frame size is unsuitable, there are no frames, or PyAV is missing.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"'{path}' is not an animation: use {', '.join(SUFFIXES)}.{nearest(suffix, SUFFIXES)}")
    if suffix != GIF:
        import_av(path)  # before frames are rendered
    fastest = GIF_FASTEST if suffix == GIF else FASTEST
    if not SLOWEST <= fps <= fastest:
        raise InputError(f"{path} cannot play at {fps:g} frames per second: use {SLOWEST:g} to {fastest}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        if suffix == GIF:
            write_gif(partial, checked(path, frames), fps)
        else:
            encode(suffix, partial, checked(path, frames), fps)


def import_av(path: Path) -> Any:
    """Import PyAV, which brings FFmpeg's encoders."""
    try:
        import av
    except ImportError as error:
        raise InputError(
            f"{path} needs PyAV (OpenImageIO animates only GIF): pip install 'gsx[video]', or write a .gif"
        ) from error
    return av


def checked(path: Path, frames: Iterable[Float[Tensor, "3 H W"]]) -> Iterator[UInt8[Tensor, "H W 3"]]:
    """Yield frames as bytes; raise InputError if one is too large or of another size than the first."""
    size = None
    for frame in frames:
        width, height = frame.shape[2], frame.shape[1]
        size = size or (width, height)
        if (width, height) != size:
            raise InputError(
                f"{path}: a frame is {width} x {height}, the first is {size[0]} x {size[1]}; make them equal"
            )
        if max(size) > LARGEST_EDGE:
            raise InputError(f"{path}: frames of {width} x {height} px are too large: at most {LARGEST_EDGE} px a side")
        yield to_uint8(frame.detach().cpu()).permute(1, 2, 0).contiguous()
    if size is None:
        raise InputError(f"{path}: there are no frames to write, give at least one")


def write_gif(path: Path, frames: Iterator[UInt8[Tensor, "H W 3"]], fps: float) -> None:
    """Write an endless GIF; the delay is rounded to hundredths of a second."""
    import OpenImageIO as oiio

    output = oiio.ImageOutput.create("gif")
    if output is None:
        raise InputError(f"{path} cannot be written, this OpenImageIO has no GIF writer: use .mp4 instead")
    delay = max(1, round(100 / fps))
    mode = "Create"
    with in_memory(path) as name:
        try:
            for frame in frames:
                spec = oiio.ImageSpec(frame.shape[1], frame.shape[0], 3, "uint8")
                spec.attribute("FramesPerSecond", "rational", (100, delay))
                if not (output.open(name, spec, mode) and output.write_image(frame.numpy())):
                    raise InputError(f"{path} cannot be written ({output.geterror()}): check the folder and its space")
                mode = "AppendSubimage"
        finally:
            output.close()


def encode(suffix: str, path: Path, frames: Iterator[UInt8[Tensor, "H W 3"]], fps: float) -> None:
    """Encode frames with PyAV. An odd last row or column is dropped: 4:2:0 colour needs even sizes."""
    av, (codec, quality, container) = import_av(path), ENCODINGS[suffix]
    first = next(frames)
    height, width = (size // 2 * 2 for size in first.shape[:2])
    if not (height and width):
        raise InputError(f"{path}: frames of {first.shape[1]}x{first.shape[0]} px are too small for that; give a .gif")
    with av.open(str(path), mode="w", options=container) as output:
        stream = output.add_stream(codec, rate=Fraction(fps).limit_denominator(1000), options=quality)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in chain([first], frames):
            picture = av.VideoFrame.from_ndarray(frame[:height, :width].contiguous().numpy(), format="rgb24")
            output.mux(stream.encode(picture))
        output.mux(stream.encode())
