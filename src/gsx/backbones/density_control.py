"""Adaptive density control of free Gaussians: events, pruning, opacity resets, and clone and split (3D-GS)."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.backbones.capacity import event_steps
from gsx.backbones.capacity_options import capacity_of
from gsx.backbones.density import (
    mean_absolute,
    mean_gradient,
    over_cap,
    quantile,
    sampled_means,
    within_room,
    zero_statistics,
)
from gsx.backbones.gs3d_options import Density, GS3DOptions
from gsx.backbones.sky import not_sky
from gsx.backbones.visibility import everything, extents
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import Backbone, BackboneContext
from gsx.core.training.parameter_table import ParameterTable, append_rows, detached_rows, keep_rows, reset_column
from gsx.formats.smoothing import logit_of_log


class DensityControl:
    """Density control (Kerbl et al. 2023, section 5); subclasses define how Gaussians are added."""

    resets = False
    """True: opacities are reset at intervals."""
    after_adam = False
    """True: an event follows the Adam step of its step."""
    initial_scale = 1.0
    """Initial scales over the distances of neighbouring points."""
    volume_weight = 0.0
    """Weight of the mean volume of the drawn Gaussians in the loss."""

    def __init__(self, options: GS3DOptions, context: BackboneContext) -> None:
        self.options, self.context = options.density, context
        self.extent, self.generator = context.scene.extent, context.generator
        self.schedule = context.schedule(options.published_iterations)
        steps = self.options.start, self.options.stop, self.options.every
        self.events = event_steps(self.schedule, *steps, self.options.passes)
        self.capacity = capacity_of(options, context, self.events)
        self.observed_until, self.initial_opacity = self.events.stop, options.initial_opacity
        self.reset_every = self.schedule.interval(self.options.reset_every, self.options.reset_passes)
        white = bool((context.scene.background == 1).all())
        self.white_reset = max(1, self.schedule.step(self.options.white_reset)) if white else 0
        """Step of the extra reset on a white background (3D-GS, train.py); 0: none."""

    # -- how Gaussians are added ---------------------------------------------------------------------------------

    def add(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Adds Gaussians; returns metrics."""
        raise NotImplementedError

    def before_last_event(self, table: ParameterTable) -> ParameterTable | None:
        """Returns the table without the additions of the last event, for adaptive capacity; None: there were none."""
        return None

    # -- outside of events ---------------------------------------------------------------------------------------

    def regulariser(self, table: ParameterTable) -> Float[Tensor, ""] | None:
        """Returns a loss term of all Gaussians; None: there is none."""
        return None

    def perturb(self, table: ParameterTable) -> None:
        """Changes Gaussians after each Adam step."""

    # -- events --------------------------------------------------------------------------------------------------

    def reset_due(self, step: int) -> bool:
        """Returns whether opacities are reset at a step."""
        due = step % self.reset_every == 0 or step == self.white_reset
        return self.resets and step < self.events.stop and due

    def densify(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Evaluates, adds, prunes and zeroes statistics: one event (3D-GS, densify_and_prune)."""
        metrics = self.capacity.evaluate(model, self.before_last_event, step)
        metrics |= self.add(model, step)
        metrics["pruned"] = self.prune(model.table, step)
        zero_statistics(model.table)
        return metrics

    def prune(self, table: ParameterTable, step: int) -> int:
        """Removes faint primitives, and huge ones after the first reset interval; returns how many."""
        pruned = table["opacity_logits"].sigmoid() < self.options.prune_opacity
        if step > self.reset_every:
            pruned |= (largest_scales(table) > self.options.prune_extent * self.extent) & not_sky(table)
        if bool(pruned.all()):  # gaussian-splatting issue 482
            return 0
        keep_rows(table, ~pruned)
        return int(pruned.sum())

    def reset_opacities(self, table: ParameterTable) -> None:
        """Sets o <- min(o, reset_opacity) except for the sky (3D-GS); o includes the 3D filter (Mip-Splatting)."""
        logits, drawn = table["opacity_logits"].detach(), extents(table, everything(table))[1].detach()
        excess = (drawn - math.log(self.options.reset_opacity)).clamp_min(0) * not_sky(table)
        lowered = torch.where(excess > 0, logit_of_log(logsigmoid(logits) - excess), logits)
        reset_column(table, "opacity_logits", lowered)

    def plan(self) -> dict[str, Any]:
        """Returns the schedule in steps of this run."""
        ends = self.events.stop
        resets = {"every": self.reset_every, "until": ends}
        resets |= {"white_background": self.white_reset} if 0 < self.white_reset < ends else {}
        return {
            "densify": {"from": self.events.start, "until": ends, "every": self.events.every},
            **self.capacity.plan(),
            **({"opacity_reset": resets} if self.resets else {}),
            "prune_huge": {"from": self.reset_every},
        }


class CloneSplit(DensityControl):
    """Density control of 3D-GS: clones small and splits large Gaussians (Kerbl et al. 2023, section 5.2)."""

    resets = True

    def add(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Clones, and replaces split parents by two children (3D-GS, densify_and_clone, densify_and_split)."""
        table, options = model.table, self.options
        gradient = mean_gradient(table)
        eligible = candidates(table, gradient, options) & not_sky(table)
        chosen = within_room(eligible, gradient, self.capacity.room(table, int(eligible.sum()), step))
        large = largest_scales(table) > options.split_extent * self.extent
        cloned, split = chosen & ~large, chosen & large
        raw = detached_rows(table)
        parents = {name: value[split] for name, value in raw.items()}
        twins = [children(parents, options.split_shrink, self.generator) for _ in range(2)]
        added = {name: torch.cat([value[cloned], *(twin[name] for twin in twins)]) for name, value in raw.items()}
        replace_rows(table, split, added)
        return {"cloned": int(cloned.sum()), "split": int(split.sum())} | over_cap(eligible, chosen)


def candidates(table: ParameterTable, gradient: Float[Tensor, "N"], options: Density) -> Bool[Tensor, "N"]:
    """Marks primitives to clone or split by mean gradient, and as many by mean absolute gradient (Mip-Splatting).

    Ours: none without any gradient; if no primitive has one, the published rule would choose all.
    """
    chosen = gradient >= options.gradient
    if not options.absolute:
        return chosen
    absolute = mean_absolute(table)
    quiet = 1 - int(chosen.sum()) / len(chosen)
    return chosen | ((absolute >= quantile(absolute, quiet)) & (absolute > 0))


def largest_scales(table: ParameterTable) -> Float[Tensor, "N"]:
    """Returns the largest standard deviation of each primitive, world units."""
    return table["log_scales"].detach().amax(1).exp()


def children(rows: dict[str, Tensor], shrink: float, generator: torch.Generator) -> dict[str, Tensor]:
    """Draws one child from each parent's Gaussian, `shrink` times smaller (3D-GS, densify_and_split)."""
    return rows | {"means": sampled_means(rows, generator), "log_scales": rows["log_scales"] - math.log(shrink)}


def replace_rows(table: ParameterTable, removed: Bool[Tensor, "N"], added: dict[str, Tensor]) -> None:
    """Appends rows, then removes the marked ones of the old rows."""
    append_rows(table, added)
    new = torch.ones(len(table) - len(removed), dtype=torch.bool, device=removed.device)
    keep_rows(table, torch.cat([~removed, new]))
