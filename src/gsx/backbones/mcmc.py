"""Gaussians as samples of a Markov chain: the dead move to the living, noise explores (Kheradmand et al. 2024).

Dead Gaussians become copies of opaque ones, which share opacity and size so that renders hardly change. Nothing is
cloned, split, pruned or reset. An event follows the Adam step of its step and noise follows the event (gsplat; the
authors: event, Adam, noise). docs/explanation/capacity.md names the other differences of both codes.
"""

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.backbones.capacity import Capacity, event_steps
from gsx.backbones.density_control import DensityControl
from gsx.backbones.gs3d_options import GS3DOptions
from gsx.backbones.sky import not_sky
from gsx.backbones.visibility import LARGEST_LOG_SCALE
from gsx.core.device import upload
from gsx.core.gaussians.quaternions import rotation_matrices
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import CAUTION, Backbone, BackboneContext
from gsx.core.training.parameter_table import ParameterTable, append_rows, detached_rows, edit

MOST_SHARES = 51
"""Most Gaussians that a donor counts as sharing its opacity (gsplat: n_max)."""
LARGEST_OPACITY = 1 - 2**-23
STEEPNESS = 100.0
"""Slope of the noise's sigmoid over opacity (authors, train.py)."""
REACH, NODES = 6.5, 65
"""Standard deviations and nodes of the integral of a profile: exact to 1e-9 for up to `MOST_SHARES` Gaussians."""


class MCMC(DensityControl):
    """Density control that relocates dead Gaussians and adds copies up to a number."""

    after_adam = True

    def __init__(self, options: GS3DOptions, context: BackboneContext) -> None:
        super().__init__(options, context)
        self.mcmc = mcmc = options.mcmc
        self.events = event_steps(self.schedule, mcmc.start, mcmc.stop, mcmc.every, mcmc.passes)
        self.observed_until, self.capacity = 0, Capacity(mcmc.primitives)
        share = self.schedule.shortened(options.rates.shortened) / self.schedule.shortened(1.0)
        self.initial_opacity, self.initial_scale = mcmc.initial_opacity, mcmc.initial_scale**share
        rescaled = mcmc.every * context.iterations / options.published_iterations
        self.growth = mcmc.growth ** (self.events.every / rescaled)
        """Factor of the number of Gaussians at an event: over the run they grow as published."""
        self.unit = mcmc.extent / self.extent if mcmc.extent and self.extent else 1.0
        """Reference extent over the scene's."""

    def densify(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Relocates dead Gaussians, then adds copies: one event (gsplat, MCMCStrategy)."""
        moved = relocate(model.table, self.mcmc.dead_opacity, self.generator)
        return {"relocated": moved} | self.add(model, step)

    def add(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Adds copies of Gaussians drawn by opacity; moments of the copied rows stay (gsplat; authors: zero them)."""
        table = model.table
        growth = math.floor(self.growth * len(table)) - len(table)
        count = min(growth, self.capacity.room(table, growth, step))
        if count > 0:
            donors = draw_by_opacity(table, not_sky(table), count, self.generator)
            rows = shared_rows(table, donors, self.mcmc.dead_opacity)
            write_rows(table, donors, rows, forget=False)
            append_rows(table, rows)
        return {"added": count}

    def regulariser(self, table: ParameterTable) -> Float[Tensor, ""]:
        """Returns the weighted means of all opacities and scales, except those of the sky."""
        rows = not_sky(table)
        opacities = table["opacity_logits"].sigmoid() * rows
        scales = table["log_scales"].clamp(max=LARGEST_LOG_SCALE).exp() * rows[:, None]
        of_scales = self.mcmc.scale_weight * self.unit * scales.sum() / 3
        return (self.mcmc.opacity_weight * opacities.sum() + of_scales) / rows.sum().clamp_min(1)

    def perturb(self, table: ParameterTable) -> None:
        """Adds noise in proportion to the learning rate of the means to faint Gaussians."""
        rate = table.pace * table.group("means")["lr"]
        add_noise(table, rate * self.mcmc.noise * self.unit**2, self.mcmc.dead_opacity, self.generator)

    def plan(self) -> dict[str, Any]:
        """Returns events, growth and number of Gaussians."""
        events, most, points = self.events, self.capacity.most, len(self.context.scene.points)
        plan = {"from": events.start, "until": events.stop, "every": events.every, "primitives": most}
        crowded = f"adds none: the scene has {points} points, backbone.mcmc.primitives is {most}: raise it"
        return {"mcmc": plan | {"growth": self.growth} | ({CAUTION: crowded} if points > most else events.caution())}


# -- relocation --------------------------------------------------------------------------------------------------------


def relocate(table: ParameterTable, dead_opacity: float, generator: torch.Generator) -> int:
    """Makes dead Gaussians copies of living ones drawn by opacity; returns how many.

    Moments of both become 0. The published codes keep those of the dead rows, which belong to another place.
    """
    dead = (table["opacity_logits"].detach().sigmoid() <= dead_opacity) & not_sky(table)
    living = ~dead & not_sky(table)
    if not bool(dead.any()) or not bool(living.any()):
        return 0
    movers = dead.nonzero()[:, 0]
    donors = draw_by_opacity(table, living, len(movers), generator)
    rows = shared_rows(table, donors, dead_opacity)
    write_rows(table, donors, rows)
    write_rows(table, movers, rows)
    return len(movers)


def draw_by_opacity(
    table: ParameterTable, candidates: Bool[Tensor, "N"], count: int, generator: torch.Generator
) -> Int[Tensor, "count"]:
    """Draws rows with replacement, with probabilities in proportion to their opacities."""
    rows = candidates.nonzero()[:, 0]
    sums = table["opacity_logits"].detach()[rows].double().sigmoid().cpu().cumsum(0)
    places = sums[-1] * torch.rand(count, generator=generator, dtype=torch.float64)
    return rows[torch.searchsorted(sums, places, right=True).clamp_max(len(rows) - 1).to(rows.device)]


def shared_rows(table: ParameterTable, donors: Int[Tensor, "M"], least: float) -> dict[str, Tensor]:
    """Returns the donors' rows with opacities and scales for themselves and their copies.

    least: lower bound of opacities.
    """
    rows = {name: value[donors] for name, value in detached_rows(table).items()}
    counts = donors.bincount(minlength=len(table))[donors] + 1
    opacities, shrink = shares(rows["opacity_logits"].double(), counts.clamp_max(MOST_SHARES), least)
    changed = {
        "opacity_logits": opacities.logit().to(rows["opacity_logits"]),
        "log_scales": (rows["log_scales"].double() + shrink.log()[:, None]).to(rows["log_scales"]),
    }
    return rows | changed


def shares(
    logits: Float[Tensor, "M"], counts: Int[Tensor, "M"], least: float
) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """Returns (opacities, factors of scales) with which n coincident Gaussians draw nearly what one did.

    o' = 1 - (1 - o)^(1/n) is equal at the centre. s' / s = o / D_n(o') keeps the integral of a profile (Kheradmand et
    al. 2024, equation 9). The opacity is clamped before the scale follows from it (gsplat of 2026; authors and
    gsplat 1.5: after it, so that pairs of the faintest become too bright).
    """
    opacities = -torch.expm1(logsigmoid(-logits) / counts)
    opacities = opacities.clamp(least, LARGEST_OPACITY)
    return opacities, logits.sigmoid() / profile_integral(opacities, counts)


def profile_integral(opacities: Float[Tensor, "M"], counts: Int[Tensor, "M"]) -> Float[Tensor, "M"]:
    """Returns D_n: the integral over t of 1 - (1 - x exp(-t^2 / 2))^n, in units of sqrt(2 pi).

    Equals the alternating sum of equation 9 without its cancellation.
    """
    nodes = torch.linspace(0, REACH, NODES, dtype=opacities.dtype, device=opacities.device)
    one = torch.log1p(-opacities[:, None] * torch.exp(-nodes.square() / 2))
    return math.sqrt(2 / math.pi) * torch.trapezoid(-torch.expm1(counts[:, None] * one), nodes)


def write_rows(table: ParameterTable, rows: Int[Tensor, "M"], values: dict[str, Tensor], forget: bool = True) -> None:
    """Writes rows of all parameters and columns; forget: their moments become 0."""
    for name in table.parameters:
        moments = partial(torch.index_fill, dim=0, index=rows, value=0.0) if forget else torch.clone
        edit(table, name, partial(torch.index_copy, dim=0, index=rows, source=values[name]), moments)
    for name, column in table.columns.items():
        table.columns[name] = column.index_copy(0, rows, values[name])


# -- noise -------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def add_noise(table: ParameterTable, factor: float, dead_opacity: float, generator: torch.Generator) -> None:
    """Adds noise to the means: covariance times `factor`, gated by opacity (authors, train.py).

    Its deviation is a squared scale times the factor, which so has the unit of 1 / length.
    """
    gate = torch.sigmoid(STEEPNESS * (dead_opacity - table["opacity_logits"].sigmoid())) * not_sky(table)
    noise = upload(torch.randn(table["means"].shape, generator=generator), table.device)
    axes, variances = rotation_matrices(table["quats"]), table["log_scales"].clamp(max=LARGEST_LOG_SCALE).exp().square()
    along = variances[:, :, None] * (axes.mT @ noise[:, :, None])
    table["means"].add_((axes @ along)[:, :, 0] * (factor * gate)[:, None])
