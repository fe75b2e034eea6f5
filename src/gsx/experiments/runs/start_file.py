"""Runs that begin with somebody's splat file (`init=FILE`) instead of a scene's points."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud, Scene
from gsx.core.errors import ConfigError, InputError
from gsx.core.gaussians.sh import constant_from_colour
from gsx.core.gaussians.splats import Gaussians
from gsx.core.rasterizer import RasterSettings
from gsx.core.shapes import Float
from gsx.core.training.backbone import Backbone, FromGaussians
from gsx.experiments.run_folder.general_options import splat_file
from gsx.experiments.runs.overrides import key_of, quoted
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_checks import doubts_about
from gsx.formats.axis_names import AUTO
from gsx.formats.origin import NO_ORIGIN, Origin, around, in_words, rounding_at, stored_in_single
from gsx.formats.splat_files import SplatContent, compensated, is_linear, read_splats

logger = logging.getLogger(__name__)

OWN_KEYS = ("backbone", "augmenter", "init", "iterations", "variant", "preset", "budget", "experiment")
"""What `gsx eval FILE` sets, or what trains: nothing of it can be overridden."""
BLENDS = (
    "its colours are of linear light and were made sRGB, in which splats are blended here: figures differ from those "
    "of programs that blend in linear light"
)
"""Remark of evaluations on such files."""
MIP_KERNEL = 0.1
"""px^2 by which models of Mip-Splatting are dilated, with opacities compensated (Yu et al. 2024)."""


def starting_splats(settings: Settings) -> SplatContent | None:
    """Returns what the splat file holds that a run begins with, means in float64; None: it begins with points.

    Raises:
        ConfigError: axes are set without a file.
        InputError: the file cannot be read, or holds nothing.
    """
    path, axes = splat_file(settings.general.init), settings.general.axes
    if path is None and axes != AUTO:
        raise ConfigError(f"axes={axes} is about a splat file: give init=FILE, or leave it out")
    if path is None:
        return None
    content = read_splats(path, axes)
    if not len(content.gaussians.means):
        raise InputError(f"init: {path} holds no splats: choose another file")
    logger.info("beginning with the %d splats of %s", len(content.gaussians.means), path)
    return content


def in_scene(gaussians: Gaussians, scene: Scene) -> Gaussians:
    """Returns Gaussians of a file relative to the scene's origin.

    A file that lies around (0, 0, 0), as other programs leave it, is taken as written around that origin.
    """
    origin = origin_of_file(gaussians, scene)
    if origin != scene.origin:
        logger.warning(
            "init: the splats lie around (0, 0, 0), and the scene around %s: taken for coordinates relative to that",
            in_words(scene.origin),
        )
    elif any(origin) and stored_in_single(gaussians.means):
        step = rounding_at(gaussians.means)
        logger.warning("init: positions are stored in single precision, in steps of %.2g scene units there", step)
    return around(gaussians, origin)


def origin_of_file(gaussians: Gaussians, scene: Scene) -> Origin:
    """Returns what to subtract from the positions of a file: the scene's origin, unless that was done before."""
    lies_there = any(scene.origin) and lies_around_zero(gaussians.means, scene.origin)
    return NO_ORIGIN if lies_there else scene.origin


def lies_around_zero(positions: Float[Tensor, "P 3"], origin: Origin) -> bool:
    """Returns whether most positions are nearer to (0, 0, 0) than to an origin."""
    offsets = positions - torch.tensor(origin, dtype=torch.float64)
    return float((positions.norm(dim=1) < offsets.norm(dim=1)).double().mean()) > 0.5


def start_doubts(settings: Settings, scene: Scene, start: Gaussians | None) -> list[str]:
    """Returns why the splat file that a run begins with may not belong to its scene; see `doubts_about`.

    Raises:
        InputError: no splat is in view.
    """
    path = splat_file(settings.general.init)
    if start is None or path is None:
        return []
    doubts = doubts_about(start, scene, path, trains=settings.general.iterations > 0)
    return [*doubts, f"{path.name}: {BLENDS}"] if is_linear(path) else doubts


def go_on_from(backbone: Backbone[Any], gaussians: Gaussians, name: str) -> None:
    """Gives Gaussians to a backbone in place of what it was built with.

    Raises:
        ConfigError: it cannot go on from any.
        InputError: not from these.
    """
    if not isinstance(backbone, FromGaussians):
        raise ConfigError(f"backbone={name} cannot begin with a splat file: choose backbone=gs3d, or leave out init")
    backbone.go_on_from(gaussians)


def in_front_of(camera: Camera) -> Gaussians:
    """Returns one splat on the camera's axis: it stands in until a checkpoint is read."""
    ahead = camera.centre + camera.rotation[2].to(camera.centre)
    return Gaussians(
        means=ahead[None].float(),
        log_scales=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        opacity_logits=torch.zeros(1),
        sh_dc=constant_from_colour(torch.full((1, 3), 0.5)),
        sh_rest=torch.zeros(1, 0, 3),
    )


def one_point(gaussians: Gaussians) -> PointCloud:
    """Returns the first Gaussian as a point: a backbone is built from points, and gets the splats afterwards."""
    return PointCloud(positions=gaussians.means[:1], colours=torch.full((1, 3), 128, dtype=torch.uint8))


def rules_of(path: Path) -> RasterSettings:
    """Returns the rules that a splat file states for its drawing.

    Raises:
        InputError: it cannot be read.
    """
    return RasterSettings(dilation=MIP_KERNEL, compensate=True) if compensated(path) else RasterSettings()


def composition_of(path: Path, overrides: Sequence[str]) -> list[str]:
    """Returns words of the command line that evaluate a splat file on a scene, drawn as it is.

    Raises:
        ConfigError: an override is about what the file is not, or no scene is given.
    """
    for word in overrides:
        if key_of(word) in OWN_KEYS:
            raise ConfigError(f"gsx eval {path} draws the file as it is: leave out '{word}', or train with init={path}")
    if not any(word.startswith(("scene=", "dataset=")) for word in overrides):
        raise ConfigError(f"{path} needs the photographs to compare with: give scene=... scene.path=FOLDER")
    if not path.is_file():
        raise InputError(f"'{path}' does not exist: give a run folder or a splat file")
    words = ["backbone=gs3d", f"init={quoted(str(path))}", "iterations=0"]
    filters = ("rasterizer.dilation=", "rasterizer.compensate=")
    if compensated(path) and not any(word.lstrip("+").startswith(filters) for word in overrides):
        words += [f"rasterizer.dilation={MIP_KERNEL}", "rasterizer.compensate=true"]
        logger.info("%s says that its opacities are compensated: drawn with %s", path, " ".join(words[3:]))
    return [*words, *overrides]
