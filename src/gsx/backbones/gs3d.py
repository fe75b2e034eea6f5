"""3D Gaussian Splatting (Kerbl et al. 2023): explicit Gaussians with adaptive density control (spec 1, 5-7)."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.nn.functional import logsigmoid, normalize

from gsx.core.backbone import Beginning, Gaussians
from gsx.core.camera import Camera
from gsx.core.density import Statistics, Table, append_rows, keep_rows, reset_column
from gsx.core.errors import InputError
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
    """Options of the backbone; values in conf/backbone/gs3d.yaml."""

    name: str
    published_iterations: int
    sh_degree: int
    sh_every: int
    initial_opacity: float
    max_primitives: int
    """No primitive is added beyond this number."""
    rates: Rates
    density: Density

    def __post_init__(self) -> None:
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


def as_rows(values: Tensor) -> Tensor:
    """[N, ...] with at least two dimensions."""
    return values.view(len(values), -1)


def children(rows: dict[str, Tensor], shrink: float, generator: torch.Generator) -> dict[str, Tensor]:
    """One child of each parent: drawn from the parent's Gaussian, `shrink` times smaller (spec 7, split)."""
    noise = torch.randn(rows["means"].shape, generator=generator).to(rows["means"])
    offset = rotation_matrices(rows["quats"]) @ (noise * rows["log_scales"].exp())[:, :, None]
    return rows | {
        "means": rows["means"] + offset[:, :, 0],
        "log_scales": rows["log_scales"] - math.log(shrink),
    }


class GS3D:
    """Explicit Gaussians, N rows in every parameter."""

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
        raw = initial_parameters(scene.points, options.sh_degree, options.initial_opacity)
        self.table = Table({name: Parameter(value.to(beginning.device)) for name, value in raw.items()})
        self.statistics = Statistics.zeros(len(self.table), beginning.device)

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
        return Splats(
            means=table["means"],
            scales=table["log_scales"].clamp(max=LARGEST_LOG_SCALE).exp(),
            quats=table["quats"],
            log_opacities=logsigmoid(table["opacity_logits"]),
            colours=colours_of(table["sh_constant"], table["sh_rest"], offsets, self.active_degree),
        )

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
        finite = [torch.isfinite(as_rows(p.detach())).all(1) for p in self.table.parameters.values()]
        kept = torch.stack(finite).all(0)
        keep_rows(self.table, kept)
        self.statistics = Statistics(self.statistics.gradient[kept], self.statistics.count[kept])
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
        chosen = self.within_cap(gradient, gradient >= density.gradient)
        large = self.largest_scales() > density.split_extent * self.extent
        cloned, split = chosen & ~large, chosen & large
        self.clone_and_split(cloned, split)
        pruned = self.prune(step)
        self.statistics = Statistics.zeros(len(self.table), gradient.device)
        return {"cloned": int(cloned.sum()), "split": int(split.sum()), "pruned": pruned}

    def within_cap(self, gradient: Float[Tensor, "N"], chosen: Bool[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Of the chosen, those with the largest gradients that fit under max_primitives (each adds one)."""
        room = max(0, self.options.max_primitives - len(self.table))
        if int(chosen.sum()) <= room:
            return chosen
        ranked = torch.where(chosen, gradient, -1.0).argsort(descending=True, stable=True)[:room]
        return torch.zeros_like(chosen).index_fill_(0, ranked, True)

    def clone_and_split(self, cloned: Bool[Tensor, "N"], split: Bool[Tensor, "N"]) -> None:
        """Rows become: survivors, clones, first children, second children."""
        raw = {name: parameter.detach() for name, parameter in self.table.parameters.items()}
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
        """o <- min(o, reset_opacity), moments zeroed (spec 7)."""
        highest = self.options.density.reset_opacity
        logits = self.table["opacity_logits"].detach().clamp(max=math.log(highest / (1 - highest)))
        reset_column(self.table, "opacity_logits", logits)

    def largest_scales(self) -> Float[Tensor, "N"]:
        """Largest standard deviation of each primitive, world units."""
        return self.table["log_scales"].detach().amax(1).exp()

    # -- what others need --------------------------------------------------------------------------------------

    def size(self) -> tuple[int, int]:
        """(primitives, bytes of their parameters)."""
        return len(self.table), sum(p.numel() * p.element_size() for p in self.table.parameters.values())

    def explicit(self) -> Gaussians:
        """The raw parameters, as a splat file holds them."""
        raw = {name: parameter.detach() for name, parameter in self.table.parameters.items()}
        raw["sh_constant"] = raw["sh_constant"][:, 0]
        raw["quats"] = normalize(raw["quats"], dim=1)
        return Gaussians(**raw)

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
        out: dict[str, Tensor] = {
            "statistics.gradient": self.statistics.gradient,
            "statistics.count": self.statistics.count,
        }
        for name, parameter in self.table.parameters.items():
            out[f"parameters.{name}"] = parameter.detach()
            for key, value in self.table.optimiser.state.get(parameter, {}).items():
                out[f"adam.{name}.{key}"] = value
        return out

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave."""
        device = self.statistics.gradient.device
        names = list(self.table.parameters)
        self.table = Table({n: Parameter(tensors[f"parameters.{n}"].to(device)) for n in names})
        for name, parameter in self.table.parameters.items():
            if f"adam.{name}.step" in tensors:
                state = {key: tensors[f"adam.{name}.{key}"] for key in ("step", "exp_avg", "exp_avg_sq")}
                self.table.optimiser.state[parameter] = {key: value.to(device) for key, value in state.items()}
        self.statistics = Statistics(tensors["statistics.gradient"].to(device), tensors["statistics.count"].to(device))
