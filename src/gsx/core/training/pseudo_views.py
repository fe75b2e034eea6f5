"""Pseudo details: pictures that nobody took, which training uses as truth for a while."""

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
    """A camera and the picture it is to show."""

    camera: Camera
    target: UInt8[Tensor, "3 h w"]
    parent: int
    """Number of the training view it was made from."""
    pixel_weight: UInt8[Tensor, "h w"] | None = None
    """Weight of each pixel in the loss, 255 counts whole; None: all count whole."""
    coarse: UInt8[Tensor, "3 l m"] | None = None
    """What is known of it at a lower resolution: what it reduces to."""
    coarse_weight: float = 0.0
    """Of the mean difference at that resolution, beside that of the pixels."""
    reduction: Reduction = Reduction()
    """By which it becomes `coarse`, but for the rim: that takes from beyond the window."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Where it comes from: kind, event, regenerator, seed, hash. JSON-serialisable."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Term:
    """What an augmenter adds to the loss of one step: the sum of weight times the mean difference."""

    name: str
    parts: Sequence[tuple[PseudoView, float]]
    """Pseudo views with their weights."""
    replaces: float
    """Share of the backbone's own loss that this term takes the place of; 0: it is added."""
    observed: bool
    """Whether the renders count in density control (the authors' code does so), each by its weight in `parts`. That is
    the weight of the mean difference whatever its kind: squares, or what is known at a lower resolution beside it."""
    shared: bool
    """Whether it moves parameters that all primitives share, such as a colour network (off: de-MLP)."""
    squared: bool = False
    """Differences are (render - target)^2 instead of the paper's |render - target|."""
    made: Sequence[PseudoView] = ()
    """Pseudo views of all training views that were made for this step."""


def pseudo_loss(image: Float[Tensor, "3 h w"], view: PseudoView, squared: bool = False) -> Float[Tensor, ""]:
    """Mean |render - target| over pixels and channels, each pixel by its weight; that at a lower resolution
    beside it where that is known (SRGS). `squared`: (render - target)^2 in both."""
    size = torch.square if squared else torch.abs
    difference = size(image - view.target.to(image.device).float() / 255)
    if view.pixel_weight is not None:
        difference = difference * (view.pixel_weight.to(image.device).float() / 255)
    if view.coarse is None:
        return difference.mean()
    reduced = view.reduction.reduce(image, view.camera.width // view.coarse.shape[2])
    off = view.reduction.inner(reduced - view.coarse.to(image.device).float() / 255)
    return difference.mean() + view.coarse_weight * size(off).mean()


def kept_out(view: PseudoView, camera: Camera, windows: Sequence[Window]) -> PseudoView:
    """A pseudo view without what it shows of windows of a training camera, where it stands at that (or did, before its
    pose was corrected) or was made from its photograph: what counts in no loss must not come back as a pseudo detail.
    A pixel that shows a part of a window does not count; nor does what is known of a view at a lower resolution, if it
    shows any."""
    made = view.provenance
    if not (
        made.get("source") == "photo" or made.get("kind") in ("base", "coarser") or view.camera.has_pose_of(camera)
    ):
        return view
    seen = [window.seen_by(view.camera, camera) for window in windows]
    seen = [part for part in seen if part.width and part.height]
    if not seen:
        return view
    whole = torch.full(view.target.shape[1:], 255, dtype=torch.uint8)
    weight = whole if view.pixel_weight is None else view.pixel_weight.clone()
    for part in seen:
        weight[part.pixels] = 0
    return replace(view, pixel_weight=weight, coarse=None)
