"""Reading of the standard PLY of 3D-GS and its variants by other programs.

Colours may be display RGB (nerfstudio), opacity an alpha channel; a 3D filter column is fused (Mip-Splatting). Bands
beyond degree 3, and rows with NaN or inf, are dropped. Other content raises InputError, which calls the file "it".
"""

import logging
from collections.abc import Iterator, Mapping

import numpy as np
import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.gaussians.sh import constant_from_colour
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float
from gsx.formats.arrays import SMALLEST_OPACITY, finite_rows
from gsx.formats.ply import COLOUR_NAMES, colours_among, full_scale_of, header_in, vertices_of
from gsx.formats.smoothing import smoothed_raw

logger = logging.getLogger(__name__)

MOST_LOGIT = 30.0
"""Logit in place of infinity (opacities 0 and 1)."""
MOST_COEFFICIENTS = 15
"""Coefficients of degree 3, without the constant one."""
LEAST_SPLATS = 100
"""Least number of splats for which one of the two signs suffices."""
SMALL = 0.7
"""Bound of the `MOST` quantile of activated scales: as logarithms they would be splats of 1 to 2 units."""
MOST = 0.9
Columns = Mapping[str, np.ndarray]

BAKED = "whose Gaussians a network decodes for each camera: export Gaussians (gsx export RUN FILE --bake ZOOM does)"
FORMS = {
    ("level", "f_anchor_feat_0"): f"holds anchors of Octree-GS, {BAKED}",
    ("f_anchor_feat_0",): f"holds anchors of Scaffold-GS, {BAKED}",
    ("f_offset_0",): f"holds anchors of Scaffold-GS, {BAKED}",
    ("trbf_center",): "holds splats that move (SpacetimeGaussians): export one moment of them",
    ("motion_0",): "holds splats that move: export one moment of them",
    ("packed_position",): "holds packed splats without their chunks: export it anew as compressed PLY",
}
"""Descriptions of files without splats, by properties that identify them."""
ANCHORS = ("f_anchor_feat_0", "f_offset_0")
"""Properties of anchors, which no file of splats has."""


@np.errstate(over="ignore", invalid="ignore")  # `finite_rows` drops the rows
def decode_standard_ply(content: bytes, name: str) -> Gaussians:
    """Decodes a file's content, means in float64; InputError: it is damaged, or no splats. name: of the file."""
    columns = vertices_of(content)
    if problem := problem_of(columns, content):
        raise InputError(problem)
    raw = {
        "means": stacked(columns, "x", "y", "z"),
        "log_scales": stacked(columns, *(f"scale_{i}" for i in range(3))),
        "quats": stacked(columns, *(f"rot_{i}" for i in range(4))),
        "opacity_logits": opacity_logits(columns, name),
        "sh_dc": constant_band(columns),
        "sh_rest": higher_bands(columns),
    }
    if "filter_3D" in columns:
        drawn = smoothed_raw(raw["log_scales"], raw["opacity_logits"], float_column(columns, "filter_3D"))
        raw |= dict(zip(("log_scales", "opacity_logits"), drawn, strict=True))
    means = torch.from_numpy(np.stack([columns[axis].astype(float) for axis in "xyz"], 1))
    raw["means"] = torch.where(raw["means"].isfinite(), means, torch.nan)
    gaussians = Gaussians(**finite_rows(raw, name))
    for sentence in activated_words(gaussians):
        logger.warning("%s: %s", name, sentence)
    return gaussians


def problem_of(columns: Columns, content: bytes) -> str:
    """Returns why vertices are no splats of 3D-GS; empty: they are."""
    needed = ["x", "y", "z", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    missing = [f"'{name}'" for name in needed if name not in columns]
    if not {"opacity", "alpha"} & columns.keys():
        missing.append("'opacity'")
    if "f_dc_0" not in columns and colours_among(columns) is None:
        missing.append("'f_dc_0', or red, green and blue,")
    if any(name in columns for name in ANCHORS):
        return f"it {form_of(columns, content)}"
    return f"it lacks property {missing[0]} and {form_of(columns, content)}" if missing else ""


def form_of(columns: Columns, content: bytes) -> str:
    """Describes vertices that are no splats, with a remedy."""
    for names, form in FORMS.items():
        if set(names) <= columns.keys():
            return form
    if "scale_1" in columns and "scale_2" not in columns:
        return "holds flat splats (2DGS), which are not drawn: train 3D-GS, or export with a third scale"
    if any(name.startswith(("scale_", "rot_", "f_dc_", "f_rest_")) for name in columns):
        return "is no splat file of 3D-GS: export it anew as PLY"
    if any(element.name in ("face", "tristrips") and element.count for element in header_in(content).elements):
        return "is a mesh: give splats, or sample its points for scene.points"
    if {"x", "y", "z"} <= columns.keys():
        return "is a point cloud: give it as scene.points=FILE (transforms, blender), or give splats"
    return f"is no splat file of 3D-GS, but has {', '.join(list(columns)[:8])}: export it anew as PLY"


def float_column(columns: Columns, name: str) -> Float[Tensor, "N"]:
    """Returns a property as float32; large doubles become infinite."""
    return torch.from_numpy(columns[name].astype(np.float32))


def stacked(columns: Columns, *names: str) -> Float[Tensor, "N k"]:
    """Stacks properties as columns."""
    return torch.stack([float_column(columns, name) for name in names], 1)


def opacity_logits(columns: Columns, file: str) -> Float[Tensor, "N"]:
    """Returns logits of opacities, as stored or from an alpha channel of any unit."""
    if "opacity" in columns:
        return float_column(columns, "opacity").nan_to_num(torch.nan, MOST_LOGIT, -MOST_LOGIT)
    alpha = scaled_by(columns["alpha"], "alpha").clamp(SMALLEST_OPACITY, 1 - SMALLEST_OPACITY)
    logger.warning("%s: property opacity is missing, using alpha", file)
    return alpha.logit()


def constant_band(columns: Columns) -> Float[Tensor, "N 3"]:
    """Returns coefficients of the constant band, as stored or from display RGB."""
    if "f_dc_0" in columns:
        missing = [name for name in ("f_dc_1", "f_dc_2") if name not in columns]
        if missing:
            raise InputError(f"it lacks property '{missing[0]}': export it anew as PLY")
        return stacked(columns, "f_dc_0", "f_dc_1", "f_dc_2")
    colours = colours_among(columns)
    assert colours is not None  # `problem_of` checks it
    return constant_from_colour(scaled_by(colours, "/".join(COLOUR_NAMES[0])))


def scaled_by(values: np.ndarray, name: str) -> Float[Tensor, "..."]:
    """Scales intensities of any unit to [0, 1]."""
    full = full_scale_of(values)
    if full is None:
        ends = f"{np.nanmin(values):g} to {np.nanmax(values):g}"
        raise InputError(f"its {name} from {ends} are of no known unit: export bytes, or floats in [0, 1]")
    return torch.from_numpy(values.astype(np.float32)) / full


def higher_bands(columns: Columns) -> Float[Tensor, "N B 3"]:
    """Returns coefficients of the other bands up to degree 3; f_rest is channel-major."""
    count = sum(name.startswith("f_rest_") for name in columns)
    if count not in (3 * ((degree + 1) ** 2 - 1) for degree in range(5)):
        raise InputError(f"it has {count} f_rest properties, degrees 0 to 4 have 0, 9, 24, 45 or 72: export it anew")
    rows, names = len(columns["x"]), [f"f_rest_{i}" for i in range(count)]
    if not set(names) <= columns.keys():
        raise InputError(f"it does not number its f_rest properties from 0 to {count - 1}: export it anew")
    values = stacked(columns, *names) if names else torch.zeros(rows, 0)
    return values.view(rows, 3, count // 3).transpose(1, 2)[:, :MOST_COEFFICIENTS]


def activated_words(gaussians: Gaussians) -> Iterator[str]:
    """Yields a sentence if raw values look activated: all scales positive and all opacities in [0, 1].

    Either may be a coincidence in small files and large scenes; for many splats one clear sign suffices.
    """
    count = len(gaussians.means)
    scales, opacities = gaussians.log_scales.flatten(), gaussians.opacity_logits
    positive = count > 0 and bool((scales > 0).all())
    shares = count > 0 and bool(((opacities >= 0) & (opacities <= 1)).all())
    alone = count >= LEAST_SPLATS
    small = positive and float(scales.kthvalue(max(1, int(MOST * scales.numel()))).values) < SMALL
    several = shares and bool((opacities != opacities[0]).any())
    signs = []
    if positive and (shares or (alone and small)):
        signs.append(f"all scales are above 0 (median {float(scales.median()):.3g}), where logarithms are stored")
    if shares and (positive or (alone and several)):
        signs.append("all opacities are within [0, 1], where logits are stored")
    if signs:
        yield (
            f"these look like activated values: {', and '.join(signs)}. They are read as logarithms and logits: "
            "export ln(scale) and ln(opacity / (1 - opacity))"
        )
