"""3D Gaussian Splatting (Kerbl et al. 2023): explicit Gaussians with adaptive density control (3D-GS)."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.nn.functional import logsigmoid, normalize

from gsx.backbones.gs3d_options import GS3DOptions
from gsx.backbones.gs3d_parts import (
    AllVisible,
    CloneSplit,
    Densification,
    DrawnGaussians,
    Shown,
    Visibility,
    everything,
)
from gsx.backbones.mip import filter_sizes, filtered_rules, logit_of_log, smoothed
from gsx.backbones.sampling import quantile
from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.scene import PointCloud
from gsx.core.gaussians.neighbours import LEAST_SQUARE_DISTANCE, mean_square_distance
from gsx.core.gaussians.quaternions import make_identity_where_zero
from gsx.core.gaussians.sh import colours_of, constant_from_colour
from gsx.core.gaussians.splat_files import columns_of
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.rasterizer import Rendering, drawable
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import BackboneContext, Observation
from gsx.core.training.density import (
    ParameterTable,
    Statistics,
    densification_statistics,
    finite_rows,
    keep_rows,
    reset_column,
    restored_table,
    room_under,
    table_tensors,
)
from gsx.core.training.schedule import log_linear

LARGEST_LOG_SCALE = 30.0
"""Scales are held below e^30 world units, so that their squares stay finite in float32."""
LEAST_WEIGHT = 1e-37
"""A Gaussian that has yet to fade in counts as this much of its opacity: the logarithm is finite."""


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


def without_normals(columns: dict[str, Tensor]) -> dict[str, Tensor]:
    """The columns of a splat file but nx, ny, nz."""
    return {name: column for name, column in columns.items() if name not in ("nx", "ny", "nz")}


def gs3d(options: GS3DOptions, context: BackboneContext) -> "GS3D":
    """The backbones gs3d and mip_splatting."""
    return GS3D(options, context, AllVisible(), CloneSplit())


class GS3D:
    """Explicit Gaussians, N rows in every parameter."""

    def __init__(
        self, options: GS3DOptions, context: BackboneContext, visibility: Visibility, densification: Densification
    ) -> None:
        scene = context.scene
        self.options, self.visibility, self.densification = options, visibility, densification
        self.extent = scene.extent
        self.white = bool((scene.background == 1).all())
        self.generator = context.generator
        self.schedule = context.schedule(options.published_iterations)
        self.raster = filtered_rules(context.raster, options.filter, options.mip)
        self.absolute_gradient = options.density.absolute
        self.cameras = [view.camera for view in scene.train]
        self.table = self.initial_table(context.points(), context.device)
        self.statistics = Statistics.zeros(len(self.table), context.device, options.density.absolute)
        self.standard_file = not self.visibility.columns(self.table)
        self.refresh_filter()

    def initial_table(self, points: PointCloud, device: torch.device) -> ParameterTable:
        """A Gaussian for each point that visibility starts from."""
        points, columns = self.visibility.start(points)
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
        shown = self.visibility.shown(self.table, camera, step)
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
        """That of density control; 3D-GS has none."""
        return self.densification.regulariser(drawn)

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
            done |= self.densify(step)
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
        return torch.ones(len(self.table), dtype=torch.bool, device=good.device).index_copy_(0, drawn.rows, good)

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
        """Every reset interval while density control runs, and once early on a white background; or never."""
        if not self.densification.resets:
            return False
        density = self.options.density
        regular = step % self.reset_interval() == 0 and step < self.schedule.step(density.stop)
        return regular or (self.white and step == max(1, self.schedule.step(density.white_reset)))

    def densify(self, step: int) -> dict[str, int]:
        """Density control's own way, then prune (3D-GS, densify_and_prune: the order in one event)."""
        done = self.densification.densify(self, step)
        done["pruned"] = self.prune(step)
        self.statistics = Statistics.zeros(len(self.table), self.statistics.count.device, self.absolute_gradient)
        return done

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
        excess = (self.extents(everything(self.table))[1].detach() - math.log(highest)).clamp_min(0)
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
        """(primitives, bytes of parameters and columns, but for filter sizes)."""
        stored: list[Tensor] = [*self.table.parameters.values()]
        stored += [column for name, column in self.table.columns.items() if name != "filter"]
        return len(self.table), sum(value.numel() * value.element_size() for value in stored)

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        """What `gaussians` makes of what the camera draws; without a camera of all Gaussians."""
        shown = everything(self.table) if camera is None else self.visibility.shown(self.table, camera, step)
        return self.gaussians(shown)

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
        """The standard 62 properties (3D-GS, save_ply); further columns stand where normals would be."""
        columns, more = columns_of(self.gaussians(everything(self.table))), self.visibility.columns(self.table)
        if not more:
            return columns
        return {axis: columns.pop(axis) for axis in "xyz"} | more | without_normals(columns)

    def export_notes(self) -> list[str]:
        """Whether the 3D filter is in the file, and what visibility has to say."""
        filtered = "3D filter fused into scales and opacities" if self.options.filter == "mip" else "no 3D filter"
        return [filtered, *self.visibility.notes()]

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
            **({"opacity_reset": resets} if self.densification.resets else {}),
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
            **self.visibility.plan(self.table),
        }

    def tensors(self) -> dict[str, Tensor]:
        """Parameters, Adam moments and step counts, statistics."""
        return table_tensors(self.table) | self.statistics.tensors()

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave."""
        device = self.statistics.gradient.device
        self.table = restored_table(self.table, tensors, device)
        self.statistics = Statistics.restored(tensors, device)
