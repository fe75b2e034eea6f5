"""Sizes that a model takes: pictures grow by their own reflection, and results lose exactly what was added.

A pipeline that is handed another size resizes without a word (diffusers), which moves every pixel.
"""

import torch
from torch import Tensor

from gsx.core.data.window import Window
from gsx.core.shapes import Float, Int


def fitting(side: int, multiple: int, least: int) -> int:
    """The shortest side from `side` on that is a multiple and at least `least`, px."""
    return max(-(-side // multiple), -(-least // multiple)) * multiple


def mirrored(side: int, before: int, after: int) -> Int[Tensor, "n"]:
    """Pixels 0 to side - 1 with so many more at each end, there and back again: -1 is pixel 1, -2 is pixel 2."""
    period = max(1, 2 * side - 2)
    there_and_back = torch.arange(-before, side + after).remainder(period)
    return torch.minimum(there_and_back, period - there_and_back).clamp(max=side - 1)


def grown(image: Float[Tensor, "3 h w"], multiple: int, least: int) -> tuple[Float[Tensor, "3 H W"], Window]:
    """(a picture of sides that a model takes, where in it the given one is)."""
    height, width = image.shape[1:]
    down, right = (fitting(side, multiple, least) - side for side in (height, width))
    window = Window(left=right // 2, top=down // 2, width=width, height=height)
    rows = mirrored(height, window.top, down - window.top).to(image.device)
    columns = mirrored(width, window.left, right - window.left).to(image.device)
    return image[:, rows][:, :, columns], window


def enlarged(window: Window, factor: int) -> Window:
    """The same part of a picture that is `factor` times as large."""
    return Window(
        left=factor * window.left, top=factor * window.top, width=factor * window.width, height=factor * window.height
    )
