"""Adaptive density control of free Gaussians: when it acts, and what every way of making new ones shares (3D-GS)."""

import math
from typing import Any

import torch
from torch.nn.functional import logsigmoid

from gsx.backbones.capacity import Capacity, growing_of
from gsx.backbones.density import zero_statistics
from gsx.backbones.gs3d_options import Density
from gsx.backbones.gs3d_parts import Densification, everything, extents, largest_scales
from gsx.backbones.mip import Filter
from gsx.backbones.sky import not_sky
from gsx.core.gaussians.smoothing import logit_of_log
from gsx.core.training.backbone import Backbone, BackboneContext
from gsx.core.training.parameter_table import ParameterTable, keep_rows, reset_column
from gsx.core.training.schedule import Schedule


class DensityControl:
    """Densifies, prunes and resets opacities (Kerbl et al. 2023, section 5)."""

    def __init__(
        self, options: Density, capacity: Capacity, context: BackboneContext, schedule: Schedule, how: Densification
    ) -> None:
        self.options, self.capacity, self.schedule, self.densification = options, capacity, schedule, how
        self.extent, self.generator = context.scene.extent, context.generator
        self.context = context
        self.growing = growing_of(options, schedule)
        self.white = bool((context.scene.background == 1).all())

    # -- when ----------------------------------------------------------------------------------------------------

    def ends(self) -> int:
        """Step from which nothing is densified, pruned or observed."""
        return self.growing.stop

    def due(self, step: int) -> bool:
        """After `start`, before `stop`, every interval."""
        return self.growing.due(step)

    def reset_interval(self) -> int:
        """Steps between opacity resets."""
        return self.schedule.interval(self.options.reset_every, self.options.reset_passes)

    def reset_due(self, step: int) -> bool:
        """While density control runs every reset interval, and once early on a white background (3D-GS, train.py); or
        never."""
        if not self.densification.resets or step >= self.ends():
            return False
        return step % self.reset_interval() == 0 or (self.white and step == self.white_reset())

    def white_reset(self) -> int:
        """Step of the extra reset."""
        return max(1, self.schedule.step(self.options.white_reset))

    # -- what ----------------------------------------------------------------------------------------------------

    def densify(self, model: Backbone[Any], step: int) -> dict[str, float]:
        """Judge what there is; clone and split, then prune; begin to count anew (3D-GS, densify_and_prune: the order
        in one event)."""
        found = self.capacity.judge(model, self.densification.undone, step)
        done = found | self.densification.densify(self, model, step)
        done["pruned"] = self.prune(model.table, step)
        zero_statistics(model.table)
        return done

    def prune(self, table: ParameterTable, step: int) -> int:
        """Remove faint primitives, and after the first reset huge ones; returns how many."""
        doomed = table["opacity_logits"].sigmoid() < self.options.prune_opacity
        if step > self.reset_interval():
            doomed |= (largest_scales(table) > self.options.prune_extent * self.extent) & not_sky(table)
        if bool(doomed.all()):  # a cloud about to vanish keeps what it has (gaussian-splatting issue 482)
            return 0
        keep_rows(table, ~doomed)
        return int(doomed.sum())

    def reset_opacities(self, table: ParameterTable, filter_: Filter) -> None:
        """o <- min(o, reset_opacity), moments zeroed (3D-GS); with a 3D filter o is what is drawn (Mip-Splatting). The
        sky stays as opaque as it is."""
        logits, drawn = table["opacity_logits"].detach(), extents(table, everything(table), filter_)[1].detach()
        excess = (drawn - math.log(self.options.reset_opacity)).clamp_min(0) * not_sky(table)
        lowered = torch.where(excess > 0, logit_of_log(logsigmoid(logits) - excess), logits)
        reset_column(table, "opacity_logits", lowered)

    def plan(self) -> dict[str, Any]:
        """The schedule in steps of this run."""
        resets = {"every": self.reset_interval(), "until": self.ends()}
        resets |= {"white_background": self.white_reset()} if self.white and self.white_reset() < self.ends() else {}
        return {
            "densify": {"from": self.growing.start, "until": self.ends(), "every": self.growing.every},
            **self.capacity.plan(),
            **({"opacity_reset": resets} if self.densification.resets else {}),
            "prune_huge": {"from": self.reset_interval()},
        }
