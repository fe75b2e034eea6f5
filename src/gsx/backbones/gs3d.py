"""3D Gaussian Splatting (Kerbl et al. 2023): explicit Gaussians with adaptive density control (3D-GS)."""

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.nn.functional import logsigmoid, normalize

from gsx.backbones.clone_split import (
    LevelDensityOptions,
    bias_levels,
    clones,
    densify_masks,
    small_children,
    stacked,
    starting_points,
)
from gsx.backbones.growth_options import Quirks
from gsx.backbones.level_options import LevelOptions, checked_end
from gsx.backbones.levels import Levels, all_levels_from, derive, drawn, facts_of, kept, note_of, quantile, warnings_of
from gsx.backbones.mip import MipOptions, checked_filter, filter_sizes, filtered_rules, logit_of_log, smoothed
from gsx.backbones.sampling import sampled_means
from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.scene import PointCloud
from gsx.core.errors import InputError
from gsx.core.gaussians.neighbours import mean_square_distance
from gsx.core.gaussians.quaternions import make_identity_where_zero
from gsx.core.gaussians.sh import colours_of, constant_from_colour
from gsx.core.gaussians.splat_files import columns_of
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.rasterizer import Rendering, drawable, take_rows
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import BackboneContext, Observation
from gsx.core.training.density import (
    ParameterTable,
    Statistics,
    append_rows,
    densification_statistics,
    finite_rows,
    keep_rows,
    reset_column,
    restored_table,
    room_under,
    table_tensors,
    withheld,
    within_room,
)
from gsx.core.training.schedule import log_linear

logger = logging.getLogger(__name__)

LARGEST_LOG_SCALE = 30.0
"""Scales are held below e^30 world units, so that their squares stay finite in float32."""
LEAST_WEIGHT = 1e-37
"""A level that has yet to fade in counts as this much of its opacity: the logarithm is finite."""
LEAST_SQUARE_DISTANCE = 1e-7
"""Lower bound of the squared neighbour distance that sets the initial scale (3D-GS, simple-knn)."""


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Adam learning rates (3D-GS, arguments)."""

    means_first: float
    means_last: float
    sh_constant: float
    sh_rest: float
    opacity_logits: float
    log_scales: float
    quats: float


@dataclass(frozen=True, kw_only=True)
class Density:
    """Adaptive density control in steps of the published run (3D-GS, train.py)."""

    start: int
    stop: int
    every: int
    gradient: float
    """Mean NDC gradient at or above which a primitive is cloned or split."""
    absolute: bool
    """Also clone or split as many again by the mean of absolute gradients (Mip-Splatting, densify_and_prune)."""
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
    """No primitive is added beyond this number; 0: none is withheld."""
    rates: Rates
    density: Density
    mip: MipOptions
    levels: LevelOptions | None = None
    """Levels of detail (Octree-GS), with density control across them; None: every camera draws everything."""
    level_density: LevelDensityOptions | None = None
    quirks: Quirks | None = None
    """With levels: the switches of their reference, of which `gate` and `bias` concern free Gaussians."""
    decay_until: int = 0
    """Published step at which the rate of the means has come down; 0: at the end of the run."""

    def __post_init__(self) -> None:
        checked_filter(self.filter)
        if self.sh_degree not in range(4):
            raise ValueError(f"backbone.sh_degree is {self.sh_degree}; choose 0 to 3")
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"backbone.initial_opacity is {self.initial_opacity}; give a value between 0 and 1")
        if self.published_iterations < 1 or self.max_primitives < 0:
            raise ValueError("backbone.published_iterations must be at least 1, backbone.max_primitives at least 0")
        if not (self.rates.means_first > 0 and self.rates.means_last > 0):
            raise ValueError("backbone.rates.means_first and means_last must be positive: they decay log-linearly")
        checked_end(self.levels, self.published_iterations)
        if len({part is None for part in (self.levels, self.level_density, self.quirks)}) > 1:
            raise ValueError(
                "backbone.levels, level_density and quirks belong together: give all, or take backbone=gs3d for none"
            )


def initial_parameters(points: PointCloud, sh_degree: int, opacity: float) -> dict[str, Tensor]:
    """Raw parameters of one Gaussian per point (3D-GS, create_from_pcd and simple-knn)."""
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
    """One child of each parent: drawn from the parent's Gaussian, `shrink` times smaller (3D-GS, train.py)."""
    return rows | {"means": sampled_means(rows, generator), "log_scales": rows["log_scales"] - math.log(shrink)}


def without_normals(columns: dict[str, Tensor]) -> dict[str, Tensor]:
    """The columns of a splat file but nx, ny, nz."""
    return {name: column for name, column in columns.items() if name not in ("nx", "ny", "nz")}


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown:
    """Parameters of what a camera draws of N Gaussians."""

    values: dict[str, Tensor]
    """Parameters and columns, M rows."""
    rows: Int[Tensor, "M"] | None = None
    """Rows of the table; None: all of them."""
    weights: Float[Tensor, "M"] | None = None
    """Factors of the opacities; None: 1."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnGaussians:
    """Splats of a camera, and the rows of the table that they come from."""

    splats: Splats
    rows: Int[Tensor, "M"] | None
    """None: all of them."""


class GS3D:
    """Explicit Gaussians, N rows in every parameter; at several levels of detail if asked for (GSOctree)."""

    def __init__(self, options: GS3DOptions, context: BackboneContext) -> None:
        scene = context.scene
        if len(scene.points) == 0:
            raise InputError(f"scene '{scene.name}' has no points to start from: give it points or scene.points=random")
        self.options = options
        self.extent = scene.extent
        self.white = bool((scene.background == 1).all())
        self.generator = context.generator
        self.schedule = context.schedule(options.published_iterations)
        self.raster = filtered_rules(context.raster, options.filter, options.mip)
        self.absolute_gradient = options.density.absolute
        self.cameras = [view.camera for view in scene.train]
        self.levels = self.derived_levels(scene.points)
        self.standard_file = self.levels is None
        self.table = self.initial_table(scene.points, context.device)
        self.statistics = Statistics.zeros(len(self.table), context.device, options.density.absolute)
        self.refresh_filter()

    def derived_levels(self, points: PointCloud) -> Levels | None:
        """The levels of the scene, None if there are to be none."""
        options = self.options.levels
        if options is None:
            return None
        until = all_levels_from(options, self.schedule)
        return derive(points.positions.float(), self.cameras, options, until)

    def initial_table(self, points: PointCloud, device: torch.device) -> ParameterTable:
        """One Gaussian per point, or per node of the levels."""
        columns: dict[str, Tensor] = {}
        if self.levels is not None:
            points, columns = starting_points(points, self.levels)
            for warning in warnings_of(self.levels, len(points)):
                logger.warning("%s", warning)
        raw = initial_parameters(points, self.options.sh_degree, self.options.initial_opacity)
        return ParameterTable(
            {name: Parameter(value.to(device)) for name, value in raw.items()},
            {name: value.to(device) for name, value in columns.items()},
        )

    # -- one step, in the order the trainer calls --------------------------------------------------------------

    def active_degree(self, step: int) -> int:
        """SH degree at a step (3D-GS, sh_utils.py)."""
        return min(self.options.sh_degree, step // max(1, self.schedule.step(self.options.sh_every)))

    def draw(self, camera: Camera, step: int) -> DrawnGaussians:
        """The Gaussians that the camera draws, with their colours as seen from there."""
        shown = self.shown(camera, step)
        values = shown.values
        offsets = offsets_from(values["means"], camera.centre)
        scales, log_opacities = self.extents(shown)
        splats = Splats(
            means=values["means"],
            scales=scales,
            quats=values["quats"],
            log_opacities=log_opacities,
            colours=colours_of(values["sh_constant"], values["sh_rest"], offsets, self.active_degree(step)),
        )
        return DrawnGaussians(splats=splats, rows=shown.rows)

    def everything(self) -> Shown:
        """All Gaussians."""
        return Shown(values={**self.table.parameters, **self.table.columns})

    def shown(self, camera: Camera, step: int) -> Shown:
        """All Gaussians, or those of the levels that the camera draws (Octree-GS, set_anchor_mask)."""
        if self.levels is None:
            return self.everything()
        means, level, bias = (self.table[name] for name in ("means", "level", "bias"))
        mask, weights = drawn(self.levels, means.detach(), level, bias, camera, self.levels.highest(step))
        rows = mask.nonzero()[:, 0]
        values = {name: take_rows(parameter, rows) for name, parameter in self.table.parameters.items()}
        values |= {name: column[rows] for name, column in self.table.columns.items()}
        return Shown(values=values, rows=rows, weights=weights[rows])

    def extents(self, shown: Shown) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
        """Scales and log-opacities as they are drawn, after the 3D filter if there is one."""
        scales = shown.values["log_scales"].clamp(max=LARGEST_LOG_SCALE).exp()
        log_opacities = logsigmoid(shown.values["opacity_logits"])
        if shown.weights is not None:
            log_opacities = log_opacities + shown.weights.clamp_min(LEAST_WEIGHT).log()
        if self.options.filter == "none":
            return scales, log_opacities
        return smoothed(scales, log_opacities, shown.values["filter"])

    def regulariser(self, drawn: DrawnGaussians) -> Float[Tensor, ""] | None:
        """3D-GS has none; across levels the mean volume of what was drawn, 0 for nothing (GSOctree)."""
        control = self.options.level_density
        if control is None or not control.volume_weight:
            return None
        volumes = drawn.splats.scales.prod(1)
        return control.volume_weight * volumes.sum() / max(1, len(volumes))

    def observe(self, drawn: DrawnGaussians, rendering: Rendering, step: int, weight: float = 1.0) -> Observation:
        """Screen gradients, which count until density control ends (3D-GS, train.py)."""
        if step >= self.schedule.step(self.options.density.stop):
            return {}
        return densification_statistics(rendering.screen, drawn.rows, weight)

    def accumulate(self, seen: Observation) -> None:
        """Add screen gradients to the statistics."""
        if seen:
            self.statistics.add(seen)

    def densify_and_prune(self, step: int) -> dict[str, int]:
        """Clone, split, prune and reset when due."""
        done: dict[str, int] = {}
        if self.density_due(step):
            done |= self.densify(step) if self.levels is None else self.densify_levels(step, self.levels)
        if done or self.filter_due(step):
            self.refresh_filter()
        if self.reset_due(step):
            self.reset_opacities()
            done["opacity_resets"] = 1
        return done

    def set_rates(self, step: int) -> None:
        """Learning rates of a step (3D-GS, arguments)."""
        rates = self.options.rates
        steps = self.schedule.step(self.options.decay_until or self.options.published_iterations)
        self.table.set_rate("means", self.extent * log_linear(step, steps, rates.means_first, rates.means_last))
        for name in ("sh_constant", "sh_rest", "opacity_logits", "log_scales", "quats"):
            self.table.set_rate(name, getattr(rates, name))

    def update(self, step: int) -> None:
        """One Adam step. Unused SH bands take part with zero gradients, as in the published code (3D-GS)."""
        rest = self.table["sh_rest"]
        if rest.grad is None and self.table["sh_constant"].grad is not None:
            rest.grad = torch.zeros_like(rest)
        self.set_rates(step)
        self.table.optimiser.step()
        make_identity_where_zero(self.table["quats"])
        self.zero_grad()

    def parameters(self) -> Iterable[tuple[str, Parameter]]:
        """Parameters by name."""
        return self.table.parameters.items()

    def gradients(self) -> Iterable[tuple[str, Tensor]]:
        """Gradients by parameter name."""
        return ((name, p.grad) for name, p in self.parameters() if p.grad is not None)

    def shared(self) -> Iterable[Tensor]:
        """Every Gaussian has a colour of its own."""
        return ()

    @torch.no_grad()
    def remove_nonfinite(self, cameras: Sequence[Camera], step: int) -> int:
        """Remove rows with a value that is not finite, or without a splat for a camera, with their statistics."""
        sound = finite_rows(self.table)
        for camera in cameras:
            sound &= self.usable_for(camera, step)
        if bool(sound.all()) or not bool(sound.any()):
            return 0
        keep_rows(self.table, sound)
        self.statistics = self.statistics.rows(sound)
        return int((~sound).sum())

    def usable_for(self, camera: Camera, step: int) -> Bool[Tensor, "N"]:
        """Rows that the camera draws or has no business with: False for splats or volumes that are out of range."""
        drawn = self.draw(camera, step)
        good = drawable(drawn.splats, camera, self.raster) & torch.isfinite(drawn.splats.scales.prod(1))
        if drawn.rows is None:
            return good
        return torch.ones_like(self.table["level"], dtype=torch.bool).index_copy_(0, drawn.rows, good)

    def zero_grad(self) -> None:
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
        """Every reset interval while density control runs, and once early on a white background.

        Never across levels: the published schedule does not reach one (GSOctree).
        """
        if self.levels is not None:
            return False
        density = self.options.density
        regular = step % self.reset_interval() == 0 and step < self.schedule.step(density.stop)
        return regular or (self.white and step == max(1, self.schedule.step(density.white_reset)))

    def densify(self, step: int) -> dict[str, int]:
        """Clone small and split large primitives with large gradients, then prune (3D-GS, train.py)."""
        density = self.options.density
        gradient = self.statistics.mean_gradient()
        wanted = self.candidates(gradient)
        chosen = within_room(wanted, gradient, self.room())  # each adds one
        large = self.largest_scales() > density.split_extent * self.extent
        cloned, split = chosen & ~large, chosen & large
        self.clone_and_split(cloned, split)
        pruned = self.prune(step)
        self.statistics = Statistics.zeros(len(self.table), gradient.device, density.absolute)
        done = {"cloned": int(cloned.sum()), "split": int(split.sum()), "pruned": pruned}
        return done | withheld(wanted, chosen)

    def densify_levels(self, step: int, levels: Levels) -> dict[str, int]:
        """Copies of small Gaussians on their level, children of large ones a level finer, then prune (GSOctree)."""
        density, control, quirks = self.options.density, self.options.level_density, self.options.quirks
        assert control is not None
        assert quirks is not None
        gradient, level = self.statistics.mean_gradient(), self.table["level"]
        raw = {name: parameter.detach() for name, parameter in self.table.parameters.items()} | self.table.columns
        masks = densify_masks(
            gradient,
            raw["log_scales"].exp(),
            level,
            levels,
            control,
            threshold=density.gradient,
            large=density.split_extent * self.extent,
            splitting=quirks.gate == "open" or levels.highest(step) == levels.count - 1,
        )
        cloned, split = (mask.nonzero()[:, 0] for mask in (masks.cloned, masks.split))
        children_made = small_children(raw, split, levels, control.shrink, self.generator)
        new = stacked([clones(raw, cloned), children_made])
        seen = kept(levels, new["means"], new["level"])
        keep = within_room(seen, gradient[torch.cat([cloned, split])], self.room())
        bias_levels(self.table, masks.biased, control.bias_step, 1.0 if quirks.bias == "own" else math.inf)
        append_rows(self.table, {name: value[keep] for name, value in new.items()})
        pruned = self.prune(step)
        self.statistics = Statistics.zeros(len(self.table), gradient.device, density.absolute)
        done = {"cloned": int(keep[: len(cloned)].sum()), "split": int(keep[len(cloned) :].sum()), "pruned": pruned}
        return done | withheld(seen, keep)

    def candidates(self, gradient: Float[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Primitives to clone or split: by mean gradient, and as many again by mean absolute gradient (Mip-Splatting).

        Ours: never those without any gradient. Where none has one the published rule would choose all.
        """
        chosen = gradient >= self.options.density.gradient
        if not self.options.density.absolute:
            return chosen
        absolute = self.statistics.mean_absolute()
        quiet = 1 - int(chosen.sum()) / len(chosen)
        return chosen | ((absolute >= quantile(absolute, quiet)) & (absolute > 0))

    def room(self) -> int:
        """Primitives that may be added under max_primitives."""
        return room_under(self.options.max_primitives, len(self.table))

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
        if bool(doomed.all()):  # a cloud about to vanish keeps what it has (gaussian-splatting issue 482)
            return 0
        keep_rows(self.table, ~doomed)
        return int(doomed.sum())

    def reset_opacities(self) -> None:
        """o <- min(o, reset_opacity), moments zeroed (3D-GS); with a 3D filter o is what is drawn (Mip-Splatting)."""
        highest, logits = self.options.density.reset_opacity, self.table["opacity_logits"].detach()
        excess = (self.extents(self.everything())[1].detach() - math.log(highest)).clamp_min(0)
        lowered = torch.where(excess > 0, logit_of_log(logsigmoid(logits) - excess), logits)
        reset_column(self.table, "opacity_logits", lowered)

    # -- the 3D filter -----------------------------------------------------------------------------------------

    def filter_due(self, step: int) -> bool:
        """Every interval between the end of density control and the freezing of the filter (Mip-Splatting)."""
        mip, begun = self.options.mip, self.schedule.step(self.options.density.stop)
        return begun < step < self.schedule.step(mip.stop) and step % self.schedule.interval(mip.every) == 0

    def refresh_filter(self) -> None:
        """Filter sizes from where the primitives are now (Mip-Splatting, compute_3D_filter)."""
        if self.options.filter == "mip":
            means = self.table["means"].detach()
            self.table.columns["filter"] = filter_sizes(means, self.cameras, self.options.mip)

    def largest_scales(self) -> Float[Tensor, "N"]:
        """Largest standard deviation of each primitive, world units."""
        return self.table["log_scales"].detach().amax(1).exp()

    # -- what others need --------------------------------------------------------------------------------------

    def size(self) -> tuple[int, int]:
        """(primitives, bytes of their parameters and levels)."""
        stored: list[Tensor] = [*self.table.parameters.values()]
        stored += [self.table[name] for name in ("level", "bias") if name in self.table.columns]
        return len(self.table), sum(value.numel() * value.element_size() for value in stored)

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        """What `gaussians` makes of what the camera draws; without a camera of all levels."""
        return self.gaussians(self.everything() if camera is None else self.shown(camera, step))

    def gaussians(self, shown: Shown) -> Gaussians:
        """Parameters as a splat file holds them, the 3D filter fused into scales and opacities (Mip-Splatting)."""
        raw = {name: shown.values[name].detach() for name in self.table.parameters}
        if self.options.filter == "mip" or shown.weights is not None:
            scales, log_opacities = self.extents(shown)
            raw |= {"log_scales": scales.detach().log(), "opacity_logits": logit_of_log(log_opacities.detach())}
        raw["sh_constant"] = raw["sh_constant"][:, 0]
        raw["quats"] = normalize(raw["quats"], dim=1)
        return Gaussians(**raw)

    def file(self) -> dict[str, Tensor]:
        """The standard 62 properties (3D-GS, save_ply); levels stand where normals would be (Octree-GS, save_ply)."""
        columns = columns_of(self.gaussians(self.everything()))
        if self.levels is None:
            return columns
        info = torch.zeros_like(columns["nx"])
        info[:1] = self.levels.farthest
        levels = {"level": self.table["level"].float(), "extra_level": self.table["bias"], "info": info}
        return {axis: columns.pop(axis) for axis in "xyz"} | levels | without_normals(columns)

    def export_notes(self) -> list[str]:
        """Whether the 3D filter is in the file, and what chooses the levels at a distance."""
        filtered = "3D filter fused into scales and opacities" if self.options.filter == "mip" else "no 3D filter"
        return [filtered] + ([] if self.levels is None else [note_of(self.levels)])

    def plan(self) -> dict[str, Any]:
        """The schedule in steps of this run."""
        density, steps = self.options.density, self.schedule
        resets = {"every": self.reset_interval(), "until": steps.step(density.stop)} | (
            {"white_background": max(1, steps.step(density.white_reset))} if self.white else {}
        )
        return {
            "densify": {
                "from": steps.step(density.start),
                "until": steps.step(density.stop),
                "every": steps.interval(density.every),
            },
            **({"opacity_reset": resets} if self.levels is None else {}),
            "prune_huge": {"from": self.reset_interval()},
            "sh_degree": {
                "every": max(1, steps.step(self.options.sh_every)),
                "up_to": self.options.sh_degree,
            },
            "means_rate": {
                "from": self.options.rates.means_first * self.extent,
                "to": self.options.rates.means_last * self.extent,
                "over": steps.step(self.options.decay_until or self.options.published_iterations),
            },
            **({} if self.levels is None else {"levels": facts_of(self.levels, self.table["level"])}),
        }

    def tensors(self) -> dict[str, Tensor]:
        """Parameters, Adam moments and step counts, statistics."""
        return table_tensors(self.table) | self.statistics.tensors()

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave."""
        device = self.statistics.gradient.device
        self.table = restored_table(self.table, tensors, device)
        self.statistics = Statistics.restored(tensors, device)
