"""Pairs of a photo and its render, from which corrections are estimated."""

import math
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.rasterizer import TiledRendering
from gsx.core.shapes import Bool, Float
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.modules.derived_views import reduce_view

Image: TypeAlias = Float[Tensor, "3 H W"]
Mask: TypeAlias = Bool[Tensor, "H W"]
"""Pixels that count."""
Pair: TypeAlias = tuple[Image, Image, Mask | None]
"""Render, photo, mask (None: all pixels count)."""
REDUCTION = 2
"""Reduction of the views of estimates, which then take a third of the time."""
DARK, LIGHT = 0.05, 0.95
"""Range of display values for gains: below is noise, above values may be saturated."""
MIN_PIXELS, MIN_VIEWS = 64, 3
"""Fewest pixels for a gain, fewest views for a spread."""


def render_reduced(run: Run, view: View, depth: bool = True, min_pixels: int = 0) -> tuple[View, TiledRendering]:
    """Returns (the view reduced by REDUCTION, its render); not reduced where fewer than `min_pixels` would be left."""
    run.raise_if_stopping()
    pixels = view.camera.width * view.camera.height / REDUCTION**2
    small = reduce_view(view, run.scene.reduction, REDUCTION) if pixels >= min_pixels else view
    return small, render(run, small.camera, supersample=1, depth=depth)


def usable_pixels(image: Image, photo: Image, mask: Mask | None) -> Mask:
    """Returns the pixels that count and are neither dark nor light, in render and photo."""
    usable = ((image > DARK) & (image < LIGHT) & (photo > DARK) & (photo < LIGHT)).all(0)
    return usable if mask is None else usable & mask.to(usable.device)


def log_gains(image: Image, photo: Image, mask: Mask | None = None) -> Float[Tensor, "3"]:
    """Returns the median of log(photo / image) of each channel, over usable pixels; nan where they are too few."""
    usable = usable_pixels(image, photo, mask)
    if int(usable.sum()) < MIN_PIXELS:
        return torch.full((3,), torch.nan)
    return (photo[:, usable] / image[:, usable]).log().double().median(dim=1).values.float().cpu()


def gains(image: Image, photo: Image, mask: Mask | None) -> Float[Tensor, "3"]:
    """Returns the brightness of a photo relative to its render, by channel; 1 where pixels are too few."""
    return log_gains(image, photo, mask).nan_to_num(0.0).exp()


def match_brightness(image: Image, photo: Image, mask: Mask | None) -> Image:
    """Returns a render scaled to the brightness of its photo, by channel, and clamped."""
    return (gains(image, photo, mask)[:, None, None] * image).clamp(0, 1)


def shared_spread(left: Float[Tensor, "N C"], right: Float[Tensor, "N C"]) -> float:
    """Returns the standard deviation over photos that both halves of a photo share, in the mean over channels.

    The root of the covariance of the halves, free of their noise; 0 where that is negative, or fewer than MIN_VIEWS
    photos have both halves.
    """
    known = (left.isfinite() & right.isfinite()).all(1)
    if int(known.sum()) < MIN_VIEWS:
        return 0.0
    centred = [half[known] - half[known].mean(0) for half in (left, right)]
    covariance = (centred[0] * centred[1]).sum(0) / (int(known.sum()) - 1)
    return math.sqrt(max(0.0, float(covariance.mean())))
