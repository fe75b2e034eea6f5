"""Reduction of pictures by the filter that made the training images, its adjoint, and projection."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, conv_transpose2d

from gsx.core.data.resize import FILTERS, KERNELS, LIGHTS, REACH, display_from_linear, linear_from_display
from gsx.core.shapes import Float

ROUNDS = 15
"""Largest number of rounds of projection and clamping."""
TOLERANCE = 0.02 / 255
"""Largest error of a projected picture's reduction, display values."""
PACE, MEMORY = 1.73, 0.139
"""Heavy-ball parameters (Polyak 1964) for a^2 D D^T with eigenvalues in [0.227, 1.09], as of both filters."""


@dataclass(frozen=True, kw_only=True)
class Reduction:
    """Antialiasing filter, as in `resize.resize`, on display values or linear light."""

    filter: str = "area"
    light: str = "display"

    def __post_init__(self) -> None:
        if self.filter not in FILTERS or self.light not in LIGHTS:
            raise ValueError(f"no reduction '{self.filter}' of '{self.light}': choose from {FILTERS}, {LIGHTS}")

    @property
    def rim(self) -> int:
        """Width of the border of a reduced window that needs pixels outside the window, px."""
        return REACH.get(self.filter, 0)

    def inner(self, low: Float[Tensor, "*C h w"]) -> Float[Tensor, "*C inner_h inner_w"]:
        """Returns a reduced window without its rim, at least one pixel."""
        down, across = (min(self.rim, (side - 1) // 2) for side in low.shape[-2:])
        return low[..., down : low.shape[-2] - down, across : low.shape[-1] - across]

    def reduce(self, image: Float[Tensor, "*C H W"], factor: int) -> Float[Tensor, "*C h w"]:
        """Returns the reduced picture, clamped except for display box averages; differentiable."""
        if factor == 1:
            return image
        low = self.unclamped(image.clamp(0, 1) if self.light == "linear" else image, factor)
        return low if (self.filter, self.light) == ("area", "display") else low.clamp(0, 1)

    def unclamped(self, image: Float[Tensor, "*C H W"], factor: int) -> Float[Tensor, "*C h w"]:
        """Returns the same without a clamp, so that values outside [0, 1] have a gradient."""
        if self.light == "display":
            return self.linear(image, factor)
        return display_from_linear(self.linear(linear_from_display(image), factor), limited=False)

    def linear(self, image: Float[Tensor, "*C H W"], factor: int) -> Float[Tensor, "*C h w"]:
        """Applies the filter D."""
        planes = image.reshape(-1, 1, *image.shape[-2:])
        if self.filter == "area":
            low = box_average(planes, factor)
        else:
            weights, margin = self.weights(factor, image)
            rows, columns = (self.sums(side // factor, factor, image) for side in planes.shape[2:])
            low = conv2d(planes, weights[None, None, None], stride=(1, factor), padding=(0, margin)) / columns
            low = conv2d(low, weights[None, None, :, None], stride=(factor, 1), padding=(margin, 0)) / rows[:, None]
        return low.reshape(*image.shape[:-2], *low.shape[2:])

    def adjoint(self, low: Float[Tensor, "*C h w"], factor: int) -> Float[Tensor, "*C H W"]:
        """Applies the adjoint D^T: <D x, y> = <x, D^T y>."""
        if self.filter == "area":
            return as_blocks(low, factor) / factor**2
        planes = low.reshape(-1, 1, *low.shape[-2:])
        weights, margin = self.weights(factor, low)
        rows, columns = (self.sums(side, factor, low) for side in low.shape[-2:])
        fine = conv_transpose2d(
            planes / rows[:, None], weights[None, None, :, None], stride=(factor, 1), padding=(margin, 0)
        )
        fine = conv_transpose2d(fine / columns, weights[None, None, None], stride=(1, factor), padding=(0, margin))
        return fine.reshape(*low.shape[:-2], *fine.shape[2:])

    def weights(self, factor: int, like: Tensor) -> tuple[Float[Tensor, "L"], int]:
        """Returns a coarse pixel's weights of fine ones in a row, and their number outside its block on each side."""
        reach = REACH[self.filter]
        margin = reach * factor - factor // 2
        distance = (torch.arange(factor + 2 * margin, dtype=torch.float64) + 0.5 - margin) / factor - 0.5
        weights = torch.where(distance.abs() <= reach, KERNELS[self.filter](distance), 0)
        return (weights / weights.sum()).to(like), margin

    def sums(self, count: int, factor: int, like: Tensor) -> Float[Tensor, "n"]:
        """Returns the sum of each coarse pixel's weights inside the picture: 1 except at its borders."""
        weights, margin = self.weights(factor, like)
        ones = torch.ones(1, 1, 1, count * factor, dtype=like.dtype, device=like.device)
        return conv2d(ones, weights[None, None, None], stride=(1, factor), padding=(0, margin)).flatten()


def box_average(image: Float[Tensor, "*C H W"], factor: int) -> Float[Tensor, "*C h w"]:
    """Returns means over blocks of factor x factor pixels."""
    return avg_pool2d(image, factor)


def as_blocks(image: Float[Tensor, "*C h w"], factor: int) -> Float[Tensor, "*C H W"]:
    """Repeats every pixel as a block of factor x factor."""
    return image.repeat_interleave(factor, -2).repeat_interleave(factor, -1)


def projected(
    image: Float[Tensor, "*C H W"], low: Float[Tensor, "*C h w"], factor: int, reduction: Reduction
) -> Float[Tensor, "*C H W"]:
    """Returns the nearest picture in [0, 1] that reduces to `low`, nearest in linear light if that is reduced.

    Each round adds the adjoint of the error. For box averages one round is exact, since D D^T = I / a^2, except for the
    clamp, whose error each further round halves.
    """
    if reduction.light == "linear":
        in_light = Reduction(filter=reduction.filter)
        fine, coarse = linear_from_display(image.clamp(0, 1)), linear_from_display(low.clamp(0, 1))
        return display_from_linear(projected(fine, coarse, factor, in_light))
    pace, memory = (1.0, 0.0) if reduction.filter == "area" else (PACE, MEMORY)
    before = image
    for _ in range(ROUNDS):
        off = low - reduction.reduce(image, factor)
        if float(off.abs().max()) < TOLERANCE:
            break
        onward = image + pace * factor**2 * reduction.adjoint(off, factor) + memory * (image - before)
        before, image = image, onward.clamp(0, 1)
    return image.clamp(0, 1)
