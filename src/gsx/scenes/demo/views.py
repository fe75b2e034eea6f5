"""The built-in scene as data: cameras on a spiral, pictures rendered on demand, points on visible surfaces."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.images import ImageCache
from gsx.core.data.resize import training_size
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.errors import ConfigError
from gsx.core.ranges import Points, Range, Seed
from gsx.core.shapes import Float, UInt8
from gsx.engine.cache import cache_folder, content_key
from gsx.engine.cached_images import cache_image, read_cached_image
from gsx.scenes.demo.passer_by import with_passer_by
from gsx.scenes.demo.still_life import StillLife, make_still_life
from gsx.scenes.demo.tracing import colours_of, points_at, render
from gsx.scenes.options import SceneOptions
from gsx.scenes.splits import parse_rule

TARGET = (0.0, 0.05, 0.50)  # every camera looks here
FIELD_OF_VIEW = math.radians(50.0)  # horizontal
TURNS = 3.0  # of the spiral
ELEVATION = (math.radians(8.0), math.radians(46.0))  # at its beginning and its end
DISTANCE, SWAY, SWAYS = 3.3, 0.65, 5.0  # mean distance from the target, its variation, and how often it varies
SAME = 1e-6  # intrinsics that agree to this many pixels are the same
VERSION = "e26aec382d8f4c08"  # of the pictures, in protocols and the cache: give another where a pixel changes


@dataclass(frozen=True, kw_only=True)
class DemoOptions(SceneOptions):
    """Options of `conf/scene/demo.yaml`; `path` and options of photographs do not apply.

    `split=none` trains on test views as well; all other rules mean the test views between training views.
    """

    width: Annotated[int, Range(1, 16384)]
    """Width of the pictures before `downscale`, pixels."""
    height: Annotated[int, Range(1, 16384)]
    train_views: Annotated[int, Range(2, 10**5)]
    test_views: Annotated[int, Range(1, 10**5)]
    points: Points
    """Number of initial points."""
    samples: Annotated[int, Range(1, 64)]
    """Rays per pixel, averaged in display light."""
    seed: Seed
    """Seed of the initial points."""
    passer_by: bool = False
    """A person stands before each training camera. The default: runs older than this option."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DemoSource:
    """Exact truth of one view at any resolution; whole views are kept on disk, everything in memory."""

    life: StillLife
    own: Camera
    samples: int
    cache: ImageCache
    folder: Path

    def max_zoom(self, camera: Camera) -> float:
        """Return infinity: detail has no end."""
        return math.inf

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return the picture of a camera; a crop has the same bytes as the whole picture there."""
        key = camera_key(camera)
        return self.cache.get((self.folder, key), lambda: self.picture(camera, self.folder / f"{key}.png"))

    def picture(self, camera: Camera, path: Path) -> UInt8[Tensor, "3 H W"]:
        """Render a picture, or read it where an earlier run has rendered it."""
        if not same_view(camera, self.own):
            return render(self.life, camera, self.samples)
        kept = read_cached_image(path)
        if kept is not None and kept.shape == (3, camera.height, camera.width):
            return kept
        made = render(self.life, camera, self.samples)
        cache_image(path, made)
        return made


def same_view(camera: Camera, own: Camera) -> bool:
    """Return whether `camera` is `own` at some resolution, and no crop of it."""
    back = camera.resize(*own.size)
    intrinsics = ((back.fx, own.fx), (back.fy, own.fy), (back.cx, own.cx), (back.cy, own.cy))
    return camera.has_pose_of(own) and all(abs(a - b) < SAME for a, b in intrinsics)


def camera_key(camera: Camera) -> str:
    """Digest everything that a picture depends on."""
    pose = camera.rotation.tolist(), camera.translation.tolist()
    return content_key(*pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)


def spiral_camera(place: float, width: int, height: int) -> Camera:
    """Return the camera at `place` in [0, 1) of a rising spiral around the scene at varying distance."""
    azimuth = 2 * math.pi * TURNS * place - math.pi / 2
    elevation = ELEVATION[0] + (ELEVATION[1] - ELEVATION[0]) * place
    distance = DISTANCE - SWAY * math.cos(2 * math.pi * SWAYS * place)
    flat = distance * math.cos(elevation)
    eye = (flat * math.cos(azimuth), flat * math.sin(azimuth), distance * math.sin(elevation))
    eye = (TARGET[0] + eye[0], TARGET[1] + eye[1], TARGET[2] + eye[2])
    return look_at(eye, TARGET, fov_x=FIELD_OF_VIEW, width=width, height=height)


def sample_points(life: StillLife, cameras: Sequence[Camera], count: int, generator: torch.Generator) -> PointCloud:
    """Return coloured points where random rays of the cameras meet surfaces and sky, equally many from each."""
    shares = [count // len(cameras) + (index < count % len(cameras)) for index in range(len(cameras))]
    places = [random_places(camera, share, generator) for camera, share in zip(cameras, shares, strict=True)]
    hits = points_at(life, cameras, places)
    return PointCloud(hits.points.T.contiguous(), (colours_of(life, hits).T.contiguous() * 255.0 + 0.5).to(torch.uint8))


def random_places(camera: Camera, count: int, generator: torch.Generator) -> Float[Tensor, "2 count"]:
    """Draw places in the picture of a camera, px, float64."""
    return torch.rand(2, count, generator=generator, dtype=torch.float64) * torch.tensor([camera.size]).T


def check(options: DemoOptions) -> None:
    """Raise ConfigError for options that make no scene: a path or unit, more test than training views, an odd split."""
    parse_rule(options.split)
    if options.path:
        raise ConfigError(
            f"scene=demo takes no path, but scene.path is {options.path}: choose scene=colmap, photos, blender, "
            f"transforms or bungee (`gsx scenes {options.path}` detects it)."
        )
    if options.unit != 1:
        raise ConfigError(f"scene=demo has units of its own, but scene.unit is {options.unit}: set scene.unit=1.")
    if options.test_views > options.train_views:
        views = f"scene.test_views={options.test_views} exceeds scene.train_views={options.train_views}"
        raise ConfigError(f"{views}: set at most as many, as test cameras stand between training cameras.")


def make_views(group: str, cameras: Sequence[Camera], source: Callable[[str, Camera], DemoSource]) -> list[View]:
    """Return numbered views, each with its own source."""
    named = {f"{group}_{index:03d}": camera for index, camera in enumerate(cameras)}
    return [View(name, camera, source(name, camera)) for name, camera in named.items()]


def load(options: DemoOptions) -> Scene:
    """Return the built-in scene, whose pictures are rendered at first use; ConfigError: see `check`."""
    check(options)
    return scene_along(options, make_still_life(), spiral_camera, sample_points, "demo", VERSION, "a spiral")


CameraAt = Callable[[float, int, int], Camera]
"""(place in [0, 1) of a path, width, height) -> the camera there."""
PointsOf = Callable[[StillLife, Sequence[Camera], int, torch.Generator], PointCloud]
"""(things, cameras, count, generator) -> initial points."""


def scene_along(
    options: DemoOptions,
    life: StillLife,
    camera_at: CameraAt,
    points: PointsOf,
    name: str,
    version: str,
    path: str,
    floor: float = 0.0,
) -> Scene:
    """Place training cameras evenly along a path, and test cameras half-way between neighbours.

    name, version: of the format and its cached pictures; path: name of the path; floor: its height, scene units.
    """
    size = training_size(options.width, options.height, options.downscale, options.max_width)
    count = options.train_views
    train = [camera_at(index / count, *size) for index in range(count)]
    places = [(index * count // options.test_views + 0.5) / count for index in range(options.test_views)]
    test = [camera_at(place, *size) for place in places]
    cache = ImageCache(int(options.cache_gb * 1e9))

    def source(view: str, camera: Camera, somebody: bool) -> DemoSource:
        things = with_passer_by(life, camera, view, floor) if somebody else life
        who = ("passer by", view) if somebody else ()
        folder = cache_folder(name, content_key(version, options.samples, *who))
        return DemoSource(life=things, own=camera, samples=options.samples, cache=cache, folder=folder)

    train_views = make_views("train", train, partial(source, somebody=options.passer_by))
    test_views = make_views("test", test, partial(source, somebody=False))
    every = options.split == "none"
    return Scene(
        name=options.name,
        train=[*train_views, *test_views] if every else train_views,
        test=[] if every else test_views,
        points=points(life, train, options.points, torch.Generator().manual_seed(options.seed)),
        background=torch.tensor(options.background),
        extent=extent_of(train),
        notes=["somebody stands before each training camera (scene.passer_by)"] if options.passer_by else [],
        provenance=provenance(options, size, name, version, path),
    )


def provenance(options: DemoOptions, size: tuple[int, int], name: str, version: str, path: str) -> dict[str, Any]:
    """Return everything that decides the pictures, for the evaluation protocol."""
    somebody = {"passer_by": True} if options.passer_by else {}
    return somebody | {
        "format": name,
        "version": version,
        "size": list(size),
        "samples": options.samples,
        "light": "display",
        "split": f"{options.train_views} on {path}, {options.test_views} between them"
        + (", all trained on" if options.split == "none" else ""),
    }
