"""Figures of a zoom: of the zoomed render and of its competitors, view by view and as means."""

import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

from torch import Tensor

from gsx.core.quality.metrics import psnr
from gsx.core.shapes import Bool, Float
from gsx.experiments.evaluation.detail import Details, details_of, explained
from gsx.experiments.evaluation.perceptual import Figures, zoom_means
from gsx.experiments.evaluation.zoomed import Zoomed
from gsx.experiments.run_folder.files import DETAIL_OF

Ssim: TypeAlias = Callable[[Float[Tensor, "3 H W"], Float[Tensor, "3 H W"], Bool[Tensor, "H W"] | None], float]
"""SSIM by the protocol: of a picture, the truth, and the pixels that count."""


class ZoomFigures(NamedTuple):
    """Figures of one view at one zoom."""

    group: str
    figures: dict[str, float]
    details: Details
    """Empty: not measured."""
    perceptual: Figures
    """Perceptual figures by metric and picture."""


def measure_zoom(zoomed: Zoomed, ssim: Ssim, perceptual: Figures) -> ZoomFigures:
    """Measures one view at a zoom, and its competitors, and adds its perceptual figures.

    There is no detail with a mask, whose border would be detail.
    """
    pictures = zoomed.pictures(DETAIL_OF)
    whole = zoomed.counted is None and zoomed.view.counted() is None
    details = details_of(pictures, zoomed.truth, zoomed.factor) if whole else {}
    truth, counted = zoomed.truth, zoomed.counted
    figures = {}
    for name, picture in zoomed.pictures(("render", "enlarged", "upscaled")).items():
        prefix = "" if name == "render" else f"{name}_"
        figures[f"{prefix}psnr"] = psnr(picture, truth, counted)
        figures[f"{prefix}ssim"] = ssim(picture, truth, counted)
    if zoomed.photograph is not None:
        figures["photograph_psnr"] = psnr(zoomed.photograph, truth, counted)
    return ZoomFigures(zoomed.view.group, figures, details, perceptual)


def zoom_result(factor: float, views: Sequence[ZoomFigures]) -> dict[str, Any]:
    """Returns mean figures at one zoom over all views, and over those of each group if there are groups."""
    groups = sorted({view.group for view in views if view.group})
    of_groups = {name: zoom_entry(factor, [view for view in views if view.group == name]) for name in groups}
    return zoom_entry(factor, views) | ({"groups": of_groups} if groups else {})


def zoom_entry(factor: float, views: Sequence[ZoomFigures]) -> dict[str, Any]:
    """Returns mean figures of views at one zoom, or the reason why there are none.

    Figures that some of the views lack are left out. `beats_RIVAL`: whether the zoomed render has the higher PSNR; None
    at x1, where nothing differs.
    """
    if not views:
        return {"unavailable": f"the images hold no truth at x{factor:g}: train on a larger scene.downscale"}
    keys = [key for key in views[0].figures if all(key in view.figures for view in views)]
    means = {key: statistics.fmean(view.figures[key] for view in views) for key in keys}
    known = [view.details for view in views if view.details]
    shared = [name for name in known[0] if all(name in detail for detail in known)] if known else []
    found = {name: explained([detail[name] for detail in known]) for name in shared}
    perceptual = zoom_means([view.perceptual for view in views])
    rivals = [name for name in ("enlarged", "upscaled") if f"{name}_psnr" in means]
    beaten = {f"beats_{name}": None if factor == 1 else means["psnr"] > means[f"{name}_psnr"] for name in rivals}
    return means | {"views": len(views)} | beaten | ({"detail": found} if found else {}) | perceptual
