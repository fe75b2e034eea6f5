"""Windows of training views that count in no loss for a while, and what steps or primitives have gained in them."""

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
    """Windows with a share of the sides of so many views. Which, and where, comes from purpose and number alone, not
    from the run's seed."""
    generator = torch.Generator().manual_seed(derived_seed(purpose, number))
    order = torch.randperm(len(views), generator=generator)[:count].tolist()
    corners = torch.rand(len(order), 2, generator=generator).tolist()
    chosen = zip([views[index] for index in order], corners, strict=True)
    return {view: part_of(view, share, *corner) for view, corner in chosen}


def part_of(view: View, share: float, right: float, down: float) -> Window:
    """A window with that share of a view's sides; where it lies, from 0 (left, top) to 1."""
    width, height = (max(1, round(share * side)) for side in view.camera.size)
    left, top = round(right * (view.camera.width - width)), round(down * (view.camera.height - height))
    return Window(left, top, width, height)


def rounding_in(windows: Mapping[View, Window]) -> Float[Tensor, "W"]:
    """Squared error of photographs' rounding to 8 bits in each window, summed over the values that count; 0 where
    all are masked."""
    return torch.tensor([rounding_of(view, window) for view, window in windows.items()])


def decibels(has: Float[Tensor, "W"], had: Float[Tensor, "W"]) -> tuple[float, float]:
    """(gain in dB from the squared errors `had` to `has`, summed over windows; its standard error over the windows): 0
    and infinite where there are none."""
    if not bool(had.any()):
        return 0.0, math.inf
    gain = 10 * math.log10(float(had.sum() / has.sum()))
    spread = float((had - has).std(correction=1)) * math.sqrt(len(has)) if len(has) > 1 else math.inf
    return gain, 10 / math.log(10) * spread / float(had.sum())
