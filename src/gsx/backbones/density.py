"""Arithmetic of adaptive density control: render statistics, a cap on additions, samples and quantiles.

Statistics are sums over the renders since the last density event, weighted as in the step's loss: each of n photos of a
step has weight 1 / n, less the share of its pseudo views. Gradients of the loss carry the same weight, so means stay
comparable with published thresholds for any batch and augmenter.
"""

import math
import sys

import torch
from torch import Tensor

from gsx.core.gaussians.quaternions import rotation_matrices
from gsx.core.rasterizer import ScreenStatistics
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.parameter_table import ParameterTable

GATHERED = frozenset({"gradient", "count", "absolute"})
"""Statistics of renders since the last density event."""


def room_under(cap: int, count: int) -> int:
    """Returns how many rows may join `count` rows under a cap; 0: no cap."""
    return max(0, cap - count) if cap else sys.maxsize


def within_room(chosen: Bool[Tensor, "N"], gradient: Float[Tensor, "N"], room: int) -> Bool[Tensor, "N"]:
    """Keeps at most `room` of the chosen rows, those with the largest gradients."""
    if int(chosen.sum()) <= room:
        return chosen
    ranked = torch.where(chosen, gradient, -1.0).argsort(descending=True, stable=True)[:room]
    return torch.zeros_like(chosen).index_fill_(0, ranked, True)


def over_cap(eligible: Bool[Tensor, "N"], chosen: Bool[Tensor, "N"]) -> dict[str, float]:
    """Returns the metric of eligible rows over the cap; empty: none."""
    count = int(eligible.sum()) - int(chosen.sum())
    return {"withheld": count} if count else {}


def densification_statistics(
    screen: ScreenStatistics, drawn: Int[Tensor, "N"] | None = None, weight: float = 1.0
) -> dict[str, Tensor]:
    """Returns screen gradient norms of one render, and its `weight` in the loss for visible primitives (3D-GS).

    `drawn`: rows of the rendered splats; None: splat n is row n.
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
    """Divides sums by sums of weights; 0 without any weight."""
    return sums / torch.where(counts > 0, counts, 1.0)


def gradient_statistics(count: int, device: torch.device | str, absolute: bool = False) -> dict[str, Tensor]:
    """Returns statistics of `count` primitives, all 0.

    `gradient`: sum of screen gradient norms, NDC units. `count`: sum of the weights of the renders that show the
    primitive. `absolute`: sum of |g_x| + |g_y| over pixels, NDC units (Mip-Splatting, densify_and_prune).
    """
    names = ("gradient", "count", "absolute") if absolute else ("gradient", "count")
    return {name: torch.zeros(count, device=device) for name in names}


def add_statistics(table: ParameterTable, observation: dict[str, Tensor]) -> None:
    """Adds the `densification_statistics` of one render."""
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
    """Returns the weighted mean gradient norm over the renders that show the primitive; 0 without one."""
    return mean_of(table.statistics["gradient"], table.statistics["count"])


def mean_absolute(table: ParameterTable) -> Float[Tensor, "N"]:
    """Returns the weighted mean absolute gradient."""
    return mean_of(table.statistics["absolute"], table.statistics["count"])


def sampled_means(rows: dict[str, Tensor], generator: torch.Generator) -> Float[Tensor, "M 3"]:
    """Draws one position from each Gaussian of raw `means`, `quats` and `log_scales`."""
    noise = torch.randn(rows["means"].shape, generator=generator).to(rows["means"])
    offset = rotation_matrices(rows["quats"]) @ (noise * rows["log_scales"].exp())[:, :, None]
    return rows["means"] + offset[:, :, 0]


def quantile(values: Float[Tensor, "M"], fraction: float) -> float:
    """Returns a linearly interpolated quantile (torch.quantile is limited to 2^24 values)."""
    place = fraction * (len(values) - 1)
    low, high = (float(values.kthvalue(rank + 1).values) for rank in (math.floor(place), math.ceil(place)))
    return low + (high - low) * (place - math.floor(place))
