"""3D Gaussian Splatting (Kerbl et al. 2023): explicit Gaussians with adaptive density control (spec 1, 5-7)."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.nn.functional import logsigmoid, normalize

from gsx.backbones.mip import MipOptions, checked_filter, filter_sizes, filtered_rules, logit_of_log, smoothed
from gsx.core.backbone import Beginning, Gaussians
from gsx.core.camera import Camera
from gsx.core.density import (
    Statistics,
    Table,
    append_rows,
    finite_rows,
    keep_rows,
    reset_column,
    restored_table,
    table_tensors,
)
from gsx.core.errors import InputError
from gsx.core.export import columns_of
from gsx.core.neighbours import mean_square_distance
from gsx.core.quaternions import rotation_matrices
from gsx.core.rasterizer import Rendering
from gsx.core.scene import PointCloud
from gsx.core.schedule import log_linear
from gsx.core.sh import colours_of, constant_from_colour
from gsx.core.shapes import Bool, Float
from gsx.core.splats import Splats

LARGEST_LOG_SCALE = 30.0
"""Scales are held below e^30 world units, so that their squares stay finite in float32 (DESIGN: clamp log-scales)."""
LEAST_SQUARE_DISTANCE = 1e-7
"""Lower bound of the squared neighbour distance that sets the initial scale (spec 1.4)."""


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Adam learning rates (spec 6)."""

    means_first: float
    means_last: float
    sh_constant: float
    sh_rest: float
    opacity_logits: float
    log_scales: float
    quats: float


@dataclass(frozen=True, kw_only=True)
class Density:
    """Adaptive density control in steps of the published run (spec 7)."""

    start: int
    stop: int
    every: int
    gradient: float
    """Mean NDC gradient at or above which a primitive is cloned or split."""
    absolute: bool
    """Also clone or split as many again by the mean of absolute gradients (Mip-Splatting of 2024, spec 10.5)."""
    split_extent: float
    """Primitives larger than this fraction of the extent are split, smaller ones cloned."""
    split_shrink: float
    """Children are the parent's scale divided by this."""
    prune_opacity: float
    prune_extent: float
    """Primitives larger than this fraction of the extent are removed, after the first opacity reset."""
    reset_every: int
    reset_opacity: float
    reset_passes: float
    """In a shortened run at least this many passes over the views lie between opacity resets."""
    white_reset: int
    """Step of the extra opacity reset on a white background."""


@dataclass(frozen=True, kw_only=True)
class GS3DOptions:
    """Options of the backbone; values in conf/backbone/gs3d.yaml and mip_splatting.yaml."""

    name: str
    filter: str
    """none, or mip: both filters of Mip-Splatting."""
    published_iterations: int
    sh_degree: int
    sh_every: int
    initial_opacity: float
    max_primitives: int
    """No primitive is added beyond this number."""
    rates: Rates
    density: Density
    mip: MipOptions

    def __post_init__(self) -> None:
        checked_filter(self.filter)
        if self.sh_degree not in range(4):
            raise ValueError(f"backbone.sh_degree is {self.sh_degree}; choose 0 to 3")
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"backbone.initial_opacity is {self.initial_opacity}; give a value between 0 and 1")
        if self.published_iterations < 1 or self.max_primitives < 1:
            raise ValueError("backbone.published_iterations and backbone.max_primitives must be at least 1")
        if not (self.rates.means_first > 0 and self.rates.means_last > 0):
            raise ValueError("backbone.rates.means_first and means_last must be positive: they decay log-linearly")


def initial_parameters(points: PointCloud, sh_degree: int, opacity: float) -> dict[str, Tensor]:
    """Raw parameters of one Gaussian per point (spec 1.1 and 1.4)."""
    positions, count = points.positions.float(), len(points)
    distance = mean_square_distance(positions).clamp_min(LEAST_SQUARE_DISTANCE)
    return {
        "means": positions.clone(),
        "sh_constant": constant_from_colour(points.colours.float() / 255)[:, None],
        "sh_rest": torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        "opacity_logits": torch.full((count,), math.log(opacity / (1 - opacity))),
        "log_scales": distance.sqrt().log()[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
    }


def children(rows: dict[str, Tensor], shrink: float, generator: torch.Generator) -> dict[str, Tensor]:
    """One child of each parent: drawn from the parent's Gaussian, `shrink` times smaller (spec 7, split)."""
    noise = torch.randn(rows["means"].shape, generator=generator).to(rows["means"])
    offset = rotation_matrices(rows["quats"]) @ (noise * rows["log_scales"].exp())[:, :, None]
    return rows | {
        "means": rows["means"] + offset[:, :, 0],
        "log_scales": rows["log_scales"] - math.log(shrink),
    }


def quantile(values: Float[Tensor, "N"], fraction: float) -> Float[Tensor, ""]:
    """With linear interpolation, of any number of values: torch.quantile refuses more than 2^24 (spec 13, MIP #55)."""
    place = fraction * (len(values) - 1)
    ordered = values.sort().values
    return torch.lerp(ordered[math.floor(place)], ordered[math.ceil(place)], place % 1)


class GS3D:
    """Explicit Gaussians, N rows in every parameter."""

    standard_file = True

    def __init__(self, options: GS3DOptions, beginning: Beginning) -> None:
        scene = beginning.scene
        if len(scene.points) == 0:
            raise InputError(f"scene '{scene.name}' has no points to start from: give it points or scene.points=random")
        self.options = options
        self.extent = scene.extent
        self.white = bool((scene.background == 1).all())
        self.generator = beginning.generator
        self.schedule = beginning.schedule(options.published_iterations)
        self.active_degree = 0
        self.raster = filtered_rules(beginning.raster, options.filter, options.mip)
        self.absolute_gradient = options.density.absolute
        self.cameras = [view.camera for view in scene.train]
        raw = initial_parameters(scene.points, options.sh_degree, options.initial_opacity)
        self.table = Table({name: Parameter(value.to(beginning.device)) for name, value in raw.items()})
        self.statistics = Statistics.zeros(len(self.table), beginning.device, options.density.absolute)
        self.refresh_filter()

    # -- one step, in the order the trainer calls --------------------------------------------------------------

    def begin(self, step: int) -> None:
        """Learning rates and SH degree of this step (spec 6 and 1.3)."""
        rates = self.options.rates
        steps = self.schedule.step(self.options.published_iterations)
        self.table.set_rate("means", self.extent * log_linear(step, steps, rates.means_first, rates.means_last))
        for name in ("sh_constant", "sh_rest", "opacity_logits", "log_scales", "quats"):
            self.table.set_rate(name, getattr(rates, name))
        self.active_degree = min(self.options.sh_degree, step // max(1, self.schedule.step(self.options.sh_every)))

    def splats(self, camera: Camera) -> Splats:
        """All Gaussians with their colours as seen from the camera."""
        table = self.table
        offsets = table["means"] - camera.centre.to(table["means"])
        scales, log_opacities = self.extents()
        return Splats(
            means=table["means"],
            scales=scales,
            quats=table["quats"],
            log_opacities=log_opacities,
            colours=colours_of(table["sh_constant"], table["sh_rest"], offsets, self.active_degree),
        )

    def extents(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
        """Scales and log-opacities as they are drawn, after the 3D filter if there is one."""
        scales = self.table["log_scales"].clamp(max=LARGEST_LOG_SCALE).exp()
        log_opacities = logsigmoid(self.table["opacity_logits"])
        if self.options.filter == "none":
            return scales, log_opacities
        return smoothed(scales, log_opacities, self.table["filter"])

    def regulariser(self) -> Float[Tensor, ""] | None:
        """3D-GS has none (spec 5)."""
        return None

    def observe(self, rendering: Rendering, step: int) -> None:
        """Screen gradients count until density control ends (spec 7, cadence)."""
        if step < self.schedule.step(self.options.density.stop):
            self.statistics.add(rendering.screen)

    def adapt(self, step: int) -> dict[str, int]:
        """Clone, split, prune and reset when due."""
        done: dict[str, int] = {}
        if self.density_due(step):
            done |= self.densify(step)
        if done or self.filter_due(step):
            self.refresh_filter()
        if self.reset_due(step):
            self.reset_opacities()
            done["opacity_resets"] = 1
        return done

    def update(self) -> None:
        """One Adam step. Unused SH bands take part with zero gradients, as in the published code (spec 1.3)."""
        rest = self.table["sh_rest"]
        if rest.grad is None and self.table["sh_constant"].grad is not None:
            rest.grad = torch.zeros_like(rest)
        self.table.optimiser.step()
        self.discard()

    def gradients(self) -> Iterable[tuple[str, Tensor]]:
        """Gradients by parameter name."""
        return ((name, p.grad) for name, p in self.table.parameters.items() if p.grad is not None)

    def heal(self) -> int:
        """Remove rows with a value that is not finite, with their statistics; returns how many."""
        kept = finite_rows(self.table)
        keep_rows(self.table, kept)
        self.statistics = self.statistics.rows(kept)
        return int((~kept).sum())

    def discard(self) -> None:
        """Forget the gradients."""
        self.table.optimiser.zero_grad(set_to_none=True)

    # -- density control ---------------------------------------------------------------------------------------

    def density_due(self, step: int) -> bool:
        """After `start`, before `stop`, every interval."""
        density = self.options.density
        start, stop = self.schedule.step(density.start), self.schedule.step(density.stop)
        return start < step < stop and step % self.schedule.interval(density.every) == 0

    def reset_interval(self) -> int:
        """Steps between opacity resets."""
        density = self.options.density
        return self.schedule.interval(density.reset_every, density.reset_passes)

    def reset_due(self, step: int) -> bool:
        """Every reset interval while density control runs, and once early on a white background."""
        density = self.options.density
        regular = step % self.reset_interval() == 0 and step < self.schedule.step(density.stop)
        return regular or (self.white and step == max(1, self.schedule.step(density.white_reset)))

    def densify(self, step: int) -> dict[str, int]:
        """Clone small and split large primitives with large gradients, then prune (spec 7, order in one event)."""
        density = self.options.density
        gradient = self.statistics.mean_gradient()
        chosen = self.within_cap(gradient, self.candidates(gradient))
        large = self.largest_scales() > density.split_extent * self.extent
        cloned, split = chosen & ~large, chosen & large
        self.clone_and_split(cloned, split)
        pruned = self.prune(step)
        self.statistics = Statistics.zeros(len(self.table), gradient.device, density.absolute)
        return {"cloned": int(cloned.sum()), "split": int(split.sum()), "pruned": pruned}

    def candidates(self, gradient: Float[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Primitives to clone or split: by mean gradient, and as many again by mean absolute gradient (spec 10.5).

        Ours: never those without any gradient. Where none has one the published rule would choose all.
        """
        chosen = gradient >= self.options.density.gradient
        if not self.options.density.absolute:
            return chosen
        absolute = self.statistics.mean_absolute()
        quiet = 1 - int(chosen.sum()) / len(chosen)
        return chosen | ((absolute >= quantile(absolute, quiet)) & (absolute > 0))

    def within_cap(self, gradient: Float[Tensor, "N"], chosen: Bool[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Of the chosen, those with the largest gradients that fit under max_primitives (each adds one)."""
        room = max(0, self.options.max_primitives - len(self.table))
        if int(chosen.sum()) <= room:
            return chosen
        ranked = torch.where(chosen, gradient, -1.0).argsort(descending=True, stable=True)[:room]
        return torch.zeros_like(chosen).index_fill_(0, ranked, True)

    def clone_and_split(self, cloned: Bool[Tensor, "N"], split: Bool[Tensor, "N"]) -> None:
        """Rows become: survivors, clones, first children, second children."""
        raw = {name: parameter.detach() for name, parameter in self.table.parameters.items()} | self.table.columns
        parents = {name: value[split] for name, value in raw.items()}
        shrink = self.options.density.split_shrink
        twins = [children(parents, shrink, self.generator) for _ in range(2)]
        added = {name: torch.cat([value[cloned], *(twin[name] for twin in twins)]) for name, value in raw.items()}
        append_rows(self.table, added)
        new = torch.ones(len(self.table) - len(split), dtype=torch.bool, device=split.device)
        keep_rows(self.table, torch.cat([~split, new]))

    def prune(self, step: int) -> int:
        """Remove faint primitives, and after the first reset huge ones; returns how many."""
        density = self.options.density
        doomed = self.table["opacity_logits"].sigmoid() < density.prune_opacity
        if step > self.reset_interval():
            doomed |= self.largest_scales() > density.prune_extent * self.extent
        if bool(doomed.all()):  # a cloud about to vanish keeps what it has (spec 13, GS #482)
            return 0
        keep_rows(self.table, ~doomed)
        return int(doomed.sum())

    def reset_opacities(self) -> None:
        """o <- min(o, reset_opacity), moments zeroed (spec 7); with a 3D filter o is what is drawn (spec 10.5)."""
        highest, logits = self.options.density.reset_opacity, self.table["opacity_logits"].detach()
        excess = (self.extents()[1].detach() - math.log(highest)).clamp_min(0)
        lowered = torch.where(excess > 0, logit_of_log(logsigmoid(logits) - excess), logits)
        reset_column(self.table, "opacity_logits", lowered)

    # -- the 3D filter -----------------------------------------------------------------------------------------

    def filter_due(self, step: int) -> bool:
        """Every interval between the end of density control and the freezing of the filter (spec 10.2)."""
        mip, begun = self.options.mip, self.schedule.step(self.options.density.stop)
        return begun < step < self.schedule.step(mip.stop) and step % self.schedule.interval(mip.every) == 0

    def refresh_filter(self) -> None:
        """Filter sizes from where the primitives are now (spec 10.1)."""
        if self.options.filter == "mip":
            means = self.table["means"].detach()
            self.table.columns["filter"] = filter_sizes(means, self.cameras, self.options.mip)

    def largest_scales(self) -> Float[Tensor, "N"]:
        """Largest standard deviation of each primitive, world units."""
        return self.table["log_scales"].detach().amax(1).exp()

    # -- what others need --------------------------------------------------------------------------------------

    def size(self) -> tuple[int, int]:
        """(primitives, bytes of their parameters)."""
        return len(self.table), sum(p.numel() * p.element_size() for p in self.table.parameters.values())

    def explicit(self, camera: Camera | None = None) -> Gaussians:
        """The parameters as a splat file holds them, the 3D filter fused into scales and opacities (spec 10.9)."""
        raw = {name: parameter.detach() for name, parameter in self.table.parameters.items()}
        if self.options.filter == "mip":
            scales, log_opacities = self.extents()
            raw |= {"log_scales": scales.detach().log(), "opacity_logits": logit_of_log(log_opacities.detach())}
        raw["sh_constant"] = raw["sh_constant"][:, 0]
        raw["quats"] = normalize(raw["quats"], dim=1)
        return Gaussians(**raw)

    def file(self) -> dict[str, Tensor]:
        """The standard 62 properties (spec 8.3)."""
        return columns_of(self.explicit())

    def export_notes(self) -> list[str]:
        """Whether the 3D filter is in the file."""
        return ["3D filter fused into scales and opacities" if self.options.filter == "mip" else "no 3D filter"]

    def plan(self) -> dict[str, Any]:
        """The schedule in steps of this run."""
        density, steps = self.options.density, self.schedule
        return {
            "densify": {
                "from": steps.step(density.start),
                "until": steps.step(density.stop),
                "every": steps.interval(density.every),
            },
            "opacity_reset": {"every": self.reset_interval(), "until": steps.step(density.stop)}
            | ({"white_background": max(1, steps.step(density.white_reset))} if self.white else {}),
            "prune_huge": {"from": self.reset_interval()},
            "sh_degree": {
                "every": max(1, steps.step(self.options.sh_every)),
                "up_to": self.options.sh_degree,
            },
            "means_rate": {
                "from": self.options.rates.means_first * self.extent,
                "to": self.options.rates.means_last * self.extent,
                "over": steps.step(self.options.published_iterations),
            },
        }

    def tensors(self) -> dict[str, Tensor]:
        """Parameters, Adam moments and step counts, statistics."""
        return table_tensors(self.table) | self.statistics.tensors()

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave."""
        device = self.statistics.gradient.device
        self.table = restored_table(self.table, tensors, device)
        self.statistics = Statistics.restored(tensors, device)
