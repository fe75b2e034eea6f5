"""Clone and split across levels of detail: Octree-GS on free Gaussians (GSOctree).

Small Gaussians with large gradients get a copy on their own level; large ones stay and get one smaller child on the
next level. A Gaussian's level is its only link to the octree.
"""

import logging
import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from gsx.backbones.anchor_options import Quirks
from gsx.backbones.capacity import mark_newborn, without_newborn
from gsx.backbones.cells import pooled_max
from gsx.backbones.density import mean_gradient, over_cap, sampled_means, within_room
from gsx.backbones.density_control import DensityControl
from gsx.backbones.gs3d_options import GS3DOptions
from gsx.backbones.levels import Levels, drawn, facts_of, initial_nodes, kept, note_of, thresholds, warnings_of
from gsx.backbones.visibility import Visibility, VisibleGaussians
from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.ranges import Range, Share, Weight
from gsx.core.rasterizer import take_rows
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import Backbone, BackboneContext
from gsx.core.training.parameter_table import ParameterTable, append_rows, detached_rows

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class LevelDensityOptions:
    """Options of density control across levels; values in conf/backbone, with their sources."""

    update_ratio: Annotated[float, Range(0, 100)]
    """The gradient threshold grows by fork ** this per level."""
    bias_gradient: Annotated[float, Range(0, 100)]
    """Multiple of the threshold above which a Gaussian is drawn from farther away."""
    bias_step: Annotated[float, Range(0, 100)]
    """Increase of its level bias, in levels."""
    shrink: Share
    """Scale of a child over its parent's."""
    volume_weight: Weight
    """Weight of the mean volume of the drawn Gaussians in the loss."""

    def __post_init__(self) -> None:
        if not self.shrink > 0:
            raise ValueError(f"backbone.clone_split.level_density.shrink is {self.shrink}; give 0 < shrink <= 1")


class DensifyMasks(NamedTuple):
    """Decisions for N Gaussians."""

    cloned: Bool[Tensor, "N"]
    split: Bool[Tensor, "N"]
    biased: Bool[Tensor, "N"]


def starting_points(points: PointCloud, levels: Levels) -> tuple[PointCloud, dict[str, Tensor]]:
    """Returns initial (points, columns): nodes of the levels, half a cell beyond, with the largest colours in each.

    Source: Octree-GS, octree_sample and weed_out; GSOctree.
    """
    positions, of, group = initial_nodes(points.positions.float(), levels)
    colours = pooled_max(points.colours.repeat(levels.count, 1).float(), group.flatten(), len(positions))
    shifted = positions + levels.cell_of(of)[:, None] / 2
    cloud = PointCloud(positions=shifted, colours=colours.to(torch.uint8))
    return cloud, {"level": of, "bias": torch.zeros(len(of))}


def relative_sizes(scales: Float[Tensor, "N 3"], of: Int[Tensor, "N"], count: int) -> Float[Tensor, "K"]:
    """Returns the mean scale of each level over that of level 0 (GSOctree); 1 if either is empty."""
    sizes = scales.double().mean(1)  # a mean per level: sums by index have no fixed order on a GPU
    means = torch.stack([sizes[of == level].sum() / (of == level).sum().clamp_min(1) for level in range(count)])
    known = (means > 0) & (means[0] > 0)
    return torch.where(known, means / means[0].clamp_min(torch.finfo(means.dtype).tiny), 1.0).to(scales)


def densify_masks(
    gradient: Float[Tensor, "N"],
    scales: Float[Tensor, "N 3"],
    of: Int[Tensor, "N"],
    levels: Levels,
    options: LevelDensityOptions,
    *,
    threshold: float,
    large: float,
    splitting: bool,
) -> DensifyMasks:
    """Marks Gaussians to clone, to split and to draw from farther, by their level's threshold and size (GSOctree).

    `threshold` and `large` (a scale, world units) are those of level 0; without `splitting` large ones are skipped.
    Ours: Gaussians without gradient are never chosen.
    """
    taus = torch.tensor(thresholds(threshold, levels.fork, options.update_ratio, levels.count)).to(gradient)
    tau = taus[of.long()]
    big = scales.amax(1) > large * relative_sizes(scales, of, levels.count)[of.long()]
    chosen = (gradient >= tau) & (gradient > 0) & (~big | splitting)
    biased = (gradient >= options.bias_gradient * tau) & (gradient > 0) & (~big | splitting)
    return DensifyMasks(cloned=chosen & ~big, split=chosen & big, biased=biased)


def clones(raw: dict[str, Tensor], rows: Int[Tensor, "M"]) -> dict[str, Tensor]:
    """Copies rows on the same level, with bias 0."""
    return {name: value[rows] for name, value in raw.items()} | {"bias": torch.zeros_like(raw["bias"][rows])}


def small_children(
    raw: dict[str, Tensor], rows: Int[Tensor, "M"], levels: Levels, shrink: float, generator: torch.Generator
) -> dict[str, Tensor]:
    """Draws one child from each parent's Gaussian, smaller and a level finer, with bias 0."""
    parents = {name: value[rows] for name, value in raw.items()}
    changed = {
        "means": sampled_means(parents, generator),
        "log_scales": parents["log_scales"] + math.log(shrink),
        "level": (parents["level"] + 1).clamp_max(levels.count - 1),
        "bias": torch.zeros_like(parents["bias"]),
    }
    return parents | changed


class VisibleByLevel(Visibility):
    """Visibility by level: a camera draws the levels that its distance needs (Octree-GS)."""

    by_level = True

    def __init__(self, levels: Levels) -> None:
        self.levels = levels

    def start(self, points: PointCloud) -> tuple[PointCloud, dict[str, Tensor]]:
        """Returns the nodes of the levels and the columns `level` and `bias`."""
        cloud, columns = starting_points(points, self.levels)
        for warning in warnings_of(self.levels, len(cloud)):
            logger.warning("%s", warning)
        return cloud, columns

    def visible(self, table: ParameterTable, camera: Camera, step: int) -> VisibleGaussians:
        """Returns the Gaussians of the levels that the camera draws, faded by the mode (Octree-GS, set_anchor_mask)."""
        means, level, bias = (table[name] for name in ("means", "level", "bias"))
        mask, weights = drawn(self.levels, means.detach(), level, bias, camera, self.levels.highest(step))
        rows = mask.nonzero()[:, 0]
        values = {name: take_rows(parameter, rows) for name, parameter in table.parameters.items()}
        values |= {name: column[rows] for name, column in table.columns.items()}
        return VisibleGaussians(values=values, rows=rows, weights=weights[rows])

    def columns(self, table: ParameterTable) -> dict[str, Tensor]:
        """Returns levels, bias, and the distance beyond which only level 0 is drawn (GSOctree, save_ply)."""
        info = torch.zeros_like(table["bias"])
        info[:1] = self.levels.farthest
        return {"level": table["level"].float(), "extra_level": table["bias"], "info": info}

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Returns the figures of the levels."""
        return {"levels": facts_of(self.levels, table["level"])}

    def notes(self) -> list[str]:
        """Returns how a viewer chooses the levels at a distance."""
        return [note_of(self.levels)]


class CloneSplitAcrossLevels(DensityControl):
    """Density control that copies small Gaussians and adds children of large ones a level finer (GSOctree)."""

    def __init__(
        self,
        options: GS3DOptions,
        context: BackboneContext,
        levels: Levels,
        level_density: LevelDensityOptions,
        quirks: Quirks,
    ) -> None:
        super().__init__(options, context)
        self.levels, self.level_density, self.quirks = levels, level_density, quirks
        self.volume_weight = level_density.volume_weight

    def add(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Adds the copies and children that enough cameras draw; parents stay."""
        table, levels, options = model.table, self.levels, self.level_density
        gradient = mean_gradient(table)
        masks = densify_masks(
            gradient,
            table["log_scales"].detach().exp(),
            table["level"],
            levels,
            options,
            threshold=self.options.gradient,
            large=self.options.split_extent * self.extent,
            splitting=self.quirks.gate == "open" or levels.highest(step) == levels.count - 1,
        )
        cloned, split = (mask.nonzero()[:, 0] for mask in (masks.cloned, masks.split))
        raw = detached_rows(table)
        parts = clones(raw, cloned), small_children(raw, split, levels, options.shrink, self.generator)
        new = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        visible = kept(levels, new["means"], new["level"])
        room = self.capacity.room(table, int(visible.sum()), step)
        keep = within_room(visible, gradient[torch.cat([cloned, split])], room)
        table["bias"].add_(options.bias_step * masks.biased)
        table["bias"].clamp_max_(1.0 if self.quirks.bias == "own" else math.inf)
        old = len(table)
        append_rows(table, {name: value[keep] for name, value in new.items()})
        mark_newborn(table, old)
        metrics = {"cloned": int(keep[: len(cloned)].sum()), "split": int(keep[len(cloned) :].sum())}
        return metrics | ({} if self.capacity.ranked else over_cap(visible, keep))

    def before_last_event(self, table: ParameterTable) -> ParameterTable | None:
        """Returns the table without the copies and children of the last event."""
        return without_newborn(table)
