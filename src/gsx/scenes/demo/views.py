"""The built-in scenes as data: pictures rendered on demand, points on visible surfaces."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.images import ImageCache
from gsx.core.data.resize import training_size
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.errors import ConfigError
from gsx.core.ranges import Points, Range, Seed
from gsx.core.shapes import Float, UInt8
from gsx.engine.cache import cache_folder, content_key
from gsx.engine.cached_images import cache_image, read_cached_image
from gsx.scenes.demo.cameras import DISTANCES, Cameras, even_cameras, mixed_cameras, spiral_camera
from gsx.scenes.demo.fisheye import StraightenedSource, straightened, through_fisheye
from gsx.scenes.demo.passer_by import with_passer_by
from gsx.scenes.demo.still_life import StillLife, make_still_life
from gsx.scenes.demo.tracing import colours_of, depth_of, points_at, render
from gsx.scenes.options import SceneOptions, refuse_other
from gsx.scenes.splits import parse_rule

SAME = 1e-6  # intrinsics that agree to this many pixels are the same
VERSION = "e26aec382d8f4c08"  # of the pictures, in protocols and the cache: give another where a pixel changes


@dataclass(frozen=True, kw_only=True)
class RayCastOptions(SceneOptions):
    """Options of both built-in scenes; `path` and options of photographs do not apply.

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
    depth_maps: bool = False
    """Training views have exact depth maps. The default: runs older than this option."""
    fisheye: Annotated[float, Range(0, 170)] = 0.0
    """Horizontal angle of view of a fisheye for all cameras, degrees; 0: pinholes. `lens` decides its use."""


@dataclass(frozen=True, kw_only=True)
class DemoOptions(RayCastOptions):
    """Options of `conf/scene/demo.yaml`."""

    distances: str = "even"
    """even: all cameras at similar distances; mixed: most of them three times as far, one in eight near. The default:
    runs older than this option."""

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_other("distances", self.distances, DISTANCES)


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

    def exact_depth(self, camera: Camera) -> Float[Tensor, "H W"]:
        """Return camera z of the surface at each pixel's centre, scene units; infinite in the sky."""
        return depth_of(self.life, camera)

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


def with_depth(view: View) -> View:
    """Return a view with its exact depth map, 0 in the sky."""
    source = view.source.source if isinstance(view.source, StraightenedSource) else view.source
    assert isinstance(source, DemoSource)
    return replace(view, depth_map=lambda: source.exact_depth(view.camera).nan_to_num(posinf=0.0))


def same_view(camera: Camera, own: Camera) -> bool:
    """Return whether `camera` is `own` at some resolution, and no crop of it."""
    back = camera.resize(*own.size)
    intrinsics = ((back.fx, own.fx), (back.fy, own.fy), (back.cx, own.cx), (back.cy, own.cy))
    same = camera.has_pose_of(own) and camera.lens == own.lens
    return same and all(abs(a - b) < SAME for a, b in intrinsics)


def camera_key(camera: Camera) -> str:
    """Digest everything that a picture depends on."""
    pose = camera.rotation.tolist(), camera.translation.tolist()
    lens = [] if camera.lens is None else [repr(camera.lens)]
    return content_key(*pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, *lens)


def sample_points(life: StillLife, cameras: Sequence[Camera], count: int, generator: torch.Generator) -> PointCloud:
    """Return coloured points where random rays of the cameras meet surfaces and sky, equally many from each."""
    shares = [count // len(cameras) + (index < count % len(cameras)) for index in range(len(cameras))]
    places = [random_places(camera, share, generator) for camera, share in zip(cameras, shares, strict=True)]
    hits = points_at(life, cameras, places)
    return PointCloud(hits.points.T.contiguous(), (colours_of(life, hits).T.contiguous() * 255.0 + 0.5).to(torch.uint8))


def random_places(camera: Camera, count: int, generator: torch.Generator) -> Float[Tensor, "2 count"]:
    """Draw places in the picture of a camera, px, float64."""
    return torch.rand(2, count, generator=generator, dtype=torch.float64) * torch.tensor([camera.size]).T


def check(options: RayCastOptions) -> None:
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


def make_views(
    prefix: str, cameras: Mapping[str, Sequence[Camera]], source: Callable[[str, Camera], DemoSource]
) -> list[View]:
    """Return numbered views of cameras by group, each with its own source."""
    listed = [(camera, group) for group, members in cameras.items() for camera in members]
    names = [f"{prefix}_{index:03d}" for index in range(len(listed))]
    return [
        View(name, camera, source(name, camera), group) for name, (camera, group) in zip(names, listed, strict=True)
    ]


def load(options: DemoOptions) -> Scene:
    """Return the built-in scene, whose pictures are rendered at first use; ConfigError: see `check`."""
    check(options)
    cameras = cameras_of(options)
    return scene_of(options, make_still_life(), cameras, sample_points, "demo", VERSION)


def cameras_of(options: DemoOptions) -> Cameras:
    """Place the cameras around the still life; ConfigError: see `mixed_cameras`."""
    counts, size = (options.train_views, options.test_views), size_of(options)
    if options.distances == "mixed":
        return mixed_cameras(*counts, size)
    return even_cameras(spiral_camera, "a spiral", *counts, size)


def size_of(options: RayCastOptions) -> tuple[int, int]:
    """Return (width, height) of training pictures, px."""
    return training_size(options.width, options.height, options.downscale, options.max_width)


PointsOf = Callable[[StillLife, Sequence[Camera], int, torch.Generator], PointCloud]
"""(things, cameras, count, generator) -> initial points."""


def scene_of(
    options: RayCastOptions,
    life: StillLife,
    cameras: Cameras,
    points: PointsOf,
    name: str,
    version: str,
    floor: float = 0.0,
) -> Scene:
    """Return the scene of things and cameras.

    name, version: of the format and its cached pictures; floor: its height, scene units.
    """
    cache = ImageCache(int(options.cache_gb * 1e9))
    if options.fisheye:
        cameras = through_fisheye(cameras, options.fisheye)

    def source(view: str, camera: Camera, somebody: bool) -> DemoSource:
        things = with_passer_by(life, camera, view, floor) if somebody else life
        who = ("passer by", view) if somebody else ()
        folder = cache_folder(name, content_key(version, options.samples, *who))
        return DemoSource(life=things, own=camera, samples=options.samples, cache=cache, folder=folder)

    train_views = make_views("train", cameras.train, partial(source, somebody=options.passer_by))
    test_views = make_views("test", cameras.test, partial(source, somebody=False))
    train, every = [view.camera for view in train_views], options.split == "none"
    made_of = points(life, train, options.points, torch.Generator().manual_seed(options.seed))
    if options.fisheye and options.lens == "undistort":
        train_views, test_views = (straightened(views, cache) for views in (train_views, test_views))
    if options.depth_maps:
        train_views = [with_depth(view) for view in train_views]
    return Scene(
        name=options.name,
        train=[*train_views, *test_views] if every else train_views,
        test=[] if every else test_views,
        points=made_of,
        background=torch.tensor(options.background),
        extent=extent_of(train),
        notes=["somebody stands before each training camera (scene.passer_by)"] if options.passer_by else [],
        provenance=provenance(options, name, version, cameras.split),
    )


def provenance(options: RayCastOptions, name: str, version: str, split: str) -> dict[str, Any]:
    """Return everything that decides the pictures, for the evaluation protocol; `split`: of its cameras."""
    somebody = {"passer_by": True} if options.passer_by else {}
    lens = {"fisheye": options.fisheye, "lens": options.lens} if options.fisheye else {}
    return somebody | {
        **lens,
        "format": name,
        "version": version,
        "size": list(size_of(options)),
        "samples": options.samples,
        "light": "display",
        "split": split + (", all trained on" if options.split == "none" else ""),
    }
