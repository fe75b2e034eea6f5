"""Splits along the longest axis: two adjacent halves replace one Gaussian (Improved-GS)."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsx.backbones.capacity import frozen_table
from gsx.backbones.density import mean_absolute, within_room
from gsx.backbones.density_control import DensityControl, replace_rows
from gsx.backbones.gs3d_options import GS3DOptions
from gsx.backbones.sky import not_sky
from gsx.core.gaussians.quaternions import quaternions_of, rotation_matrices
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import Backbone, BackboneContext
from gsx.core.training.importance import Probe, random_views
from gsx.core.training.parameter_table import ParameterTable, detached_rows

STEP, LENGTH, OPACITY = 1.35, 0.55, 0.6
"""Offset and length of a half over the whole's largest scale; opacity over the whole's."""
ACROSS = math.sqrt(1 - 0.45**2)
"""Scale of a half along the other axes over the whole's."""
LARGEST_OPACITY = 1 - 1e-6


def covariances(rows: Mapping[str, Tensor]) -> Float[Tensor, "N 3 3"]:
    """Returns covariances of Gaussians by raw parameters, world units squared."""
    spread = rotation_matrices(rows["quats"]) * rows["log_scales"].exp()[:, None]
    return spread @ spread.mT


def principal_axes(covariance: Float[Tensor, "N 3 3"]) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
    """Returns (variances along the axes, ascending; unit quaternions of the axes)."""
    variances, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    return variances, normalize(quaternions_of(axes), dim=1)


def halves(rows: dict[str, Tensor]) -> list[dict[str, Tensor]]:
    """Returns two halves of each Gaussian, on both sides of its centre along the longest axis (Improved-GS)."""
    longest = rows["log_scales"].argmax(1, keepdim=True)
    along = torch.zeros_like(rows["log_scales"]).scatter_(1, longest, 1.0)
    size = rows["log_scales"].gather(1, longest).exp()
    offset = (rotation_matrices(rows["quats"]) @ (STEP * size * along)[:, :, None])[:, :, 0]
    changed = {
        "log_scales": rows["log_scales"] + torch.where(along > 0, math.log(LENGTH), math.log(ACROSS)),
        "opacity_logits": torch.logit(OPACITY * rows["opacity_logits"].sigmoid(), eps=1e-6),
    }
    return [rows | changed | {"means": rows["means"] + side * offset} for side in (1, -1)]


def wholes(first: dict[str, Tensor], second: dict[str, Tensor]) -> dict[str, Tensor]:
    """Merges pairs of halves: the inverse of `halves` for fresh ones, by their first and second moments."""
    whole = {name: (value + second[name]) / 2 for name, value in first.items() if value.is_floating_point()}
    apart = (first["means"] - second["means"])[:, :, None].double() / 2
    covariance = (covariances(first) + covariances(second)).double() / 2 + apart @ apart.mT
    variances, quats = principal_axes(covariance)
    grown = variances.new_tensor([ACROSS**2, ACROSS**2, LENGTH**2 + STEP**2])
    opacities = (first["opacity_logits"].sigmoid() + second["opacity_logits"].sigmoid()) / 2 / OPACITY
    changed = {
        "log_scales": ((variances / grown).clamp_min(1e-30).log() / 2).to(whole["log_scales"]),
        "quats": quats.to(whole["quats"]),
        "opacity_logits": torch.logit(opacities.clamp_max(LARGEST_OPACITY)),
    }
    return first | whole | changed


def split_along(table: ParameterTable, chosen: Bool[Tensor, "N"]) -> None:
    """Replaces the chosen rows by their first halves and then their second halves."""
    twins = halves({name: value[chosen] for name, value in detached_rows(table).items()})
    replace_rows(table, chosen, {name: torch.cat([twin[name] for twin in twins]) for name in twins[0]})


def twins_of(born: Float[Tensor, "N"]) -> tuple[Int[Tensor, "P"], Int[Tensor, "P"]]:
    """Returns (rows of first halves, rows of second halves) of the complete pairs, by their numbers."""
    order = born.argsort(stable=True)
    number = born[order]
    paired = ((number[:-1] == number[1:]) & (number[1:] > 0)).nonzero()[:, 0]
    return order[paired], order[paired + 1]


class LongAxis(DensityControl):
    """Density control that splits the Gaussians with the largest error times mean absolute gradient."""

    def __init__(self, options: GS3DOptions, context: BackboneContext) -> None:
        super().__init__(options, context)
        self.views = options.looks

    def add(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Splits as many Gaussians as there is room for."""
        table, context = model.table, self.context
        views = random_views(context.views.at(step), self.views, self.generator)
        probe = Probe(model=model, views=context.views, step=step)
        errors = context.on_rank0(lambda: probe.row_errors(views).cpu())
        score = errors.to(context.device) * mean_absolute(table)
        eligible = (score > 0) & not_sky(table)
        chosen = within_room(eligible, score, self.capacity.room(table, int(eligible.sum()), step))
        count = int(chosen.sum())
        split_along(table, chosen)
        if "born" in table.statistics:
            numbers = torch.arange(1, count + 1).to(score)
            old = torch.zeros(len(table) - 2 * count).to(score)
            table.statistics["born"] = torch.cat([old, numbers, numbers])
        return {"split": count}

    def before_last_event(self, table: ParameterTable) -> ParameterTable | None:
        """Returns the table with the halves of the last event merged; None: there are none."""
        first, second = twins_of(table.statistics["born"])
        if len(first) == 0:
            return None
        rows = detached_rows(table)
        whole = wholes(*({name: value[half] for name, value in rows.items()} for half in (first, second)))
        others = torch.ones(len(table), dtype=torch.bool, device=first.device)
        others[torch.cat([first, second])] = False
        return frozen_table(table, {name: torch.cat([value[others], whole[name]]) for name, value in rows.items()})
