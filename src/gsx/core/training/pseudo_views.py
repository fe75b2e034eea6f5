"""Pseudo views: made-up pictures that training uses as targets for a while."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from gsx.core.backend import EAGER, Backend
from gsx.core.data.camera import Camera
from gsx.core.data.masks import black_out
from gsx.core.data.reduction import Reduction
from gsx.core.data.window import Window
from gsx.core.quality.losses import photometric, ssim_map
from gsx.core.shapes import Float, UInt8


@dataclass(frozen=True, eq=False, kw_only=True)
class PseudoView:
    """A camera and the target picture for it."""

    camera: Camera
    target: UInt8[Tensor, "3 h w"]
    parent: int
    """Index of the training view it was made from."""
    pixel_weight: UInt8[Tensor, "h w"] | None = None
    """Weight of each pixel in the loss, 255 is full weight; None: all full."""
    coarse: UInt8[Tensor, "3 l m"] | None = None
    """Target at a lower resolution, for the reduced render; None: no such term."""
    coarse_weight: float = 0.0
    """Weight of the mean difference from `coarse`."""
    reduction: Reduction = Reduction()
    """Filter from render to `coarse`; its rim, which needs pixels beyond the window, is left out."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Kind, event, regenerator, seed, hash. JSON-serialisable."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Term:
    """An augmenter's term in the loss of one step: the weighted sum of mean differences of its pseudo views."""

    name: str
    parts: Sequence[tuple[PseudoView, float]]
    """Pseudo views with their weights."""
    replaces: float
    """Share of the backbone's own loss that this term replaces; 0: the term is added."""
    observed: bool
    """True: density control learns from the renders, each by its weight in `parts` (as the authors' code)."""
    shared: bool
    """True: gradients reach parameters that all primitives share, such as a colour network (False: de-MLP)."""
    squared: bool = False
    """Squared differences instead of the paper's absolute ones."""
    ssim_weight: float = 0.0
    """Weight of 1 - SSIM, as in the loss of photos; 0 in the paper."""
    made: Sequence[PseudoView] = ()
    """Pseudo views of all training views that were made for this step."""


def pseudo_loss(
    image: Float[Tensor, "3 h w"],
    view: PseudoView,
    squared: bool = False,
    ssim_weight: float = 0.0,
    backend: Backend = EAGER,
) -> Float[Tensor, ""]:
    """Returns the weighted mean |render - target|, plus that from `view.coarse` (SRGS).

    Args:
        image: Render by the view's camera.
        view: Pseudo view.
        squared: Squared differences.
        ssim_weight: Above 0: the photos' loss with that weight of 1 - SSIM; pixel weights multiply its map (SplatSuRe).
        backend: `RasterSettings.backend.on(device, learning=True)`.
    """
    size = torch.square if squared else torch.abs
    target = view.target.to(image.device).float() / 255
    if not ssim_weight:
        loss = weighted(size(image - target), view).mean()
    elif view.pixel_weight is None:
        loss = photometric(image, target, ssim_weight, backend)
    else:
        counted = view.pixel_weight.to(image.device) > 0  # SSIM of a pixel reads its neighbours
        unlike = 1 - ssim_map(black_out(image, counted), black_out(target, counted))
        loss = weighted((1 - ssim_weight) * (image - target).abs() + ssim_weight * unlike, view).mean()
    if view.coarse is None:
        return loss
    reduced = view.reduction.reduce(image, view.camera.width // view.coarse.shape[2])
    off = view.reduction.inner(reduced - view.coarse.to(image.device).float() / 255)
    return loss + view.coarse_weight * size(off).mean()


def weighted(values: Float[Tensor, "C h w"], view: PseudoView) -> Float[Tensor, "C h w"]:
    """Multiplies values by the weights of a pseudo view's pixels."""
    return values if view.pixel_weight is None else values * (view.pixel_weight.to(values.device).float() / 255)


def mask_windows(view: PseudoView, camera: Camera, windows: Sequence[Window]) -> PseudoView:
    """Masks validation windows of a training camera in a pseudo view, so that they enter no loss through it.

    This applies to pseudo views made from the training photo, or at its camera's pose (corrected or not). Pixels that
    show a part of a window get weight 0; if there are any, the target at a lower resolution is dropped.
    """
    made = view.provenance
    if not (
        made.get("source") == "photo" or made.get("kind") in ("base", "coarser") or view.camera.has_pose_of(camera)
    ):
        return view
    mapped = [window.mapped_to(view.camera, camera) for window in windows]
    parts = [part for part in mapped if part.width and part.height]
    if not parts:
        return view
    whole = torch.full(view.target.shape[1:], 255, dtype=torch.uint8)
    weight = whole if view.pixel_weight is None else view.pixel_weight.clone()
    for part in parts:
        weight[part.pixels] = 0
    return replace(view, pixel_weight=weight, coarse=None)
