"""Pictures of a camera that moves while they are taken.

A turn of the camera moves all of a picture alike, whatever its depth, and in a short time about evenly along a line:
what is taken is the mean of the sharp picture over that line.
"""

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.nn.functional import pad

from gsx.core.shapes import Float

SAMPLES = 4
"""Places along a movement, for each px of it."""
DAMPING = 0.05
"""Of gradients that are sharpened: a frequency that blur leaves less than the root of this of is held back."""
REACH = 4
"""Lengths of a movement's kernel that sharpening reaches."""


def line_kernel(across: float, down: float) -> Float[Tensor, "K K"]:
    """Weights of the mean over a movement, its middle in the middle, float64: points along it, each shared out to the
    four pixels around it."""
    count = max(1, math.ceil(SAMPLES * math.hypot(across, down)))
    along = (torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5
    radius = math.ceil(max(abs(across), abs(down)) / 2)
    places = torch.stack([down * along, across * along], 1) + radius
    first = places.floor()
    (up, left), (low, right) = (part.unbind(1) for part in (1 - (places - first), places - first))
    kernel = torch.zeros(2 * radius + 2, 2 * radius + 2, dtype=torch.float64)
    row, column = first.long().unbind(1)
    for rows, of_row in ((0, up), (1, low)):
        for columns, of_column in ((0, left), (1, right)):
            kernel.index_put_((row + rows, column + columns), of_row * of_column / count, accumulate=True)
    return kernel[: 2 * radius + 1, : 2 * radius + 1]


def motion_blurred(image: Float[Tensor, "C H W"], across: float, down: float) -> Float[Tensor, "C H W"]:
    """The mean of a picture over a movement, px; beyond its edges it goes on as it is there."""
    kernel = line_kernel(across, down)
    side, (height, width) = len(kernel) // 2, image.shape[1:]
    if side == 0:
        return image
    around, total = pad(image[None], (side, side, side, side), mode="replicate")[0], torch.zeros_like(image)
    for row, column in kernel.nonzero().tolist():
        weight = float(kernel[row, column])
        total = torch.add(total, around[:, row : row + height, column : column + width], alpha=weight)
    return total


# -- gradients ---------------------------------------------------------------------------------------------------------


class MotionBlur(Function):
    """`motion_blurred`; what comes back through it is sharpened, not blurred once more."""

    @staticmethod
    def forward(ctx: Any, image: Float[Tensor, "C H W"], across: float, down: float) -> Float[Tensor, "C H W"]:
        """The mean over the movement."""
        ctx.movement = across, down
        return motion_blurred(image, across, down)

    @staticmethod
    def backward(ctx: Any, gradient: Float[Tensor, "C H W"]) -> tuple[Float[Tensor, "C H W"], None, None]:
        """To the sharp picture."""
        return sharpened(gradient, *ctx.movement), None, None


def blurred_to_learn(image: Float[Tensor, "C H W"], across: float, down: float) -> Float[Tensor, "C H W"]:
    """The mean of a picture over a movement, px, whose gradient is a direction to go, not the slope.

    With K the mean over the movement, the slope of a loss with gradient g is K^T g: what the photograph has little of
    is weighted down by the blur twice, and learnt last. Here it is (1 + d) (K^T K + d)^-1 K^T g, the direction of Gauss
    and Newton for the sharp picture, damped by d (Levenberg 1944). Away from the edges it goes down as well, and where
    nothing is blurred away it is the slope; it is up to (1 + d) / (2 sqrt d) times as large as g.
    """
    return MotionBlur.apply(image, across, down)


def sharpened(gradient: Float[Tensor, "C H W"], across: float, down: float) -> Float[Tensor, "C H W"]:
    """(1 + d) (K^T K + d)^-1 K^T of a gradient, by its spectrum; beyond its edges it is zero."""
    kernel, (height, width) = line_kernel(across, down).to(gradient), gradient.shape[1:]
    side, beyond = len(kernel) // 2, REACH * len(kernel)
    size = height + beyond, width + beyond
    around = pad(kernel, (0, size[1] - len(kernel), 0, size[0] - len(kernel))).roll((-side, -side), (0, 1))
    share = torch.fft.rfft2(around).real  # of a frequency that is left; real, since movements go both ways alike
    factor = (1 + DAMPING) * share / (share.square() + DAMPING)
    return torch.fft.irfft2(factor * torch.fft.rfft2(gradient, s=size), s=size)[:, :height, :width].contiguous()
