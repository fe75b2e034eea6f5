"""Adaptive density control's arithmetic: statistics of renders for each primitive, and a cap on additions.

Statistics are per-primitive sums over the renders since the last density event, each counted by its weight in a step's
loss. The photograph of a step of one view weighs 1; of n views each weighs 1 / n; a pseudo view weighs what its mean
difference does in the loss, and photographs what is left to them. Gradients are those of the step's loss, so they
carry that weight too: sums of both have a mean as large as that of single photographs, which published thresholds are
made for, whatever the batch and the augmenters.
"""

import sys

import torch
from torch import Tensor

from gsx.core.rasterizer import ScreenStatistics
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import ParameterTable

GATHERED = frozenset({"gradient", "count", "absolute"})
"""Statistics of renders since the last density event."""


def room_under(cap: int, count: int) -> int:
    """Returns how many rows may be added to `count` of them under a cap; a cap of 0 is none."""
    return max(0, cap - count) if cap else sys.maxsize


def within_room(chosen: Bool[Tensor, "N"], gradient: Float[Tensor, "N"], room: int) -> Bool[Tensor, "N"]:
    """Keeps of the chosen rows those with the largest gradients, at most `room`."""
    if int(chosen.sum()) <= room:
        return chosen
    ranked = torch.where(chosen, gradient, -1.0).argsort(descending=True, stable=True)[:room]
    return torch.zeros_like(chosen).index_fill_(0, ranked, True)


def over_cap(eligible: Bool[Tensor, "N"], chosen: Bool[Tensor, "N"]) -> dict[str, float]:
    """Returns how many eligible rows are over the cap, for the metrics of a step; empty: none."""
    count = int(eligible.sum()) - int(chosen.sum())
    return {"withheld": count} if count else {}


def densification_statistics(
    screen: ScreenStatistics, drawn: Int[Tensor, "N"] | None = None, weight: float = 1.0
) -> dict[str, Tensor]:
    """Returns norms of the screen gradients of one render, and how much each primitive was seen (3D-GS).

    That is `weight`, the render's weight in the loss, or 0 where a primitive was not visible. `drawn`: rows of the
    splats that were rendered; None: splat n is row n.
    """
    visible = screen.visible
    observation = {
        "rows": screen.ids if drawn is None else drawn[screen.ids],
        "gradient": torch.where(visible, screen.ndc_gradient(screen.means2d_offset).norm(dim=1), 0.0),
        "weight": visible.to(screen.means2d_offset.dtype) * weight,
    }
    if screen.absgrad is not None:
        observation["absolute"] = torch.where(visible, screen.ndc_gradient(screen.absgrad).sum(1), 0.0)
    return observation


def mean_of(sums: Float[Tensor, "*N"], counts: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """Divides sums by sums of weights; where nothing was counted it returns the sum itself, which is 0."""
    return sums / torch.where(counts > 0, counts, 1.0)


def gradient_statistics(count: int, device: torch.device | str, absolute: bool = False) -> dict[str, Tensor]:
    """Returns empty statistics of `count` primitives, for a table.

    `gradient`: sum of the norm of the screen gradient in NDC units. `count`: sum of the weights of the renders in which
    the primitive was visible: steps, where all see it. `absolute`, where it is gathered: sum of |g_x| + |g_y| over
    pixels, NDC units (Mip-Splatting, densify_and_prune).
    """
    names = ("gradient", "count", "absolute") if absolute else ("gradient", "count")
    return {name: torch.zeros(count, device=device) for name in names}


def add_statistics(table: ParameterTable, observation: dict[str, Tensor]) -> None:
    """Adds what `densification_statistics` returned for one render."""
    sums, rows = table.statistics, observation["rows"]
    sums["gradient"].index_add_(0, rows, observation["gradient"].to(sums["gradient"]))
    sums["count"].index_add_(0, rows, observation["weight"].to(sums["count"]))
    if "absolute" in sums and "absolute" in observation:
        sums["absolute"].index_add_(0, rows, observation["absolute"].to(sums["absolute"]))


def zero_statistics(table: ParameterTable) -> None:
    """Zeroes the statistics of renders."""
    for name in GATHERED & table.statistics.keys():
        table.statistics[name] = torch.zeros_like(table.statistics[name])


def mean_gradient(table: ParameterTable) -> Float[Tensor, "N"]:
    """Returns the weighted mean norm over the renders that saw the primitive; 0 for unseen ones."""
    return mean_of(table.statistics["gradient"], table.statistics["count"])


def mean_absolute(table: ParameterTable) -> Float[Tensor, "N"]:
    """Returns the same of the absolute gradients."""
    return mean_of(table.statistics["absolute"], table.statistics["count"])
