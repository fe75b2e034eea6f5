"""Two representations of an anchor's Gaussians: networks (Scaffold-GS) and explicit harmonics (Octree-AnyGS)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, normalize

from gsx.backbones.heads import Heads
from gsx.backbones.mip import filtered
from gsx.core.backend import EAGER, Backend
from gsx.core.data.camera import Camera, offsets_from
from gsx.core.gaussians.sh import colours_of, constant_from_colour
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.rasterizer import repeat_rows, take_rows
from gsx.core.shapes import Float, Int
from gsx.core.training.parameter_table import ParameterTable
from gsx.formats.smoothing import logit_of_log

LARGEST_LOG_SCALE = 30.0
"""Bound of log-lengths: squares of e^30 world units stay finite in float32."""
LEAST = 1e-37
"""Lower bound of lengths (world units) and weights whose logarithm is taken."""
INERT_LOGIT = math.log(0.1 / 0.9)
"""Unused opacity of an anchor in published files (Scaffold-GS, create_from_pcd)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VisibleAnchors:
    """Anchors that a camera draws."""

    rows: Int[Tensor, "A"]
    weights: Float[Tensor, "A"]
    """Factors of their opacities: below 1 while a level fades in."""
    camera: Camera
    view: int
    """Number of the training view, -1 for any other camera."""
    sh_degree: int
    backend: Backend = EAGER
    """Backend of the colour computation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnAnchors:
    """Gaussians of a camera and their anchors."""

    splats: Splats
    anchors: Int[Tensor, "A"]
    """Rows of the anchors in view."""
    slots: Int[Tensor, "M"]
    """Anchor row times k plus the number of the offset."""
    opacities: Float[Tensor, "A k"]
    """Opacities of all offsets of these anchors, without gradient; 0 for those not drawn."""

    @property
    def rows(self) -> Int[Tensor, "M"]:
        """Return the anchor row of each Gaussian."""
        return self.slots // self.opacities.shape[1]


def lengths(log_scales: Float[Tensor, "A V"]) -> Float[Tensor, "A V"]:
    """Returns lengths whose squares are finite."""
    return log_scales.clamp(max=LARGEST_LOG_SCALE).exp()


def identity_quats(values: Float[Tensor, "N *rest"]) -> Float[Tensor, "N 4"]:
    """Returns (1, 0, 0, 0) for every row of `values`."""
    return torch.eye(1, 4, dtype=values.dtype, device=values.device).expand(len(values), 4)


def numbered(prefix: str, values: Float[Tensor, "N V"]) -> dict[str, Float[Tensor, "N"]]:
    """Returns numbered columns of a file."""
    return {f"{prefix}{i}": column.detach() for i, column in enumerate(values.unbind(1))}


def baked(splats: Splats, constant: Float[Tensor, "M 3"], rest: Float[Tensor, "M B 3"]) -> Gaussians:
    """Returns Gaussians of a standard file that render as these splats."""
    return Gaussians(
        means=splats.means.detach(),
        log_scales=splats.scales.detach().clamp_min(LEAST).log(),
        quats=normalize(splats.quats.detach(), dim=1),
        opacity_logits=logit_of_log(splats.log_opacities.detach()),
        sh_dc=constant.detach(),
        sh_rest=rest,
    )


class Neural:
    """Features that networks decode into k Gaussians; those with positive opacity are drawn (Scaffold-GS)."""

    pooled: tuple[str, ...] = ("features",)
    """Parameters that a new anchor inherits: the largest values of its parents."""

    def __init__(self, heads: Heads) -> None:
        self.heads, self.offsets = heads, heads.offsets

    def rows(self, log_lengths: Float[Tensor, "N"], colours: Float[Tensor, "N 3"]) -> dict[str, Tensor]:
        """Returns parameters of new anchors: equal log-lengths, features and offsets 0."""
        count = len(log_lengths)
        return {
            "offsets": log_lengths.new_zeros(count, self.offsets, 3),
            "features": log_lengths.new_zeros(count, self.heads.options.features),
            "log_scales": log_lengths[:, None].repeat(1, 6),
        }

    def decode(self, table: ParameterTable, visible: VisibleAnchors) -> DrawnAnchors:
        """Decodes anchors: mu = x + O l[0:3], s = l[3:6] sigmoid, opacity tanh > 0 (Scaffold-GS)."""
        rows, k = visible.rows, self.offsets
        anchors = table["anchors"][rows]
        raw, shapes, colours = self.heads(
            take_rows(table["features"], rows),
            offsets_from(anchors, visible.camera.centre),
            table["level"][rows, None].to(anchors) if "level" in table.columns else torch.zeros_like(anchors[:, :1]),
            visible.view,
        )
        opacities = raw * visible.weights[:, None]
        # NaN stays: the render counts it
        chosen = (~(opacities.detach() <= 0)).view(-1).nonzero()[:, 0]
        owner = chosen // k
        size = repeat_rows(lengths(take_rows(table["log_scales"], rows)), owner)
        shape = take_rows(shapes.reshape(-1, 7), chosen)
        scales, log_opacities = size[:, 3:] * shape[:, :3].sigmoid(), take_rows(opacities.view(-1), chosen).log()
        scales, log_opacities = filtered(table, rows[owner], scales, log_opacities)
        splats = Splats(
            means=anchors[owner] + take_rows(take_rows(table["offsets"], rows).view(-1, 3), chosen) * size[:, :3],
            scales=scales,
            quats=shape[:, 3:],
            log_opacities=log_opacities,
            colours=take_rows(colours.reshape(-1, 3), chosen),
        )
        slots = rows[owner] * k + chosen % k
        return DrawnAnchors(splats=splats, anchors=rows, slots=slots, opacities=opacities.detach().clamp_min(0))

    def quats(self, table: ParameterTable) -> Float[Tensor, "N 4"]:
        """Returns identities: the reference never optimises an anchor's rotation (Scaffold-GS)."""
        return identity_quats(table["anchors"])

    def explicit(self, drawn: DrawnAnchors, table: ParameterTable) -> Gaussians:
        """Returns Gaussians of a splat file with this camera's colours in the constant band."""
        colours = constant_from_colour(drawn.splats.colours)
        return baked(drawn.splats, colours, colours.new_zeros(len(colours), 0, 3))

    def columns(self, table: ParameterTable, header: dict[str, Float[Tensor, "N"]]) -> dict[str, Float[Tensor, "N"]]:
        """Returns the file columns after the positions; unused ones keep initial values (Scaffold-GS, save_ply)."""
        inert = torch.full_like(table["anchors"][:, 0], INERT_LOGIT)
        return (
            header
            | numbered("f_offset_", table["offsets"].transpose(1, 2).flatten(1))
            | numbered("f_anchor_feat_", table["features"])
            | {"opacity": inert}
            | numbered("scale_", table["log_scales"])
            | numbered("rot_", self.quats(table))
        )


class Explicit:
    """One Gaussian with spherical harmonics per anchor, always drawn (Octree-AnyGS)."""

    offsets = 1
    pooled: tuple[str, ...] = ("sh_dc", "sh_rest")

    def __init__(self, sh_degree: int, initial_logit: float) -> None:
        self.sh_degree, self.initial_logit = sh_degree, initial_logit

    def rows(self, log_lengths: Float[Tensor, "N"], colours: Float[Tensor, "N 3"]) -> dict[str, Tensor]:
        """Returns parameters of new anchors: colours in [0, 1] in the constant band, offset 0."""
        count = len(log_lengths)
        return {
            "offsets": log_lengths.new_zeros(count, 1, 3),
            "log_scales": log_lengths[:, None].repeat(1, 6),
            "quats": identity_quats(log_lengths).clone(),
            "opacity_logits": torch.full_like(log_lengths, self.initial_logit),
            "sh_dc": constant_from_colour(colours.to(log_lengths))[:, None],
            "sh_rest": log_lengths.new_zeros(count, (self.sh_degree + 1) ** 2 - 1, 3),
        }

    def decode(self, table: ParameterTable, visible: VisibleAnchors) -> DrawnAnchors:
        """Decodes anchors: mu = x + O l[0:3], s = l[3:6], opacity sigmoid times the level's weight."""
        rows = visible.rows
        row = {name: take_rows(table[name], rows) for name in table.parameters}
        size = lengths(row["log_scales"])
        means = table["anchors"][rows] + row["offsets"][:, 0] * size[:, :3]
        weights = visible.weights.clamp_min(LEAST)
        scales, log_opacities = size[:, 3:], logsigmoid(row["opacity_logits"]) + weights.log()
        opacities = log_opacities.detach().exp()[:, None]
        scales, log_opacities = filtered(table, rows, scales, log_opacities)
        offsets = offsets_from(means, visible.camera.centre)
        splats = Splats(
            means=means,
            scales=scales,
            quats=row["quats"],
            log_opacities=log_opacities,
            colours=colours_of(row["sh_dc"], row["sh_rest"], offsets, visible.sh_degree, visible.backend),
        )
        return DrawnAnchors(splats=splats, anchors=rows, slots=rows, opacities=opacities)

    def quats(self, table: ParameterTable) -> Float[Tensor, "N 4"]:
        """Returns the rotations of the Gaussians."""
        return table["quats"]

    def explicit(self, drawn: DrawnAnchors, table: ParameterTable) -> Gaussians:
        """Returns Gaussians of a splat file with all bands."""
        rows = drawn.slots
        return baked(drawn.splats, table["sh_dc"].detach()[rows, 0], table["sh_rest"].detach()[rows])

    def columns(self, table: ParameterTable, header: dict[str, Float[Tensor, "N"]]) -> dict[str, Float[Tensor, "N"]]:
        """Returns the file columns after positions and levels; f_rest is channel-major."""
        return (
            numbered("f_offset_", table["offsets"].flatten(1))
            | numbered("f_dc_", table["sh_dc"][:, 0])
            | numbered("f_rest_", table["sh_rest"].transpose(1, 2).flatten(1))
            | {"opacity": table["opacity_logits"]}
            | numbered("scale_", table["log_scales"])
            | numbered("rot_", table["quats"])
        )


Representation = Neural | Explicit
"""Parameters of an anchor and their decoding."""
