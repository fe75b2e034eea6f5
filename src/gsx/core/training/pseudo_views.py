"""Pseudo views: made-up pictures that training uses as targets for a while."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.data.window import Window
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
    made: Sequence[PseudoView] = ()
    """Pseudo views of all training views that were made for this step."""


def pseudo_loss(image: Float[Tensor, "3 h w"], view: PseudoView, squared: bool = False) -> Float[Tensor, ""]:
    """Returns the weighted mean |render - target|, plus that from `view.coarse` (SRGS); `squared`: of squares."""
    size = torch.square if squared else torch.abs
    difference = size(image - view.target.to(image.device).float() / 255)
    if view.pixel_weight is not None:
        difference = difference * (view.pixel_weight.to(image.device).float() / 255)
    if view.coarse is None:
        return difference.mean()
    reduced = view.reduction.reduce(image, view.camera.width // view.coarse.shape[2])
    off = view.reduction.inner(reduced - view.coarse.to(image.device).float() / 255)
    return difference.mean() + view.coarse_weight * size(off).mean()


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
