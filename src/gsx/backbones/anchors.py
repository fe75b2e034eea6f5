"""Gaussians on anchors of a fixed grid (Scaffold-GS), optionally at several levels of detail (Octree-GS).

A backbone combines a representation (networks or explicit harmonics), a grid with or without levels, and a filter;
these parts do not depend on each other (docs/reference/backbones.md).
"""

import math
import sys
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsx.backbones.anchor_grids import grid_of
from gsx.backbones.anchor_options import ExplicitOptions, HeadRates, NeuralOptions
from gsx.backbones.capacity import event_steps, mark_newborn, without_newborn
from gsx.backbones.capacity_options import capacity_of
from gsx.backbones.cells import pooled_max
from gsx.backbones.decoding import DrawnAnchors, Explicit, Neural, Representation, VisibleAnchors, lengths
from gsx.backbones.density import densification_statistics
from gsx.backbones.growth import clamp_scales, eligible, fresh_statistics, observe, prune, reset_offsets
from gsx.backbones.heads import Heads
from gsx.backbones.mip import filter_named
from gsx.backbones.neighbours import LEAST_SQUARE_DISTANCE, mean_square_distance
from gsx.backbones.scene_model import SceneModel
from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.core.rasterizer import Rendering, touches
from gsx.core.shapes import Int
from gsx.core.training.backbone import BackboneContext, Observation
from gsx.core.training.parameter_table import Networks, ParameterTable
from gsx.core.training.training_views import TrainingViews


def neural_anchors(options: NeuralOptions, context: BackboneContext) -> "Anchors":
    """Builds the backbones scaffold and octree_scaffold."""
    heads = Heads(options.heads, options.offsets, len(context.scene.train), context.generator).to(context.device)
    networks = Networks(heads, heads.colour)
    return Anchors(options, context, Neural(heads), networks=networks, network_rates=options.head_rates)


def explicit_anchors(options: ExplicitOptions, context: BackboneContext) -> "Anchors":
    """Builds the backbone octree_gs3d in its reported form: anchors of one Gaussian each."""
    logit = math.log(options.initial_opacity / (1 - options.initial_opacity))
    representation = Explicit(options.sh_degree, logit)
    return Anchors(options, context, representation, sh=(options.sh_degree, options.sh_every))


def view_number(numbers: Mapping[Camera, int], views: TrainingViews, camera: Camera, step: int) -> int:
    """Returns the number of the training view whose camera this is, in the scene or at the step; -1: none."""
    if camera in numbers:
        return numbers[camera]
    numbered = (pair for training in (views.full_size, views.at(step)) for pair in enumerate(training))
    return next((number for number, view in numbered if view.camera is camera), -1)


class Anchors(SceneModel):
    """N anchors at fixed positions with k Gaussians each."""

    absolute_gradient = False

    def __init__(
        self,
        options: NeuralOptions | ExplicitOptions,
        context: BackboneContext,
        representation: Representation,
        *,
        networks: Networks | None = None,
        network_rates: HeadRates | None = None,
        sh: tuple[int, int] = (0, 1),
    ) -> None:
        points = context.points()
        self.options, self.representation, (self.sh_degree, self.sh_every) = options, representation, sh
        self.network_rates, self.context, self.volume_weight = network_rates, context, options.volume_weight
        self.numbers = {view.camera: number for number, view in enumerate(context.scene.train)}
        self.schedule = context.schedule(options.published_iterations)
        self.events = event_steps(self.schedule, options.growth.start, options.growth.stop, options.growth.every)
        self.filter = filter_named(options.filter, options.mip, context, self.schedule, self.events.stop)
        self.raster = self.filter.rules(context.raster)
        self.capacity = capacity_of(options, context, self.events)
        self.grid = grid_of(options, context, self.schedule, points.positions.float())
        self.table = self.initial_table(points, networks)
        self.filter.refresh(self.table, self.table["anchors"])

    def initial_table(self, points: PointCloud, networks: Networks | None) -> ParameterTable:
        """Places anchors on the grid nodes nearest to the points (Scaffold-GS, create_from_pcd)."""
        positions, columns, owner, source = self.grid.start(points.positions.float())
        colours = pooled_max(points.colours[source].float() / 255, owner, len(positions))
        squares = mean_square_distance(positions).clamp_min(LEAST_SQUARE_DISTANCE)
        rows = self.representation.rows(0.5 * squares.log(), colours)
        statistics = fresh_statistics(len(positions), self.representation.offsets, self.context.device)
        return self.new_table(rows, columns | {"anchors": positions}, statistics, networks)

    # -- one step, in the order the trainer calls --------------------------------------------------------------

    def draw(self, camera: Camera, step: int) -> DrawnAnchors:
        """Decodes the anchors that the camera draws at its distance."""
        return self.representation.decode(self.table, self.visible(camera, step))

    def visible(self, camera: Camera, step: int) -> VisibleAnchors:
        """Returns the anchors in view on the levels that the camera draws (Scaffold-GS; Octree-GS)."""
        rows, weights = self.grid.visible(self.table, camera, step)
        reach = lengths(self.table["log_scales"].detach()[rows, :3])
        quats = self.representation.quats(self.table).detach()[rows]
        rows = rows[touches(self.table["anchors"][rows], reach, quats, camera, self.raster)]
        return VisibleAnchors(
            rows=rows,
            weights=weights[rows],
            camera=camera,
            view=view_number(self.numbers, self.context.views, camera, step),
            sh_degree=self.active_degree(step),
            backend=self.raster.backend.on(weights.device.type, learning=True),
        )

    def observe(self, drawn: DrawnAnchors, rendering: Rendering, step: int, weight: float = 1.0) -> Observation:
        """Returns visits, opacities and screen gradients while anchors grow (Scaffold-GS, training_statis)."""
        growth = self.options.growth
        if not self.schedule.step(growth.observe_from) < step < self.events.stop:
            return {}
        on_screen = densification_statistics(rendering.screen, drawn.slots, weight)
        return {
            "rows": drawn.anchors,
            "opacities": drawn.opacities,
            "slots": on_screen["rows"],
            "gradients": on_screen["gradient"].to(drawn.opacities),
            "visits": on_screen["weight"].to(drawn.opacities),
            "weight": drawn.opacities.new_full((1,), weight),
        }

    def accumulate(self, observation: Observation) -> None:
        """Adds an observation to the statistics."""
        if observation:
            observe(self.table, **observation)

    def densify_and_prune(self, step: int) -> Mapping[str, float]:
        """Grows and prunes when due (Scaffold-GS, train.py)."""
        due = self.events.due(step)
        if not due and not self.filter.narrows(step):
            return {}
        metrics = self.grow_and_prune(step) if due else {}
        self.filter.refresh(self.table, self.table["anchors"], step)
        return metrics

    def milestones(self) -> list[int]:
        """Returns the events of growth, and the step at which it ends."""
        return [*self.events.steps(), self.events.stop]

    def grow_and_prune(self, step: int) -> dict[str, float]:
        """Grows, resets eligible offsets, prunes and clamps in the order of the reference (Scaffold-GS)."""
        growth = self.options.growth
        visits = growth.success * self.schedule.interval(growth.every)
        metrics = self.capacity.evaluate(self, without_newborn, step)
        enough, old = eligible(self.table, visits / 2)[0], len(self.table)
        room = self.capacity.room(self.table, sys.maxsize, step)
        grown, over_cap = self.grid.grow(self.table, self.representation, visits / 2, room, step)
        mark_newborn(self.table, old)
        reset_offsets(self.table, enough)
        pruned = prune(self.table, growth, visits)
        extent = self.context.scene.extent
        unit = math.log(extent) if self.options.switches().clamp == "extent" and extent > 0 else 0.0
        clamp_scales(self.table, growth.largest_log_scale + unit)
        metrics |= {"grown": grown, "pruned": pruned}
        return metrics | ({"withheld": over_cap} if over_cap and not self.capacity.ranked else {})

    def set_rates(self, step: int) -> None:
        """Sets the learning rates of a step (Scaffold-GS, training_setup)."""
        steps = self.schedule.step(self.options.decay_until or self.options.published_iterations)
        for name in self.table.parameters:
            unit = self.context.scene.extent if name == "offsets" else 1.0
            self.table.set_rate(name, unit * getattr(self.options.rates, name).at(step, steps))
        if networks := self.table.networks:
            for name in networks.names():
                networks.set_rate(name, getattr(self.network_rates, name).at(step, steps))

    # -- files and logs ----------------------------------------------------------------------------------------

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        """Returns the Gaussians that a camera draws; without a camera those of all anchors, if explicit."""
        if camera is None and self.table.networks is not None:
            raise InputError(
                f"backbone {self.options.name} decodes its Gaussians for one camera at a time. Export those of a view: "
                "`gsx export RUN FILE.ply --view NAME`"
            )
        with torch.no_grad():
            drawn = self.everything() if camera is None else self.draw(camera, step)
        return self.representation.explicit(drawn, self.table)

    def slot_count(self) -> int:
        """Returns the number of offsets of all anchors."""
        return len(self.table) * self.representation.offsets

    def slots(self, drawn: DrawnAnchors) -> tuple[Int[Tensor, "M"], Int[Tensor, "V"]]:
        """Returns (slot of each Gaussian: anchor row times k plus offset; slots of all anchors in view)."""
        k, rows = self.representation.offsets, drawn.anchors
        return drawn.slots, (rows[:, None] * k + torch.arange(k, device=rows.device)).flatten()

    def everything(self) -> DrawnAnchors:
        """Decodes all anchors of all levels; for explicit ones, whose Gaussians do not depend on the camera."""
        anchors = self.table["anchors"]
        every = VisibleAnchors(
            rows=torch.arange(len(anchors), device=anchors.device),
            weights=torch.ones_like(anchors[:, 0]),
            camera=self.context.scene.train[0].camera,
            view=-1,
            sh_degree=self.sh_degree,
        )
        return self.representation.decode(self.table, every)

    def file_columns(self) -> dict[str, Tensor]:
        """Returns the raw columns of the published file and the filter's sizes, a row per anchor (save_ply)."""
        table = self.table
        columns = dict(zip("xyz", table["anchors"].unbind(1), strict=True)) | self.grid.columns(table)
        columns |= self.representation.columns(table, self.grid.header(table))
        return columns | ({"filter_3D": table["filter"]} if "filter" in table.columns else {})

    def file_notes(self) -> list[str]:
        """Returns comments on the 3D filter and the levels."""
        filtered = f"{self.filter.note} of Gaussians; anchors have its size in filter_3D"
        return [filtered if self.filter.note else "no 3D filter", *self.grid.notes()]

    def plan(self) -> dict[str, Any]:
        """Returns the schedule in steps of this run, the capacity and the grid."""
        grow = {"from": self.events.start, "until": self.events.stop, "every": self.events.every}
        return {"grow": grow} | self.capacity.plan() | self.grid.plan(self.table)
