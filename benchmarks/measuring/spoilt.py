"""Pictures with known faults, made from exact ones: display values [3, H, W] in [0, 1], float32."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from gsx.core.quality.metrics import bicubic
from gsx.core.shapes import Float

Picture = Float[Tensor, "3 H W"]
CONTRAST_REACH = 6.0
"""Standard deviation of the window in which local contrast is measured, px."""
GRAIN = 0.8
"""Standard deviation of the filter that makes invented texture of white noise, px."""
HEADROOM = 0.5
"""Share of the distance to black and white that gaps between splats use."""


def blurred(picture: Float[Tensor, "C H W"], deviation: float) -> Float[Tensor, "C H W"]:
    """Filters by a Gaussian of a standard deviation in px, with repeated borders."""
    reach = math.ceil(4 * deviation)
    line = torch.exp(-(torch.arange(-reach, reach + 1).float() ** 2) / (2 * deviation**2))
    line /= line.sum()
    wide = pad(picture[:, None], [reach] * 4, mode="replicate")
    return conv2d(conv2d(wide, line.view(1, 1, -1, 1)), line.view(1, 1, 1, -1))[:, 0]


def brighter(picture: Picture, gain: float) -> Picture:
    """Multiplies display values by a gain and clamps them."""
    return (picture * gain).clamp(0, 1)


def shifted(picture: Picture, pixels: int) -> Picture:
    """Moves what a picture shows to the right by whole px, with repeated borders."""
    width = picture.shape[2]
    return picture[:, :, (torch.arange(width) - pixels).clamp(0, width - 1)]


def reduced(picture: Picture, factor: int) -> Float[Tensor, "3 h w"]:
    """Averages blocks of pixels."""
    return avg_pool2d(picture, factor)


def enlarged(picture: Picture, factor: int) -> Float[Tensor, "3 h w"]:
    """Enlarges by bicubic interpolation."""
    return bicubic(picture, picture.shape[2] * factor, picture.shape[1] * factor)


def textured(picture: Picture, strength: float, generator: torch.Generator) -> Picture:
    """Adds grey noise of fine grain, as strong as the local contrast times `strength`: texture that nothing has."""
    luminance = picture.mean(0, keepdim=True)
    contrast = blurred((luminance - blurred(luminance, CONTRAST_REACH)).square(), CONTRAST_REACH).sqrt()
    grain = blurred(torch.randn(luminance.shape, generator=generator), GRAIN)
    return (picture + strength * contrast * grain / grain.std()).clamp(0, 1)


def with_gaps(picture: Picture, factor: int) -> Picture:
    """Replaces each block of `factor` px by its mean, brighter in the middle and darker around it: thin splats.

    The means of blocks stay, so that the reduced picture does not change.
    """
    mean = reduced(picture, factor)
    room = torch.minimum(mean, 1 - mean) * HEADROOM
    middle = torch.zeros(factor, factor)
    middle[factor // 4 : -(factor // 4), factor // 4 : -(factor // 4)] = 1
    pattern = (middle - middle.mean()) / (middle - middle.mean()).abs().max()
    tiled = pattern.repeat(mean.shape[1], mean.shape[2])
    blocks, rooms = (part.repeat_interleave(factor, 1).repeat_interleave(factor, 2) for part in (mean, room))
    return blocks + rooms * tiled


def framed(picture: Picture, pixels: int) -> Picture:
    """Blackens the outermost px, as undistortion leaves them."""
    out = torch.zeros_like(picture)
    inside = slice(pixels, -pixels)
    out[:, inside, inside] = picture[:, inside, inside]
    return out


def with_floater(picture: Picture, colour: float, radius: float) -> Picture:
    """Lays a soft grey disc over the middle; `radius`: its standard deviation as a share of the height."""
    height, width = picture.shape[1:]
    down, across = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    square = (down - height / 2) ** 2 + (across - width / 2) ** 2
    alpha = 0.95 * torch.exp(-square / (2 * (radius * height) ** 2))
    return picture * (1 - alpha) + colour * alpha
