"""Reduction of pictures: the filter by which a scene's photographs become training pictures, and its adjoint."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, conv_transpose2d

from gsx.core.data.resize import FILTERS, KERNELS, LIGHTS, REACH, display_from_linear, linear_from_display
from gsx.core.shapes import Float

ROUNDS = 15
"""Rounds of projection and clamping, at most."""
ENOUGH = 0.02 / 255
"""A picture that reduces to values as close as this to the given ones is projected."""
PACE, MEMORY = 1.73, 0.139
"""Heavy ball (Polyak 1964) for a^2 D D^T with eigenvalues from 0.227 to 1.09: those of both filters at any factor."""


@dataclass(frozen=True, kw_only=True)
class Reduction:
    """A filter that widens with the factor, as of `resize.resize`, on display values or on light."""

    filter: str = "area"
    light: str = "display"

    def __post_init__(self) -> None:
        if self.filter not in FILTERS or self.light not in LIGHTS:
            raise ValueError(f"no reduction '{self.filter}' of '{self.light}': choose from {FILTERS}, {LIGHTS}")

    @property
    def rim(self) -> int:
        """Pixels along the border of a reduced window that take from beyond the window, where it is cut out of more."""
        return REACH.get(self.filter, 0)

    def inner(self, low: Float[Tensor, "*C h w"]) -> Float[Tensor, "*C inner_h inner_w"]:
        """Return a reduced window without its rim, as far as something is left."""
        down, across = (min(self.rim, (side - 1) // 2) for side in low.shape[-2:])
        return low[..., down : low.shape[-2] - down, across : low.shape[-1] - across]

    def reduce(self, image: Float[Tensor, "*C H W"], factor: int) -> Float[Tensor, "*C h w"]:
        """Return the picture `factor` times as coarse, differentiable; all but display box averages in [0, 1]."""
        if factor == 1:
            return image
        low = self.formed(image.clamp(0, 1) if self.light == "linear" else image, factor)
        return low if (self.filter, self.light) == ("area", "display") else low.clamp(0, 1)

    def formed(self, image: Float[Tensor, "*C H W"], factor: int) -> Float[Tensor, "*C h w"]:
        """Return the same without a clamp: a loss pulls back what lies beyond [0, 1]."""
        if self.light == "display":
            return self.linear(image, factor)
        return display_from_linear(self.linear(linear_from_display(image), factor), limited=False)

    def linear(self, image: Float[Tensor, "*C H W"], factor: int) -> Float[Tensor, "*C h w"]:
        """Apply the filter alone, D, to display values or light."""
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
        """Apply the adjoint D^T: <D x, y> = <x, D^T y>."""
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
        """Return (what a coarse pixel takes of fine ones in a row, how many lie beyond its block on each side)."""
        reach = REACH[self.filter]
        margin = reach * factor - factor // 2
        distance = (torch.arange(factor + 2 * margin, dtype=torch.float64) + 0.5 - margin) / factor - 0.5
        weights = torch.where(distance.abs() <= reach, KERNELS[self.filter](distance), 0)
        return (weights / weights.sum()).to(like), margin

    def sums(self, count: int, factor: int, like: Tensor) -> Float[Tensor, "n"]:
        """Return what weights of each of `count` coarse pixels add up to inside the picture: 1 but at its borders."""
        weights, margin = self.weights(factor, like)
        ones = torch.ones(1, 1, 1, count * factor, dtype=like.dtype, device=like.device)
        return conv2d(ones, weights[None, None, None], stride=(1, factor), padding=(0, margin)).flatten()


def box_average(image: Float[Tensor, "*C H W"], factor: int) -> Float[Tensor, "*C h w"]:
    """Return means over blocks of factor x factor pixels."""
    return avg_pool2d(image, factor)


def as_blocks(image: Float[Tensor, "*C h w"], factor: int) -> Float[Tensor, "*C H W"]:
    """Repeat every pixel as a block of factor x factor."""
    return image.repeat_interleave(factor, -2).repeat_interleave(factor, -1)


def projected(
    image: Float[Tensor, "*C H W"], low: Float[Tensor, "*C h w"], factor: int, reduction: Reduction
) -> Float[Tensor, "*C H W"]:
    """Return the nearest picture that reduces to `low`, in [0, 1]; nearest in light where light is reduced.

    Errors are spread by the adjoint, round after round; of box averages the first does it, since D D^T = I / a^2, and
    later ones halve what clamping undid.
    """
    if reduction.light == "linear":
        in_light = Reduction(filter=reduction.filter)
        fine, given = linear_from_display(image.clamp(0, 1)), linear_from_display(low.clamp(0, 1))
        return display_from_linear(projected(fine, given, factor, in_light))
    pace, memory = (1.0, 0.0) if reduction.filter == "area" else (PACE, MEMORY)
    before = image
    for _ in range(ROUNDS):
        off = low - reduction.reduce(image, factor)
        if float(off.abs().max()) < ENOUGH:
            break
        onward = image + pace * factor**2 * reduction.adjoint(off, factor) + memory * (image - before)
        before, image = image, onward.clamp(0, 1)
    return image.clamp(0, 1)
