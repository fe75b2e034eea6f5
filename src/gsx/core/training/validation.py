"""Validation windows: parts of training views that are kept out of the loss, and the gain in dB measured on them."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float
from gsx.core.training.importance import rounding_of


def validation_windows(
    views: Sequence[View], count: int, share: float, purpose: str, number: int
) -> dict[View, Window]:
    """Picks windows with a share of the sides of `count` views; depends on purpose and number alone."""
    generator = torch.Generator().manual_seed(derived_seed(purpose, number))
    order = torch.randperm(len(views), generator=generator)[:count].tolist()
    corners = torch.rand(len(order), 2, generator=generator).tolist()
    chosen = zip([views[index] for index in order], corners, strict=True)
    return {view: part_of(view, share, *corner) for view, corner in chosen}


def part_of(view: View, share: float, right: float, down: float) -> Window:
    """Returns a window with a share of a view's sides; `right`, `down`: its place from 0 to 1."""
    width, height = (max(1, round(share * side)) for side in view.camera.size)
    left, top = round(right * (view.camera.width - width)), round(down * (view.camera.height - height))
    return Window(left, top, width, height)


def rounding_in(windows: Mapping[View, Window]) -> Float[Tensor, "W"]:
    """Returns the squared error of rounding photos to 8 bits in each window; masked pixels count 0."""
    return torch.tensor([rounding_of(view, window) for view, window in windows.items()])


def decibels(after: Float[Tensor, "W"], before: Float[Tensor, "W"]) -> tuple[float, float]:
    """Returns the gain in dB from errors `before` to `after`, and its standard error; (0, inf) without windows."""
    if not bool(before.any()):
        return 0.0, math.inf
    gain = 10 * math.log10(float(before.sum() / after.sum()))
    spread = float((before - after).std(correction=1)) * math.sqrt(len(after)) if len(after) > 1 else math.inf
    return gain, 10 / math.log(10) * spread / float(before.sum())
