"""Clone and split across levels of detail: Octree-GS on free Gaussians (GSOctree, spec 4B).

Small Gaussians with large gradients get a copy on their own level. Large ones get one smaller child on the next level
and stay as they are. Without pointers between levels, a Gaussian's level is all that ties it to the octree.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.backbones.cells import pooled_max
from gsx.backbones.levels import Levels, initial_nodes, kept, thresholds
from gsx.backbones.sampling import sampled_means
from gsx.core.density import Table
from gsx.core.scene import PointCloud
from gsx.core.shapes import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class LevelDensityOptions:
    """Numbers of density control across levels; values in conf/backbone, with their sources."""

    update_ratio: float
    """The gradient threshold grows by fork ** this per level."""
    bias_gradient: float
    """Gaussians with this multiple of the threshold are drawn from a little farther."""
    bias_step: float
    """By how much, in levels."""
    shrink: float
    """A child's scale is its parent's times this."""
    gate: bool
    """Split only once all levels take part in training, as the reference means to but does not."""
    volume_weight: float
    """Of the mean volume of the Gaussians drawn, in the loss."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Verdict:
    """What happens to each of N Gaussians."""

    cloned: Bool[Tensor, "N"]
    split: Bool[Tensor, "N"]
    biased: Bool[Tensor, "N"]


def starting_points(points: PointCloud, levels: Levels) -> tuple[PointCloud, dict[str, Tensor]]:
    """(points, columns) to start from: the nodes of the levels, half a cell beyond, with their cells' largest colours.

    Source: spec 3.3, 3.4, 4B.
    """
    positions, of, group = initial_nodes(points.positions.float(), levels)
    colours = pooled_max(points.colours.repeat(levels.count, 1).float(), group.flatten(), len(positions))
    shifted = positions + levels.cell_of(of)[:, None] / 2
    cloud = PointCloud(positions=shifted, colours=colours.to(torch.uint8))
    return cloud, {"level": of, "bias": torch.zeros(len(of))}


def relative_sizes(scales: Float[Tensor, "N 3"], of: Int[Tensor, "N"], count: int) -> Float[Tensor, "K"]:
    """Mean scale of each level over that of level 0 (spec 4B); 1 where one of them is empty: nothing to compare."""
    sums = torch.zeros(count, device=scales.device).index_add_(0, of.long(), scales.mean(1))
    means = sums / of.long().bincount(minlength=count).clamp_min(1)
    known = (means > 0) & (means[0] > 0)
    return torch.where(known, means / means[0].clamp_min(torch.finfo(means.dtype).tiny), 1.0)


def judged(
    gradient: Float[Tensor, "N"],
    scales: Float[Tensor, "N 3"],
    of: Int[Tensor, "N"],
    levels: Levels,
    options: LevelDensityOptions,
    *,
    threshold: float,
    large: float,
) -> Verdict:
    """Who is cloned, split and drawn from farther: each by the threshold and the size of its own level (spec 4B).

    `threshold` and `large` (a scale, world units) are those of level 0. Ours: never a Gaussian without any gradient.
    """
    taus = torch.tensor(thresholds(threshold, levels.fork, options.update_ratio, levels.count)).to(gradient)
    tau = taus[of.long()]
    split = scales.amax(1) > large * relative_sizes(scales, of, levels.count)[of.long()]
    chosen = (gradient >= tau) & (gradient > 0)
    return Verdict(cloned=chosen & ~split, split=chosen & split, biased=gradient >= options.bias_gradient * tau)


def clones(raw: dict[str, Tensor], cloned: Bool[Tensor, "N"], levels: Levels) -> dict[str, Tensor]:
    """Copies on the same level, without bias, of those that enough cameras would draw."""
    return weeded({name: value[cloned] for name, value in raw.items()}, levels)


def small_children(
    raw: dict[str, Tensor], split: Bool[Tensor, "N"], levels: Levels, shrink: float, generator: torch.Generator
) -> dict[str, Tensor]:
    """One child each, drawn from its parent's Gaussian, smaller and a level finer."""
    rows = {name: value[split] for name, value in raw.items()}
    changed = {
        "means": sampled_means(rows, generator),
        "log_scales": rows["log_scales"] + math.log(shrink),
        "level": (rows["level"] + 1).clamp_max(levels.count - 1),
    }
    return weeded(rows | changed, levels)


def weeded(rows: dict[str, Tensor], levels: Levels) -> dict[str, Tensor]:
    """New Gaussians that enough cameras would draw (spec 3.4), with a bias of 0."""
    keep = kept(levels, rows["means"], rows["level"])
    rows = {name: value[keep] for name, value in rows.items()}
    return rows | {"bias": torch.zeros_like(rows["bias"])}


def stacked(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Rows of several parts, one after another."""
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def bias_levels(table: Table, biased: Bool[Tensor, "N"], step: float) -> None:
    """Let Gaussians with fair gradients be drawn from a little farther."""
    table["bias"][: len(biased)] += step * biased
