"""Clone and split across levels of detail: Octree-GS on free Gaussians (GSOctree).

Small Gaussians with large gradients get a copy on their own level. Large ones get one smaller child on the next level
and stay as they are. Without pointers between levels, a Gaussian's level is all that ties it to the octree.
"""

import logging
import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.backbones.capacity import mark_newborn, without_newborn
from gsx.backbones.cells import pooled_max
from gsx.backbones.density import mean_gradient, withheld, within_room
from gsx.backbones.density_control import DensityControl
from gsx.backbones.growth_options import Quirks
from gsx.backbones.gs3d_parts import Shown
from gsx.backbones.levels import Levels, drawn, facts_of, initial_nodes, kept, note_of, thresholds, warnings_of
from gsx.backbones.sampling import sampled_means
from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.quality.losses import volume_loss
from gsx.core.ranges import Range, Share, Weight
from gsx.core.rasterizer import take_rows
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import Backbone, DrawnSplats
from gsx.core.training.parameter_table import ParameterTable, append_rows, detached_rows

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class LevelDensityOptions:
    """Numbers of density control across levels; values in conf/backbone, with their sources."""

    update_ratio: Annotated[float, Range(0, 100)]
    """The gradient threshold grows by fork ** this per level."""
    bias_gradient: Annotated[float, Range(0, 100)]
    """Gaussians with this multiple of the threshold are drawn from a little farther."""
    bias_step: Annotated[float, Range(0, 100)]
    """By how much, in levels."""
    shrink: Share
    """A child's scale is its parent's times this."""
    volume_weight: Weight
    """Of the mean volume of the Gaussians drawn, in the loss."""

    def __post_init__(self) -> None:
        if not self.shrink > 0:
            raise ValueError(f"backbone.clone_split.level_density.shrink is {self.shrink}; give 0 < shrink <= 1")


@dataclass(frozen=True, eq=False, kw_only=True)
class DensifyMasks:
    """What happens to each of N Gaussians."""

    cloned: Bool[Tensor, "N"]
    split: Bool[Tensor, "N"]
    biased: Bool[Tensor, "N"]


def starting_points(points: PointCloud, levels: Levels) -> tuple[PointCloud, dict[str, Tensor]]:
    """(points, columns) to start from: the nodes of the levels, half a cell beyond, with their cells' largest colours.

    Source: Octree-GS, octree_sample and weed_out; GSOctree.
    """
    positions, of, group = initial_nodes(points.positions.float(), levels)
    colours = pooled_max(points.colours.repeat(levels.count, 1).float(), group.flatten(), len(positions))
    shifted = positions + levels.cell_of(of)[:, None] / 2
    cloud = PointCloud(positions=shifted, colours=colours.to(torch.uint8))
    return cloud, {"level": of, "bias": torch.zeros(len(of))}


def relative_sizes(scales: Float[Tensor, "N 3"], of: Int[Tensor, "N"], count: int) -> Float[Tensor, "K"]:
    """Mean scale of each level over that of level 0 (GSOctree); 1 where one of them is empty: nothing to compare."""
    sizes = scales.double().mean(1)  # a mean for each level by itself: sums by index have no fixed order on a GPU
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
    """Who is cloned, split and drawn from farther: each by the threshold and the size of its own level (GSOctree).

    `threshold` and `large` (a scale, world units) are those of level 0; without `splitting` nothing happens to large
    ones. Ours: never a Gaussian without any gradient.
    """
    taus = torch.tensor(thresholds(threshold, levels.fork, options.update_ratio, levels.count)).to(gradient)
    tau = taus[of.long()]
    big = scales.amax(1) > large * relative_sizes(scales, of, levels.count)[of.long()]
    chosen = (gradient >= tau) & (gradient > 0) & (~big | splitting)
    biased = (gradient >= options.bias_gradient * tau) & (gradient > 0) & (~big | splitting)
    return DensifyMasks(cloned=chosen & ~big, split=chosen & big, biased=biased)


def clones(raw: dict[str, Tensor], rows: Int[Tensor, "M"]) -> dict[str, Tensor]:
    """Copies on the same level, without bias."""
    return without_bias({name: value[rows] for name, value in raw.items()})


def small_children(
    raw: dict[str, Tensor], rows: Int[Tensor, "M"], levels: Levels, shrink: float, generator: torch.Generator
) -> dict[str, Tensor]:
    """One child each, drawn from its parent's Gaussian, smaller and a level finer, without bias."""
    parents = {name: value[rows] for name, value in raw.items()}
    changed = {
        "means": sampled_means(parents, generator),
        "log_scales": parents["log_scales"] + math.log(shrink),
        "level": (parents["level"] + 1).clamp_max(levels.count - 1),
    }
    return without_bias(parents | changed)


def without_bias(rows: dict[str, Tensor]) -> dict[str, Tensor]:
    """New Gaussians are drawn from no farther than their level."""
    return rows | {"bias": torch.zeros_like(rows["bias"])}


def bias_levels(table: ParameterTable, biased: Bool[Tensor, "N"], step: float, most: float) -> None:
    """Let Gaussians with fair gradients be drawn from a little farther, by at most so many levels."""
    table["bias"][: len(biased)] += step * biased
    table["bias"].clamp_max_(most)


class VisibleByLevel:
    """A camera draws the Gaussians of the levels that its distance asks for (Octree-GS)."""

    def __init__(self, levels: Levels) -> None:
        self.levels = levels

    def start(self, points: PointCloud) -> tuple[PointCloud, dict[str, Tensor]]:
        """The nodes of the levels; columns `level` and `bias`."""
        cloud, columns = starting_points(points, self.levels)
        for warning in warnings_of(self.levels, len(cloud)):
            logger.warning("%s", warning)
        return cloud, columns

    def shown(self, table: ParameterTable, camera: Camera, step: int) -> Shown:
        """Those of the levels that the camera draws, faded where the mode says so (Octree-GS, set_anchor_mask)."""
        means, level, bias = (table[name] for name in ("means", "level", "bias"))
        mask, weights = drawn(self.levels, means.detach(), level, bias, camera, self.levels.highest(step))
        rows = mask.nonzero()[:, 0]
        values = {name: take_rows(parameter, rows) for name, parameter in table.parameters.items()}
        values |= {name: column[rows] for name, column in table.columns.items()}
        return Shown(values=values, rows=rows, weights=weights[rows])

    def columns(self, table: ParameterTable) -> dict[str, Tensor]:
        """Levels, and the distance at which the coarsest alone is drawn (GSOctree, save_ply)."""
        info = torch.zeros_like(table["bias"])
        info[:1] = self.levels.farthest
        return {"level": table["level"].float(), "extra_level": table["bias"], "info": info}

    def plan(self, table: ParameterTable) -> dict[str, Any]:
        """Levels in numbers."""
        return {"levels": facts_of(self.levels, table["level"])}

    def notes(self) -> list[str]:
        """What chooses the levels at a distance."""
        return [note_of(self.levels)]


class CloneSplitAcrossLevels:
    """Copies of small Gaussians on their level, children of large ones a level finer (GSOctree)."""

    resets = False  # the published schedule does not reach a reset

    def __init__(self, visibility: VisibleByLevel, options: LevelDensityOptions, quirks: Quirks) -> None:
        self.visibility, self.options, self.quirks = visibility, options, quirks

    def densify(self, control: DensityControl, model: Backbone[Any], step: int) -> dict[str, float]:
        """Parents stay; what too few cameras would draw is not made."""
        table = model.table
        levels, options, gradient = self.visibility.levels, self.options, mean_gradient(table)
        masks = densify_masks(
            gradient,
            table["log_scales"].detach().exp(),
            table["level"],
            levels,
            options,
            threshold=control.options.gradient,
            large=control.options.split_extent * control.extent,
            splitting=self.quirks.gate == "open" or levels.highest(step) == levels.count - 1,
        )
        cloned, split = (mask.nonzero()[:, 0] for mask in (masks.cloned, masks.split))
        raw = detached_rows(table)
        parts = clones(raw, cloned), small_children(raw, split, levels, options.shrink, control.generator)
        new = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        seen = kept(levels, new["means"], new["level"])
        keep = within_room(
            seen, gradient[torch.cat([cloned, split])], control.capacity.room(table, int(seen.sum()), step)
        )
        bias_levels(table, masks.biased, options.bias_step, 1.0 if self.quirks.bias == "own" else math.inf)
        old = len(table)
        append_rows(table, {name: value[keep] for name, value in new.items()})
        mark_newborn(table, old)
        done = {"cloned": int(keep[: len(cloned)].sum()), "split": int(keep[len(cloned) :].sum())}
        return done | ({} if control.capacity.ranked else withheld(seen, keep))

    def undone(self, table: ParameterTable) -> ParameterTable | None:
        """Without the copies and children."""
        return without_newborn(table)

    def regulariser(self, drawn: DrawnSplats) -> Float[Tensor, ""] | None:
        """Mean volume of what was drawn, 0 for nothing."""
        if not self.options.volume_weight:
            return None
        return volume_loss(drawn.splats.scales, self.options.volume_weight)
