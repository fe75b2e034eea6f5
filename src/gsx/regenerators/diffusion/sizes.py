"""Sizes that a model takes: pictures grow by their own reflection, and results lose exactly what was added.

A pipeline silently resizes pictures of another size (diffusers), which moves every pixel.
"""

import torch
from torch import Tensor

from gsx.core.data.window import Window
from gsx.core.shapes import Float, Int


def mirrored(side: int, before: int, after: int) -> Int[Tensor, "n"]:
    """Return pixels 0 to side - 1 with reflections at both ends: -1 is pixel 1, -2 is pixel 2."""
    period = max(1, 2 * side - 2)
    there_and_back = torch.arange(-before, side + after).remainder(period)
    return torch.minimum(there_and_back, period - there_and_back).clamp(max=side - 1)


def padded_to(image: Float[Tensor, "3 h w"], multiple: int, least: int) -> tuple[Float[Tensor, "3 H W"], Window]:
    """Extend a picture to sides that a model takes; returns it and the window of the original in it."""
    height, width = image.shape[1:]
    down, right = (-(-max(side, least) // multiple) * multiple - side for side in (height, width))
    window = Window(left=right // 2, top=down // 2, width=width, height=height)
    rows = mirrored(height, window.top, down - window.top).to(image.device)
    columns = mirrored(width, window.left, right - window.left).to(image.device)
    return image[:, rows][:, :, columns], window
