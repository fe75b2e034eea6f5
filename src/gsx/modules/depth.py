"""Depth supervision: rays end where depth maps, or points of structure from motion, say that surfaces are.

A render blends v = 1 / z of its splats (or z), and v^2, like colours. With blending weights w the loss at a place with
the measured value t is the root of sum w (v - t)^2 + (1 - sum w) t^2: error and spread of the ray together, where
transparency counts as infinitely far. The spread matters: a wall of large, soft splats can have the right mean. Ours,
after DS-NeRF (Deng et al. 2022), which supervises where the whole ray ends; the loss of means is that of 3D-GS's and
gsplat's trainers. The weight decays log-linearly, as in 3D-GS (train.py, depth_l1_weight_init).
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Depths, Scene, View
from gsx.core.device import upload
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.ranges import Range
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import behind_scene
from gsx.core.training.module import ModuleContext, TrainingModule
from gsx.core.training.run import Run
from gsx.core.training.schedule import log_linear
from gsx.modules.alignment import sample_image
from gsx.modules.corrections import WHEN

logger = logging.getLogger(__name__)

SOURCES = {"maps": ("depth_map",), "points": ("sparse",), "both": ("depth_map", "sparse")}
"""Fields of a view by the values of `source`."""
DOMAINS = ("disparity", "depth")
RAYS = ("whole", "mean")
COUNTS = ("maps", "points", "places")
CHOICES: Mapping[str, Iterable[str]] = {"when": WHEN, "source": SOURCES, "domain": DOMAINS, "rays": RAYS}
MOST_PLACES = 1 << 16
"""Most places of a view's depth map that are used, at random: memory, since depth is smooth."""
LEAST_SQUARE = 1e-6
"""Least squared relative error under a root: the gradient is 0 below, where float32 rounds."""
LEAST_ALPHA = 0.05
"""Least divisor of a mean over a ray."""


@dataclass(frozen=True, kw_only=True)
class DepthOptions:
    """Options; values in conf/module/depth.yaml."""

    when: str = "never"
    """One of WHEN."""
    source: str = "maps"
    """maps; points; both: the map of each view, or points where it has none."""
    points: Annotated[int, Range(0, 10**8)] = 20000
    """Starting points from maps."""
    domain: str = "disparity"
    """disparity: errors of 1 / z, in which far things count less; depth: errors of z."""
    rays: str = "whole"
    """whole: error and spread of each ray; mean: error of its mean."""
    weight: Annotated[float, Range(0, 1e3)] = 0.1
    """Weight in the loss at the first step; 0: no loss."""
    weight_final: Annotated[float, Range(1e-9, 1e3)] = 0.01
    """Weight at the last step; logarithms are interpolated."""

    def __post_init__(self) -> None:
        for key, words in CHOICES.items():
            if (word := getattr(self, key)) not in words:
                raise ValueError(f"training.depth.{key} is '{word}'; choose from {', '.join(words)}")

    def prepare_scene(self, scene: Scene, generator: torch.Generator) -> Scene:
        """Returns the scene that training uses, with starting points from depth maps.

        Raises:
            InputError: there are no measured depths, and `when` is always; or no map is usable.
        """
        known = any(getattr(view, field) is not None for view in scene.train for field in SOURCES[self.source])
        if self.when == "always" and not known:
            raise InputError(
                f"training.depth.when=always, but no training view of '{scene.name}' has measured depths: put depth "
                "maps into a folder 'depths' next to the photos, set training.depth.source=points for the points of a "
                "COLMAP model, or set training.depth.when=never"
            )
        maps = self.when != "never" and self.source != "points"
        return add_depth_points(scene, self.points, generator) if maps else scene


class Depth(TrainingModule):
    """Loss of depths at the measured places of each training view."""

    options: DepthOptions

    def __init__(self, options: DepthOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        self.measured: Mapping[str, Depths] | None = None
        """Depths by name of a view, without views that have none; None: not measured yet."""
        self.cameras = {view.name: view.camera for view in context.scene.train}
        """Cameras that places of depths refer to."""

    def before_step(self, run: Run) -> dict[str, float]:
        """Measures the depths of all views before the first step of a process."""
        if self.measured is not None or self.options.when == "never" or not self.options.weight:
            return {}
        maps, points = measured_depths(self.context.scene, self.options.source)
        self.measured = points | maps
        places = sum(len(one.z) for one in self.measured.values())
        logger.info(
            "step %d: depth of %d of %d views from maps, of %d from points, %s places in all",
            *(run.step + 1, len(maps), len(self.cameras), len(points), f"{places:,}"),
        )
        found: dict[str, float] = {"depth_maps": len(maps), "depth_points": len(points), "depth_places": places}
        return {} if run.step else found  # a resumed run has logged them

    def channels(self, run: Run, splats: Splats, camera: Camera, step: int) -> Float[Tensor, "M 2"] | None:
        """Returns values and squares of the splats, or coverage and values; 0 of splats behind the scene."""
        if not self.measured:
            return None
        near = (~behind_scene(run.backbone, splats.means)).to(splats.colours)
        z = camera.to_camera(splats.means)[:, 2].to(near).clamp_min(camera.near)
        value = z if self.options.domain == "depth" else 1 / z
        pair = (value, value.square()) if self.options.rays == "whole" else (torch.ones_like(value), value)
        return near[:, None] * torch.stack(pair, 1)

    def loss(
        self,
        run: Run,
        view: View,
        step: int,
        camera: Camera,
        blended: Float[Tensor, "K H W"],
        counted: Bool[Tensor, "h w"] | None,
    ) -> Float[Tensor, ""] | None:
        """Returns the weighted mean error at the view's places, relative to their median; None: it has none."""
        depths = (self.measured or {}).get(view.name)
        if depths is None:
            return None
        own, whole = self.cameras[view.name], self.options.rays == "whole"
        counting = depths.weights * counted_at(moved(depths.pixels, own, view.camera), counted)
        places = moved(depths.pixels, own, camera)
        pixels, z, weights = (upload(values, run.device) for values in (places, depths.z, counting))
        target = z if self.options.domain == "depth" else 1 / z
        first, second = sample_image(blended, pixels.T, "bilinear")
        errors = spread_errors(first, second, target) if whole else mean_errors(first, second, target)
        weight = log_linear(step, self.context.iterations, self.options.weight, self.options.weight_final)
        return weight / target.median() * (weights * errors).sum() / weights.sum().clamp_min(1)

    @classmethod
    def summary(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the numbers of views with depths by their source, and of places."""
        first = next((line for line in lines if "depth_places" in line), None)
        return {} if first is None else {"measured_depth": {key: first[f"depth_{key}"] for key in COUNTS}}


# -- measured depths ---------------------------------------------------------------------------------------------------


def measured_depths(scene: Scene, source: str) -> tuple[dict[str, Depths], dict[str, Depths]]:
    """Returns the depths of views from maps, and those of other views from points, by name of the view."""
    maps = dict[str, Depths]()
    for view, depth in () if source == "points" else depth_maps(scene):
        generator = torch.Generator().manual_seed(derived_seed("depth", view.name))
        places, z = random_depths(depth, depth > 0, MOST_PLACES, generator)
        maps[view.name] = Depths(pixels=places, z=z, weights=torch.ones(len(z)))
    others = [] if source == "maps" else [view for view in scene.train if view.name not in maps]
    points = {view.name: view.sparse for view in others if view.sparse is not None and len(view.sparse.z)}
    return maps, points


def depth_maps(scene: Scene) -> Iterator[tuple[View, Float[Tensor, "H W"]]]:
    """Yields training views with their usable depth maps.

    Raises:
        InputError: there are maps, but none is usable.
    """
    with_map, usable = [view for view in scene.train if view.depth_map is not None], 0
    for view in with_map:
        depth = None if view.depth_map is None else view.depth_map()
        if depth is not None and bool((depth > 0).any()):
            usable += 1
            yield view, depth
    if with_map and not usable:
        raise InputError(
            f"none of the {len(with_map)} depth maps of '{scene.name}' fits the points of the scene: check "
            "scene.depth_values (depth or disparity) and scene.depth_unit, or set scene.depth_fit=none for metric maps "
            "of a scene without points"
        )


def random_depths(
    depth: Float[Tensor, "H W"], used: Bool[Tensor, "H W"], count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "K 2"], Float[Tensor, "K"]]:
    """Returns (places, z) of up to `count` random pixels among the used ones."""
    row, column = used.nonzero().unbind(1)
    chosen = torch.randperm(len(row), generator=generator)[:count]
    row, column = row[chosen], column[chosen]
    return torch.stack([column, row], 1) + 0.5, depth[row, column]


def add_depth_points(scene: Scene, count: int, generator: torch.Generator) -> Scene:
    """Adds up to `count` points to a scene from depth maps, equally many from each training view, with a note."""
    share, clouds = -(-count // len(scene.train)), list[tuple[Tensor, Tensor]]()
    for view, depth in depth_maps(scene) if count else ():
        counted = view.counted()
        places, z = random_depths(depth, depth > 0 if counted is None else counted & (depth > 0), share, generator)
        column, row = places.long().unbind(1)
        clouds.append((view.camera.unproject(places, z), view.picture()[:, row, column].T))
    if not clouds:
        return scene
    positions, colours = (torch.cat(parts)[:count] for parts in zip(*clouds, strict=True))
    note = (
        f"{len(positions):,} points from depth maps of {len(clouds)} of {len(scene.train)} training views are added to "
        f"{len(scene.points):,} (training.depth.points)"
    )
    return replace(scene, points=scene.points.joined(positions, colours), notes=[*scene.notes, note])


# -- the loss ----------------------------------------------------------------------------------------------------------


def moved(pixels: Float[Tensor, "K 2"], own: Camera, other: Camera) -> Float[Tensor, "K 2"]:
    """Returns places of a camera on the raster of another that looks the same way."""
    focal = pixels.new_tensor([other.fx / own.fx, other.fy / own.fy])
    return (pixels - pixels.new_tensor([own.cx, own.cy])) * focal + pixels.new_tensor([other.cx, other.cy])


def counted_at(pixels: Float[Tensor, "K 2"], counted: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "K"]:
    """Marks the places whose pixel counts, None: all."""
    if counted is None:
        return torch.ones(len(pixels), dtype=torch.bool)
    column, row = pixels.long().unbind(1)
    height, width = counted.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return inside & counted[row.clamp(0, height - 1), column.clamp(0, width - 1)]


def spread_errors(
    first: Float[Tensor, "K"], second: Float[Tensor, "K"], target: Float[Tensor, "K"]
) -> Float[Tensor, "K"]:
    """Returns the RMS error of rays by blended values and squares; transparency counts as the value 0."""
    squares = second - 2 * target * first + target.square()
    return squares.clamp_min(LEAST_SQUARE * target.square()).sqrt()


def mean_errors(
    coverage: Float[Tensor, "K"], summed: Float[Tensor, "K"], target: Float[Tensor, "K"]
) -> Float[Tensor, "K"]:
    """Returns the absolute error of the mean value of rays."""
    return (summed / coverage.clamp_min(LEAST_ALPHA) - target).abs()
