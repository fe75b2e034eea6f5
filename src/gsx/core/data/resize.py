"""Resizing of pictures: kernels, linear light, training sizes."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.errors import ConfigError, nearest
from gsx.core.shapes import Float, UInt8

Size = tuple[int, int]
"""(width, height), px."""
FILTERS = ("bicubic", "area", "lanczos")
LIGHTS = ("display", "linear")


def linear_from_display(display: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Returns linear light of display values (IEC 61966-2-1, sRGB); the linear part of the curve extends below 0."""
    bright = display.clamp_min(0.04045)  # powers of negative numbers are nan, and so are their gradients
    return torch.where(display <= 0.04045, display / 12.92, ((bright + 0.055) / 1.055) ** 2.4)


def display_from_linear(light: Float[Tensor, "*shape"], limited: bool = True) -> Float[Tensor, "*shape"]:
    """Returns display values of linear light (IEC 61966-2-1, sRGB), clamped to [0, 1] if `limited`."""
    light = light.clamp(0, 1) if limited else light
    bright = light.clamp_min(0.0031308)  # a power's slope at 0 is infinite
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * bright ** (1 / 2.4) - 0.055)


def training_size(width: int, height: int, downscale: int, max_width: int) -> Size:
    """Returns the training size (3D-GS): divided by `downscale` and rounded, or at most `max_width` wide (0: any)."""
    if downscale > 1:
        return max(1, round(width / downscale)), max(1, round(height / downscale))
    if max_width and width > max_width:
        scale = width / max_width
        return int(width / scale), max(1, int(height / scale))
    return width, height


def resize(
    image: UInt8[Tensor, "C H W"], width: int, height: int, filter: str = "bicubic", light: str = "display"
) -> UInt8[Tensor, "C height width"]:
    """Resizes an image, each channel on its own; composite alpha first.

    All filters (`FILTERS`) widen with the reduction against aliasing: Keys' cubic with a = -0.5, the published filter
    on display values; pixel coverage (area); Lanczos with 3 lobes.
    """
    if image.shape[1:] == (height, width):
        return image
    across, down = _weights(image.shape[2], width, filter), _weights(image.shape[1], height, filter)
    if light == "linear":
        values = _down(_across(linear_from_display(image.float() / 255), across), down)
        return to_uint8(display_from_linear(values))
    values = _across(image.float(), across)
    if filter == "bicubic":  # Pillow, whose result is the published one, keeps 8 bits between its two passes
        values = _rounded(values).float()
    return _rounded(_down(values, down))


@dataclass(frozen=True, kw_only=True)
class ResizeRule:
    """Rule from photos to training images."""

    filter: str
    light: str
    background: tuple[float, float, float]
    """Display RGB in [0, 1] behind images with alpha."""

    def __post_init__(self) -> None:
        for key, value, known in (("filter", self.filter, FILTERS), ("light", self.light, LIGHTS)):
            if value not in known:
                raise ConfigError(
                    f"scene.resize_{key} is '{value}', use one of {', '.join(known)}.{nearest(value, known)}"
                )
        if len(self.background) != 3 or not all(0 <= value <= 1 for value in self.background):
            raise ConfigError(f"scene.background is {list(self.background)}, give red, green and blue in [0, 1].")


def _across(values: Float[Tensor, "C H W"], weights: Float[Tensor, "new W"]) -> Float[Tensor, "C H new"]:
    return _down(values.transpose(1, 2), weights).transpose(1, 2)


def _down(values: Float[Tensor, "C H W"], weights: Float[Tensor, "new H"]) -> Float[Tensor, "C new W"]:
    return torch.stack([weights @ channel.contiguous() for channel in values])


def _rounded(levels: Float[Tensor, "C H W"]) -> UInt8[Tensor, "C H W"]:
    """Rounds values in 0..255 to 8 bits, ties up."""
    return (levels + 0.5).clamp(0, 255).to(torch.uint8)


def _weights(size: int, new_size: int, filter: str) -> Float[Tensor, "new_size size"]:
    """Returns the filter as a sparse matrix, new pixels by old ones, whose rows add up to 1."""
    ratio = size / new_size
    stretch = max(ratio, 1.0)
    reach = (1 + ratio) / 2 if filter == "area" else REACH[filter] * stretch
    centre = ((torch.arange(new_size, dtype=torch.float64) + 0.5) * ratio)[:, None]
    old = (centre - reach - 0.5).ceil().long() + torch.arange(math.floor(2 * reach) + 1)
    distance = old + 0.5 - centre
    shared = ((1 + ratio) / 2 - distance.abs()).clamp(0, min(1, ratio))  # length of an old and of the new pixel
    weights = shared if filter == "area" else KERNELS[filter](distance / stretch)
    weights = torch.where((distance.abs() <= reach) & (old >= 0) & (old < size), weights, 0)
    weights /= weights.sum(1, keepdim=True)
    new = torch.arange(new_size)[:, None].expand_as(old)
    places = torch.stack([new.flatten(), old.clamp(0, size - 1).flatten()])
    return torch.sparse_coo_tensor(
        places, weights.flatten().float(), (new_size, size), check_invariants=False
    ).coalesce()


def _keys(x: Tensor) -> Tensor:
    """Evaluates Keys' cubic (1981) with a = -0.5, for |x| <= 2."""
    x = x.abs()
    inner = (1.5 * x - 2.5) * x * x + 1
    return torch.where(x < 1, inner, ((-0.5 * x + 2.5) * x - 4) * x + 2)


def _lanczos(x: Tensor) -> Tensor:
    """Evaluates sinc(x) sinc(x / 3), for |x| <= 3."""
    return torch.sinc(x) * torch.sinc(x / 3)


KERNELS = {"bicubic": _keys, "lanczos": _lanczos}
REACH = {"bicubic": 2, "lanczos": 3}


def to_uint8(image: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """Rounds display values in [0, 1] to 8 bits: x 255 + 0.5, clamped (3D-GS, metrics.py)."""
    return (image * 255 + 0.5).clamp(0, 255).to(torch.uint8)
