"""3D Gaussian Splatting (Kerbl et al. 2023): explicit Gaussians with adaptive density control (3D-GS)."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.nn.functional import normalize

from gsx.backbones.capacity import MOST_VIEWS
from gsx.backbones.density import add_statistics, densification_statistics, gradient_statistics
from gsx.backbones.density_control import CloneSplit, DensityControl
from gsx.backbones.gs3d_options import GS3DOptions
from gsx.backbones.long_axis import LongAxis
from gsx.backbones.mcmc import MCMC
from gsx.backbones.mip import absorb, filter_named
from gsx.backbones.neighbours import LEAST_SQUARE_DISTANCE, mean_square_distance
from gsx.backbones.scene_model import SceneModel
from gsx.backbones.sh_degrees import ChosenDegrees, choose_degrees, colour_fits, hold_bands, lower_degrees, numbers_of
from gsx.backbones.sky import NOTHING, SKY_OPACITY, WIDEST, far_away, sky_behind
from gsx.backbones.visibility import Visibility, VisibleGaussians, everything, extents
from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.scene import PointCloud
from gsx.core.errors import InputError
from gsx.core.gaussians.sh import colours_of, constant_from_colour, degree_of
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.rasterizer import Rendering
from gsx.core.shapes import Float, Int
from gsx.core.training.backbone import BackboneContext, Drawn, DrawnSplats, Observation
from gsx.core.training.importance import Probe, random_views
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.schedule import log_linear
from gsx.formats.smoothing import logit_of_log, unsmoothed
from gsx.formats.splat_files import columns_of


def initial_parameters(points: PointCloud, sh_degree: int, opacity: float, scale: float = 1.0) -> dict[str, Tensor]:
    """Returns raw parameters of one Gaussian per point (3D-GS, create_from_pcd and simple-knn).

    scale: sizes over the distances of neighbours.
    """
    positions, count = points.positions.float(), len(points)
    distance = mean_square_distance(positions).clamp_min(LEAST_SQUARE_DISTANCE)
    return {
        "means": positions.clone(),
        "sh_dc": constant_from_colour(points.colours.float() / 255)[:, None],
        "sh_rest": torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        "opacity_logits": torch.full((count,), math.log(opacity / (1 - opacity))),
        "log_scales": (scale * distance.sqrt()).log()[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
    }


def raw_parameters(gaussians: Gaussians, sh_degree: int) -> dict[str, Tensor]:
    """Returns raw parameters of Gaussians with missing bands set to 0; InputError: they have more bands."""
    rest, bands = gaussians.sh_rest, (sh_degree + 1) ** 2 - 1
    if rest.shape[1] > bands:
        degree = degree_of(rest.shape[1])
        raise InputError(f"init: the file has SH degree {degree}, backbone.sh_degree is {sh_degree}: raise it")
    missing = rest.new_zeros(len(rest), bands - rest.shape[1], 3)
    return vars(gaussians) | {"sh_dc": gaussians.sh_dc[:, None], "sh_rest": torch.cat([rest, missing], 1)}


def choose_sh_degrees(model: "GS3D", step: int) -> dict[str, float]:
    """Keeps the colour bands of each Gaussian that change renders of training views by more than their price."""
    highest, context, price = model.active_degree(step), model.context, model.options.sh_price
    if not highest:
        return {}
    other = sum(value[0].numel() for name, value in model.table.parameters.items() if not name.startswith("sh_"))
    views = random_views(context.views.at(step), MOST_VIEWS, context.generator)

    def estimate() -> ChosenDegrees:
        probe = Probe(model=model, views=context.views, step=step)
        fits = colour_fits(probe, views, context.generator, highest - 1)
        return choose_degrees(fits, price, numbers_of(highest, other)).to("cpu")

    return lower_degrees(model.table, context.on_rank0(estimate).to(context.device), step, price)


def gs3d(options: GS3DOptions, context: BackboneContext) -> "GS3D":
    """Builds the backbones gs3d, gs3d_zoom and mip_splatting."""
    controls = {"published": CloneSplit, "mcmc": MCMC}
    return GS3D(options, context, Visibility(), controls.get(options.capacity, LongAxis)(options, context))


class GS3D(SceneModel):
    """Explicit Gaussians, N rows in every parameter."""

    def __init__(
        self, options: GS3DOptions, context: BackboneContext, visibility: Visibility, control: DensityControl
    ) -> None:
        self.options, self.context, self.visibility, self.control = options, context, visibility, control
        self.extent, self.schedule, self.capacity = context.scene.extent, control.schedule, control.capacity
        self.filter = filter_named(options.filter, options.mip, context, self.schedule, control.events.stop)
        self.raster = self.filter.rules(context.raster)
        self.absolute_gradient = options.density.absolute or self.capacity.ranked
        self.sh_degree, self.sh_every, self.volume_weight = options.sh_degree, options.sh_every, control.volume_weight
        self.table = self.initial_table(context.points())
        self.filter.refresh(self.table, self.table["means"])

    def initial_table(self, points: PointCloud) -> ParameterTable:
        """Builds a Gaussian for each initial point, and for each point of the sky."""
        points, columns = self.visibility.start(points)
        control = self.control
        raw = initial_parameters(points, self.options.sh_degree, control.initial_opacity, control.initial_scale)
        if self.options.sky != "never":
            sky = sky_behind(self.context.scene, self.options.sky) if self.context.begins else NOTHING
            behind = initial_parameters(sky.points, self.options.sh_degree, SKY_OPACITY)
            behind["log_scales"].clamp_(math.log(sky.spacing), math.log(WIDEST * sky.spacing))
            raw = {name: torch.cat([value, behind[name]]) for name, value in raw.items()}
            columns = columns | {"sky": (torch.arange(len(raw["means"])) >= len(points)).to(torch.int8)}
        return self.table_of(raw, columns)

    def table_of(self, raw: dict[str, Tensor], columns: dict[str, Tensor]) -> ParameterTable:
        """Builds a table of raw parameters and columns, with statistics 0."""
        count = len(raw["means"])
        if self.options.sh_judged > 0:
            columns = columns | {"sh_degree": torch.full((count,), self.options.sh_degree, dtype=torch.int8)}
        return self.new_table(raw, columns, gradient_statistics(count, self.context.device, self.absolute_gradient))

    def start_from(self, gaussians: Gaussians) -> None:
        """Replaces the model by Gaussians of a file; it removes the 3D filter first, so that renders stay equal.

        Raises:
            InputError: they have more bands than the model, or the model has levels.
        """
        if self.visibility.by_level:
            raise InputError("init: a splat file has no levels: choose backbone=gs3d or mip_splatting")
        raw = raw_parameters(gaussians, self.options.sh_degree)
        self.first_degree = self.options.sh_degree
        columns = {}
        if self.options.sky != "never":
            columns["sky"] = far_away(raw["means"], self.context.scene).to(torch.int8)
        self.table = self.table_of(raw, columns)
        self.filter.refresh(self.table, self.table["means"])
        if "filter" in self.table.columns:
            with torch.no_grad():
                before = unsmoothed(raw["log_scales"], raw["opacity_logits"], self.table["filter"].to(raw["means"]))
                for name, value in zip(("log_scales", "opacity_logits"), before, strict=True):
                    self.table[name].copy_(value)

    # -- one step, in the order the trainer calls --------------------------------------------------------------

    def draw(self, camera: Camera, step: int) -> DrawnSplats:
        """Returns the Gaussians that the camera draws, with their colours towards it."""
        visible = self.visibility.visible(self.table, camera, step)
        values = visible.values
        scales, log_opacities = extents(self.table, visible)
        offsets, degree = offsets_from(values["means"], camera.centre), self.active_degree(step)
        backend = self.raster.backend.on(scales.device.type, learning=True)
        splats = Splats(
            means=values["means"],
            scales=scales,
            quats=values["quats"],
            log_opacities=log_opacities,
            colours=colours_of(values["sh_dc"], values["sh_rest"], offsets, degree, backend),
        )
        return DrawnSplats(splats=splats, rows=visible.rows)

    def observe(self, drawn: DrawnSplats, rendering: Rendering, step: int, weight: float = 1.0) -> Observation:
        """Returns screen gradients until density control needs no more (3D-GS, train.py)."""
        if step >= self.control.observed_until:
            return {}
        return densification_statistics(rendering.screen, drawn.rows, weight)

    def accumulate(self, observation: Observation) -> None:
        """Adds screen gradients to the statistics."""
        if observation:
            add_statistics(self.table, observation)

    def densify_and_prune(self, step: int) -> dict[str, float]:
        """Removes rows in empty space once; clones, splits, prunes and resets when due."""
        metrics = self.capacity.remove_empty(self.table, self.table["means"]) if step == 1 else {}
        due = self.control.events.due(step)
        if due and self.control.after_adam:
            self.learn(step)
        metrics |= self.control.densify(self, step) if due else {}
        if metrics or self.filter.due(step):
            before = self.table.columns.get("filter")
            self.filter.refresh(self.table, self.table["means"], step)
            if before is not None and self.filter.narrows(step):  # renders stay equal
                absorb(self.table, before, self.table["filter"])
        if self.control.reset_due(step):
            self.control.reset_opacities(self.table)
            metrics["opacity_resets"] = 1
        if step == self.sh_step():
            metrics |= choose_sh_degrees(self, step)
        return metrics

    def milestones(self) -> list[int]:
        """Returns the events of density control, when it ends, and when SH degrees are chosen."""
        return [*self.control.events.steps(), self.control.events.stop, self.sh_step()]

    def sh_step(self) -> int:
        """Returns the step at which SH degrees are chosen; 0: at none."""
        return round(self.options.sh_judged * self.schedule.iterations)

    def means_rate_steps(self) -> int:
        """Returns the step at which the learning rate of the means reaches its last value."""
        return self.schedule.step(self.options.decay_until or self.options.published_iterations)

    def set_rates(self, step: int) -> None:
        """Sets the learning rates of a step (3D-GS, arguments)."""
        rates, faster = self.options.rates, self.schedule.shortened(self.options.rates.shortened)
        of_means = log_linear(step, self.means_rate_steps(), faster * rates.means_first, rates.means_last)
        self.table.set_rate("means", self.extent * of_means)
        self.table.set_rate("opacity_logits", rates.opacity_logits)
        for name in ("sh_dc", "sh_rest", "log_scales", "quats"):
            self.table.set_rate(name, faster * getattr(rates, name))

    def zero_filled(self) -> Iterable[Parameter]:
        """Returns the SH bands above 0: unused ones take part (3D-GS), edited parameters wait for a gradient."""
        return [self.table.parameters["sh_rest"]]

    def regulariser(self, drawn: Drawn) -> Float[Tensor, ""] | None:
        """Returns the loss term of density control; without one that of the drawn volume."""
        term = self.control.regulariser(self.table)
        return super().regulariser(drawn) if term is None else term

    def update(self, step: int) -> None:
        """Takes one Adam step, unless an event has taken it, and lets density control move Gaussians."""
        self.learn(step)
        self.control.perturb(self.table)

    def learn(self, step: int) -> None:
        """Takes one Adam step by the gradients that there are; bands above the chosen degrees stay 0."""
        if "sh_degree" in self.table.columns and step >= self.sh_step():
            hold_bands(self.table)
        super().update(step)

    # -- files and logs ----------------------------------------------------------------------------------------

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        """Returns Gaussians of a splat file: those that the camera draws, or all without a camera."""
        visible = everything(self.table) if camera is None else self.visibility.visible(self.table, camera, step)
        return self.gaussians(visible)

    def gaussians(self, visible: VisibleGaussians) -> Gaussians:
        """Returns parameters of a splat file with the 3D filter fused into scales and opacities (Mip-Splatting)."""
        raw = {name: visible.values[name].detach() for name in self.table.parameters}
        if self.filter.note or visible.weights is not None:
            scales, log_opacities = extents(self.table, visible)
            raw |= {"log_scales": scales.detach().log(), "opacity_logits": logit_of_log(log_opacities.detach())}
        raw["sh_dc"] = raw["sh_dc"][:, 0]
        raw["quats"] = normalize(raw["quats"], dim=1)
        return Gaussians(**raw)

    def slot_count(self) -> int:
        """Returns the number of Gaussians."""
        return len(self.table)

    def slots(self, drawn: DrawnSplats) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"]]:
        """Returns rows of the table."""
        rows = torch.arange(len(self.table), device=self.table["means"].device) if drawn.rows is None else drawn.rows
        return rows, rows

    def file_columns(self) -> dict[str, Tensor] | None:
        """Returns the standard properties with visibility's columns in place of normals; None if it has none."""
        more = self.visibility.columns(self.table)
        if not more:
            return None
        columns = columns_of(self.gaussians(everything(self.table)))
        rest = {name: column for name, column in columns.items() if name not in (*"xyz", "nx", "ny", "nz")}
        return {axis: columns[axis] for axis in "xyz"} | more | rest

    def file_notes(self) -> list[str]:
        """Returns comments on the 3D filter and on visibility."""
        return [self.filter.note or "no 3D filter", *self.visibility.notes()]

    def plan(self) -> dict[str, Any]:
        """Returns the schedule in steps of this run."""
        rates = self.options.rates
        return {
            **self.control.plan(),
            "sh_degree": {"every": max(1, self.schedule.step(self.options.sh_every)), "up_to": self.options.sh_degree},
            "means_rate": {
                "from": self.schedule.shortened(rates.shortened) * rates.means_first * self.extent,
                "to": rates.means_last * self.extent,
                "over": self.means_rate_steps(),
            },
            **({"sky": {"gaussians": int((self.table["sky"] > 0).sum())}} if "sky" in self.table.columns else {}),
            **self.visibility.plan(self.table),
        }
