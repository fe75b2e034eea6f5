"""Gaussians on anchors of a fixed grid (Scaffold-GS), at several levels of detail if asked for (Octree-GS).

A backbone here is a representation (networks or explicit harmonics), with or without levels, with or without the Mip
filters: each is a part that knows nothing of the others (docs/backbones.md).
"""

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.backbones.anchor_options import ExplicitOptions, HeadRates, NeuralOptions
from gsx.backbones.cells import pooled_max
from gsx.backbones.decoding import Decoded, Explicit, Neural, Representation, VisibleAnchors, lengths
from gsx.backbones.growth import (
    clamp_scales,
    eligible,
    fresh_statistics,
    grow_by_depth,
    grow_by_level,
    observe,
    prune,
    reset_offsets,
)
from gsx.backbones.heads import Heads, optimiser_of
from gsx.backbones.level_options import faithful
from gsx.backbones.levels import Levels, all_levels_from, derive, drawn, facts_of, initial_nodes, note_of, warnings_of
from gsx.backbones.mip import filter_sizes, filtered_rules
from gsx.backbones.voxels import automatic_voxel, voxel_nodes
from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud
from gsx.core.errors import InputError
from gsx.core.gaussians.neighbours import LEAST_SQUARE_DISTANCE, mean_square_distance
from gsx.core.gaussians.quaternions import make_identity_where_zero
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.quality.losses import volume_loss
from gsx.core.rasterizer import Rendering, drawable, touches
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import BackboneContext, Observation
from gsx.core.training.density import (
    ParameterTable,
    adam_tensors,
    densification_statistics,
    finite_rows,
    keep_rows,
    restore_adam,
    restored_table,
    table_tensors,
)

logger = logging.getLogger(__name__)


def neural_anchors(options: NeuralOptions, context: BackboneContext) -> "Anchors":
    """The backbones scaffold and octree_scaffold."""
    heads = Heads(options.heads, options.offsets, len(context.scene.train), context.generator)
    return Anchors(options, context, Neural(heads.to(context.device)), heads, options.head_rates)


def explicit_anchors(options: ExplicitOptions, context: BackboneContext) -> "Anchors":
    """The backbone octree_gs3d as reported: anchors of one Gaussian."""
    logit = math.log(options.initial_opacity / (1 - options.initial_opacity))
    representation = Explicit(options.sh_degree, logit)
    return Anchors(options, context, representation, None, None, (options.sh_degree, options.sh_every))


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnAnchors:
    """Gaussians of a camera, and the anchors that they come from."""

    decoded: Decoded
    anchors: VisibleAnchors

    @property
    def splats(self) -> Splats:
        """The Gaussians."""
        return self.decoded.splats


class Anchors:
    """N anchors at fixed places, k Gaussians each."""

    absolute_gradient = False
    standard_file = False

    def __init__(
        self,
        options: NeuralOptions | ExplicitOptions,
        context: BackboneContext,
        representation: Representation,
        heads: Heads | None,
        head_rates: HeadRates | None,
        sh: tuple[int, int] = (0, 1),
    ) -> None:
        scene = context.scene
        self.options, self.representation, self.sh = options, representation, sh
        self.heads, self.head_rates = heads, head_rates
        self.quirks = options.switches()
        self.extent, self.generator, self.device = scene.extent, context.generator, context.device
        self.raster = filtered_rules(context.raster, options.filter, options.mip)
        self.cameras = [view.camera for view in scene.train]
        self.views = {camera: number for number, camera in enumerate(self.cameras)}
        self.schedule = context.schedule(options.published_iterations)
        self.levels: Levels | None = None
        self.voxel = options.voxel
        self.table = self.initial_table(context.points())
        self.head_optimiser = None if heads is None else optimiser_of(heads)
        self.refresh_filter()

    # -- the beginning -----------------------------------------------------------------------------------------

    def initial_table(self, points: PointCloud) -> ParameterTable:
        """Anchors on the grid nodes next to the points (Scaffold-GS, voxelize_sample; Octree-GS, octree_sample)."""
        positions, columns, owner, source = self.initial_anchors(points.positions.float())
        colours = pooled_max(points.colours[source].float() / 255, owner, len(positions))
        squares = mean_square_distance(positions).clamp_min(LEAST_SQUARE_DISTANCE)
        rows = self.representation.rows(0.5 * squares.log(), colours)
        columns |= fresh_statistics(len(positions), self.representation.offsets, self.device) | {"anchors": positions}
        return ParameterTable(
            {name: Parameter(value.to(self.device)) for name, value in rows.items()},
            {name: value.to(self.device) for name, value in columns.items()},
        )

    def initial_anchors(
        self, points: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "N 3"], dict[str, Tensor], Int[Tensor, "Q"], Int[Tensor, "Q"]]:
        """(positions, columns of levels, anchor and point of each point-anchor pair)."""
        options = faithful(self.options.levels, self.options.fidelity)
        if options is None:
            self.voxel = self.options.voxel or automatic_voxel(points, self.quirks.voxel == "squared")
            positions, owner = voxel_nodes(points, self.voxel)
            return positions, {}, owner, torch.arange(len(points))
        self.levels = derive(points, self.cameras, options, all_levels_from(options, self.schedule))
        positions, of, group = initial_nodes(points, self.levels)
        for warning in warnings_of(self.levels, len(of)):
            logger.warning("%s", warning)
        source = torch.arange(len(points)).repeat(self.levels.count)
        return positions, {"level": of, "bias": torch.zeros(len(of))}, group.flatten(), source

    # -- one step, in the order the trainer calls --------------------------------------------------------------

    def set_rates(self, step: int) -> None:
        """Learning rates of a step (Scaffold-GS, training_setup)."""
        steps = self.schedule.step(self.options.decay_until or self.options.published_iterations)
        for name in self.table.parameters:
            unit = self.extent if name == "offsets" else 1.0
            self.table.set_rate(name, unit * getattr(self.options.rates, name).at(step, steps))
        for group in self.head_optimiser.param_groups if self.head_optimiser else ():
            group["lr"] = getattr(self.head_rates, group["name"]).at(step, steps)

    def draw(self, camera: Camera, step: int) -> DrawnAnchors:
        """The Gaussians of the anchors that the camera sees at its distance."""
        anchors = self.visible(camera, step)
        decoded = self.representation.decode(self.table, anchors, self.filters_of(anchors.rows))
        return DrawnAnchors(decoded=decoded, anchors=anchors)

    def visible(self, camera: Camera, step: int) -> VisibleAnchors:
        """Anchors of the levels that the camera draws, of which those in view (Octree-GS; Scaffold-GS)."""
        anchors = self.table["anchors"]
        weights = torch.ones_like(anchors[:, 0])
        rows = torch.arange(len(anchors), device=anchors.device)
        if self.levels is not None:
            mask, weights = drawn(
                self.levels, anchors, self.table["level"], self.table["bias"], camera, self.levels.highest(step)
            )
            rows = rows[mask]
        reach = lengths(self.table["log_scales"].detach()[rows, :3])
        seen = touches(anchors[rows], reach, self.representation.quats(self.table).detach()[rows], camera, self.raster)
        rows = rows[seen]
        degree, every = self.sh
        degree = min(degree, step // max(1, self.schedule.step(every)))
        return VisibleAnchors(
            rows=rows, weights=weights[rows], camera=camera, view=self.views.get(camera, -1), sh_degree=degree
        )

    def regulariser(self, drawn: DrawnAnchors) -> Float[Tensor, ""] | None:
        """Mean volume of the Gaussians drawn; 0 for none (Scaffold-GS, train.py)."""
        if not self.options.volume_weight:
            return None
        return volume_loss(drawn.splats.scales, self.options.volume_weight)

    def observe(self, drawn: DrawnAnchors, rendering: Rendering, step: int, weight: float = 1.0) -> Observation:
        """Visits, opacities and screen gradients while anchors are judged (Scaffold-GS, training_statis)."""
        growth = self.options.growth
        if not self.schedule.step(growth.observe_from) < step < self.schedule.step(growth.stop):
            return {}
        decoded = drawn.decoded
        seen = densification_statistics(rendering.screen, decoded.slots, weight)
        return {
            "rows": drawn.anchors.rows,
            "opacities": decoded.opacities,
            "slots": seen["rows"],
            "gradients": seen["gradient"].to(decoded.opacities),
            "weight": seen["weight"].to(decoded.opacities),
        }

    def accumulate(self, seen: Observation) -> None:
        """Add an observation to the columns of the table."""
        if seen:
            observe(self.table, **seen)

    def densify_and_prune(self, step: int) -> dict[str, int]:
        """Grow and prune when due (Scaffold-GS, train.py)."""
        if self.growth_due(step):
            done = self.adapt_now(step)
            self.refresh_filter()
            return done
        return {}

    def update(self, step: int) -> None:
        """One Adam step of anchors and heads. Unused SH bands take part with zero gradients, as in 3D-GS."""
        moved = self.table.parameters.values()
        if any(parameter.grad is not None for parameter in moved):
            for parameter in moved:
                parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        self.set_rates(step)
        self.table.optimiser.step()
        if "quats" in self.table.parameters:
            make_identity_where_zero(self.table["quats"])
        if self.head_optimiser is not None:
            self.head_optimiser.step()
        self.zero_grad()

    def parameters(self) -> Iterable[tuple[str, Parameter]]:
        """Parameters by name, those of anchors before those of the heads."""
        return [*self.table.parameters.items(), *self.head_parameters()]

    def gradients(self) -> Iterable[tuple[str, Tensor]]:
        """Gradients by parameter name."""
        return ((name, p.grad) for name, p in self.parameters() if p.grad is not None)

    def head_parameters(self) -> list[tuple[str, Parameter]]:
        """Names and values of the heads' parameters."""
        return [] if self.heads is None else [(f"heads.{name}", p) for name, p in self.heads.named_parameters()]

    def shared(self) -> Iterable[Tensor]:
        """The colour network, if there is one."""
        return () if self.heads is None else self.heads.colour.parameters()

    @torch.no_grad()
    def remove_nonfinite(self, cameras: Sequence[Camera], step: int) -> int:
        """Remove anchors with a value that is not finite, or with a Gaussian that a camera cannot draw."""
        kept = finite_rows(self.table)
        for camera in cameras:
            kept &= self.usable_for(camera, step)
        if bool(kept.all()) or not bool(kept.any()):
            return 0
        keep_rows(self.table, kept)
        return int((~kept).sum())

    def usable_for(self, camera: Camera, step: int) -> Bool[Tensor, "N"]:
        """Anchors that the camera draws or has no business with: False for Gaussians or volumes out of range.

        Where none of those in view can be drawn the networks are to blame, and no anchor.
        """
        decoded = self.draw(camera, step).decoded
        everyone = torch.ones(len(self.table), dtype=torch.bool, device=self.device)
        splats = decoded.splats
        lost = ~(drawable(splats, camera, self.raster) & torch.isfinite(splats.scales.prod(1)))
        owners = decoded.slots // self.representation.offsets
        usable = everyone.index_fill(0, owners[lost], False)
        return usable if bool(usable[owners].any()) else everyone

    def zero_grad(self) -> None:
        """Forget the gradients."""
        self.table.optimiser.zero_grad(set_to_none=True)
        if self.head_optimiser is not None:
            self.head_optimiser.zero_grad(set_to_none=True)

    # -- growing and pruning -----------------------------------------------------------------------------------

    def growth_due(self, step: int) -> bool:
        """After `start`, before `stop`, every interval."""
        growth = self.options.growth
        start, stop = self.schedule.step(growth.start), self.schedule.step(growth.stop)
        return start < step < stop and step % self.schedule.interval(growth.every) == 0

    def adapt_now(self, step: int) -> dict[str, int]:
        """Grow, forget what was judged, prune, clamp: the order of the reference (Scaffold-GS)."""
        growth = self.options.growth
        visits = growth.success * self.schedule.interval(growth.every)
        enough, _ = eligible(self.table, visits / 2)
        grown, without_room = self.grow(visits / 2, step)
        reset_offsets(self.table, enough)
        pruned = prune(self.table, growth, visits)
        unit = math.log(self.extent) if self.quirks.clamp == "extent" and self.extent > 0 else 0.0
        clamp_scales(self.table, growth.largest_log_scale + unit)
        return {"grown": grown, "pruned": pruned} | ({"withheld": without_room} if without_room else {})

    def grow(self, least: float, step: int) -> tuple[int, int]:
        """By depth without levels, by level with them; (anchors that grew, anchors that found no room)."""
        shared, most = (self.table, self.representation, self.options.growth), self.options.max_primitives
        if self.levels is None:
            stop = self.quirks.early_stop == "yes"
            return grow_by_depth(*shared, self.voxel, least, stop, self.generator, most)
        gate = self.quirks.gate == "open" or self.levels.highest(step) == self.levels.count - 1
        return grow_by_level(*shared, self.levels, least, self.quirks, gate, most)

    def refresh_filter(self) -> None:
        """Filter sizes of the anchors, which their Gaussians share; anchors stay where they are (Mip-Splatting)."""
        if self.options.filter == "mip":
            self.table.columns["filter"] = filter_sizes(self.table["anchors"], self.cameras, self.options.mip)

    # -- what others need --------------------------------------------------------------------------------------

    def size(self) -> tuple[int, int]:
        """(anchors, bytes of parameters, positions, levels and heads)."""
        stored = [*self.table.parameters.values(), self.table["anchors"], *(p for _, p in self.head_parameters())]
        stored += [self.table[name] for name in ("level", "bias", "filter") if name in self.table.columns]
        return len(self.table), sum(value.numel() * value.element_size() for value in stored)

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        """The Gaussians drawn for a camera; without one those of all anchors, of explicit representations only."""
        if camera is None and self.heads is not None:
            raise InputError(
                f"backbone {self.options.name} decodes its Gaussians for one camera at a time, so there are none that "
                "hold for all: export those of a view, `gsx export RUN FILE.ply --view NAME`"
            )
        with torch.no_grad():
            decoded = self.everything() if camera is None else self.draw(camera, step).decoded
        return self.representation.explicit(decoded, self.table)

    def everything(self) -> Decoded:
        """All anchors of all levels, as seen from anywhere."""
        rows = torch.arange(len(self.table), device=self.device)
        anchors = VisibleAnchors(
            rows=rows,
            weights=torch.ones_like(self.table["anchors"][:, 0]),
            camera=self.cameras[0],
            view=-1,
            sh_degree=self.sh[0],
        )
        return self.representation.decode(self.table, anchors, self.filters_of(rows))

    def filters_of(self, rows: Int[Tensor, "A"]) -> Float[Tensor, "A"] | None:
        """Sizes of the 3D filter, None without one."""
        return self.table["filter"][rows] if self.options.filter == "mip" else None

    def file(self) -> dict[str, Tensor]:
        """Columns of the published files of each form (Octree-GS, save_ply): one row per anchor, raw values.

        With a 3D filter its sizes follow, under the name that they have in files of Mip-Splatting.
        """
        columns = dict(zip("xyz", self.table["anchors"].unbind(1), strict=True))
        if self.levels is not None:
            columns |= {"level": self.table["level"].float(), "extra_level": self.table["bias"]}
        columns |= self.representation.columns(self.table, self.levels)
        return columns | ({"filter_3D": self.table["filter"]} if "filter" in self.table.columns else {})

    def export_notes(self) -> list[str]:
        """Where the 3D filter is, and what chooses the levels at a distance (Octree-GS, save_ply)."""
        notes = ["no 3D filter"]
        if self.options.filter == "mip":
            notes = ["3D filter fused into scales and opacities of Gaussians; anchors have its size in filter_3D"]
        if self.levels is not None:
            notes.append(note_of(self.levels))
        return notes

    def plan(self) -> dict[str, Any]:
        """The schedule in steps of this run, and what was derived from the scene."""
        growth, steps = self.options.growth, self.schedule
        plan: dict[str, Any] = {
            "grow": {
                "from": steps.step(growth.start),
                "until": steps.step(growth.stop),
                "every": steps.interval(growth.every),
            },
            "anchors": {"count": len(self.table)} | ({"voxel": self.voxel} if self.levels is None else {}),
        }
        if self.levels is not None:
            plan["levels"] = facts_of(self.levels, self.table["level"])
        return plan

    def tensors(self) -> dict[str, Tensor]:
        """Parameters, columns, heads, and all Adam states."""
        out = table_tensors(self.table)
        for name, parameter in self.head_parameters():
            assert self.head_optimiser is not None
            out[name] = parameter.detach()
            out |= adam_tensors(name, parameter, self.head_optimiser)
        return out

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave."""
        self.table = restored_table(self.table, tensors, self.device)
        for name, parameter in self.head_parameters():
            assert self.head_optimiser is not None
            with torch.no_grad():
                parameter.copy_(tensors[name])
            restore_adam(name, parameter, self.head_optimiser, tensors, self.device)
