"""What a trade is measured on: the model of a run, a splat file, or the points of a scene; and the cameras."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.backbones.neighbours import mean_square_distance
from gsx.core.data.camera import NEAR, Camera, look_at
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.errors import ConfigError, InputError
from gsx.core.gaussians.drawn import splats_of
from gsx.core.gaussians.splats import Splats
from gsx.core.plugins import Plugins
from gsx.core.rasterizer import RasterSettings
from gsx.core.shapes import Float
from gsx.core.training.render import splats_for
from gsx.experiments.runs.build import choose_device
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run
from gsx.formats.splat_files import read_around
from gsx.formats.suffixes import READABLE, suffix_of

FILE_SIZE = (640, 480)
"""Raster of the views of a splat file, px."""
FIELD_OF_VIEW = math.radians(60)
ELEVATION = math.radians(25)
DISTANCE = 1.3
"""Times the distance at which the sphere of half the splats fills the picture."""
FILE_KEYS = ("rasterizer", "device", "seed", "axes")
"""What can be overridden for a splat file, which brings no scene."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """Splats as one camera is given them."""

    name: str
    camera: Camera
    splats: Splats
    """Without gradients."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Subject:
    """A model, the shots of it that are rendered, and the settings to start from."""

    name: str
    notes: tuple[str, ...]
    """What a user should know about the choice of model and views."""
    shots: tuple[Shot, ...]
    background: Float[Tensor, "3"]
    raster: RasterSettings
    device: torch.device
    seed: int


def open_subject(target: Path | None, overrides: Sequence[str], views: int, plugins: Plugins) -> Subject:
    """The model named on the command line: a run folder, a splat file, or None for the points of a scene.

    Raises:
        ConfigError, InputError: there is no such model, or an override is wrong.
    """
    if target is None:
        return subject_of_points(overrides, views, plugins)
    if target.is_dir():
        return subject_of_run(target, overrides, views, plugins)
    if not target.exists():
        raise InputError(
            f"'{target}' does not exist: give a run folder, a splat file, or nothing for the built-in scene"
        )
    if not suffix_of(target):
        raise InputError(
            f"'{target}' is neither a run folder nor a splat file ({READABLE}): `gsx export RUN` writes one"
        )
    return subject_of_file(target, overrides, views, plugins)


# -- a run ---------------------------------------------------------------------------------------------------------


def subject_of_run(folder: Path, overrides: Sequence[str], views: int, plugins: Plugins) -> Subject:
    """The model of a run, seen by its test views."""
    run, settings = open_run(folder, plugins, overrides)
    chosen, note = choose_views(run.scene, views)
    shots = []
    for view in chosen:
        values = {name: value.detach().clone() for name, value in vars(splats_for(run, view.camera)).items()}
        shots.append(Shot(name=view.name, camera=view.camera, splats=Splats(**values)))
    return Subject(
        name=f"run {folder} at step {run.step:,}",
        notes=(note,),
        shots=tuple(shots),
        background=run.background,
        raster=run.raster,
        device=run.device,
        seed=settings.general.seed,
    )


def choose_views(scene: Scene, count: int) -> tuple[list[View], str]:
    """Views evenly spread over the test views, over all views where those are too few; and which, in words."""
    pool, kind = (scene.test, "test views") if len(scene.test) >= count else ([*scene.test, *scene.train], "views")
    count = min(count, len(pool))
    chosen = [pool[i * len(pool) // count] for i in range(count)]
    return chosen, f"{count} of {len(pool)} {kind}: {', '.join(view.name for view in chosen)}"


# -- points of a scene ---------------------------------------------------------------------------------------------


def subject_of_points(overrides: Sequence[str], views: int, plugins: Plugins) -> Subject:
    """The points of a scene as splats of random shape: something to measure where there is no model yet."""
    settings = compose(overrides, plugins)
    device, seed = choose_device(settings.general.device), settings.general.seed
    scene = load_scene(settings)
    splats = on(splats_on(scene.points, torch.Generator().manual_seed(seed)), device)
    chosen, note = choose_views(scene, views)
    return Subject(
        name=f"points of scene {scene.name} as random splats",
        notes=(
            f"no model given: the {len(splats):,} points of scene {scene.name} stand in for one, with random shapes "
            "and opacities; give a run folder or a splat file to measure yours",
            note,
        ),
        shots=tuple(Shot(name=view.name, camera=view.camera, splats=splats) for view in chosen),
        background=scene.background.to(device),
        raster=settings.raster,
        device=device,
        seed=seed,
    )


def splats_on(points: PointCloud, generator: torch.Generator) -> Splats:
    """Splats at points: as large as their neighbours are far, orientations, elongations and opacities random.

    Raises:
        InputError: there are no points.
    """
    count = len(points)
    if count == 0:
        raise InputError("the scene has no points to make splats of: choose another, or give a run or a splat file")
    spacing = mean_square_distance(points.positions).sqrt().clamp_min(1e-6)
    return Splats(
        means=points.positions,
        scales=spacing[:, None] * torch.exp(0.7 * torch.randn(count, 3, generator=generator)),
        quats=torch.randn(count, 4, generator=generator),
        log_opacities=logsigmoid(2 * torch.randn(count, generator=generator)),
        colours=points.colours.float() / 255,
    )


def on(splats: Splats, device: torch.device) -> Splats:
    """The same on a device."""
    return Splats(**{name: value.to(device) for name, value in vars(splats).items()})


# -- a splat file --------------------------------------------------------------------------------------------------


def subject_of_file(path: Path, overrides: Sequence[str], views: int, plugins: Plugins) -> Subject:
    """The splats of a file, seen from around their middle."""
    settings = compose(overrides, plugins)
    for override in overrides:
        if override.partition("=")[0].lstrip("+~").split(".")[0] not in FILE_KEYS:
            raise ConfigError(f"'{override}' means nothing to a splat file: override only {', '.join(FILE_KEYS)}")
    device = choose_device(settings.general.device)
    gaussians, _ = read_around(path, settings.general.axes)
    cameras, note = framing_cameras(gaussians.means, views, path)
    shots = [
        Shot(name=f"around {i}", camera=camera, splats=on(splats_of(gaussians, camera.centre), device))
        for i, camera in enumerate(cameras, 1)
    ]
    return Subject(
        name=f"{path}, {len(gaussians.means):,} splats",
        notes=(note, "black background"),
        shots=tuple(shots),
        background=torch.zeros(3, device=device),
        raster=settings.raster,
        device=device,
        seed=settings.general.seed,
    )


def framing_cameras(means: Float[Tensor, "N 3"], count: int, path: Path) -> tuple[list[Camera], str]:
    """Cameras on a circle around the median of the splats that frame the nearer half of them; and where, in words.

    Up is the direction in which that half is thinnest; of its two signs the one nearer -y and +z, as in most files.

    Raises:
        InputError: no splat has a finite position.
    """
    points = means[torch.isfinite(means).all(1)].double()
    if not len(points):
        raise InputError(f"{path} holds no splats with finite positions: export it anew")
    centre = points.median(0).values
    offsets = points - centre
    radius = float(offsets.norm(dim=1).median()) or 1.0
    inner = offsets[offsets.norm(dim=1) <= radius]
    up, first, second = torch.linalg.eigh(inner.T @ inner).eigenvectors.T.unbind(0)
    up = up if float(up[2] - up[1]) >= 0 else -up
    distance = DISTANCE * radius / math.sin(FIELD_OF_VIEW / 2)
    (width, height), cameras = FILE_SIZE, []
    for i in range(count):
        bearing = 2 * math.pi * i / count
        side = math.cos(bearing) * first + math.sin(bearing) * second
        eye = centre + distance * (math.cos(ELEVATION) * side + math.sin(ELEVATION) * up)
        camera = look_at(eye.tolist(), centre.tolist(), up=up.tolist(), fov_x=FIELD_OF_VIEW, width=width, height=height)
        cameras.append(replace(camera, near=min(NEAR, distance / 20)))
    place = ", ".join(f"{value:.3g}" for value in centre.tolist())
    views = "1 view" if count == 1 else f"{count} views"
    return cameras, (
        f"{views} of {width}x{height} px on a circle around the median ({place}), at distance {distance:.3g}, "
        f"{math.degrees(ELEVATION):.0f} degrees up, {math.degrees(FIELD_OF_VIEW):.0f} degrees wide"
    )
