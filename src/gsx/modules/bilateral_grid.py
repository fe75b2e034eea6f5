"""Low-rank bilateral grid of colour matrices: light that differs within a photo.

A pixel at (x, y) of luma l gains sum_r w_r(x, y, l) M_r [r g b 1]^T: matrices that vary with place and luma, as in Wang
et al. 2024 (Bilateral guided radiance field processing). Ours: the weights w_r are fixed, not learnt (luma, slopes and
bows across and down), since lenses and shadows are smooth and a short run visits a photo a few dozen times; the grids'
mean is removed; slopes start from their estimates.
"""

import math
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float

LUMA = (0.299, 0.587, 0.114)
"""Weights of display values (Rec. 601), as Wang et al."""
RANK = 5
BLOCKS = 6
"""Blocks along each side of an image for the estimate of slopes."""
MIN_BLOCKS, MIN_LINES = 8, 3
"""Fewest blocks for an estimate; fewest rows and columns of them."""
Edges: TypeAlias = tuple[float, float, float, float]
"""Left, top, right, bottom of an image, as shares of its sides."""
WHOLE: Edges = (0.0, 0.0, 1.0, 1.0)


def bow(at: Tensor) -> Tensor:
    """Returns a parabola over [-1, 1] whose mean is 0."""
    return at.square() - 1 / 3


def centres(first: float, last: float, count: int, like: Tensor) -> Float[Tensor, "count"]:
    """Returns the middles of `count` pixels between two shares of a side, which is [-1, 1]."""
    middles = torch.arange(count, device=like.device, dtype=like.dtype) + 0.5
    return 2 * (first + (last - first) * middles / count) - 1


def grid_weights(image: Float[Tensor, "3 H W"], edges: Edges = WHOLE) -> Float[Tensor, "rank H W"]:
    """Returns the weights of the matrices at each pixel: luma in [-1, 1], slopes across and down, bows likewise."""
    left, top, right, bottom = edges
    height, width = image.shape[1:]
    x = centres(left, right, width, image).expand(height, -1)
    y = centres(top, bottom, height, image)[:, None].expand(-1, width)
    luma = 2 * sum(share * channel for share, channel in zip(LUMA, image, strict=True)).clamp(0, 1) - 1
    return torch.stack([luma, x, y, bow(x), bow(y)])


def apply_grid(
    image: Float[Tensor, "3 H W"], matrices: Float[Tensor, "rank 3 4"], edges: Edges = WHOLE
) -> Float[Tensor, "3 H W"]:
    """Applies a photo's grid to an image, or to its part between these edges. Differentiable in both."""
    pixels = torch.cat([image, torch.ones_like(image[:1])]).flatten(1)
    weights, each = grid_weights(image, edges).flatten(1), (matrices.flatten(0, 1) @ pixels).view(RANK, 3, -1)
    return image + (weights[:, None] * each).sum(0).view_as(image)


def initial_grids(slopes: Float[Tensor, "N 2 3"]) -> Float[Tensor, "N rank 3 4"]:
    """Returns matrices with these slopes of log gains, less their mean; 0 for nan."""
    matrices = torch.zeros(len(slopes), RANK, 3, 4)
    matrices[:, 1:3, :, :3] = torch.diag_embed((slopes - slopes.nanmean(0)).nan_to_num(0.0).float())
    return without_common(matrices)


def without_common(matrices: Float[Tensor, "N rank 3 4"]) -> Float[Tensor, "N rank 3 4"]:
    """Returns the matrices less their mean: the common light is the model's."""
    return matrices - matrices.mean(0)


def light_slopes(
    image: Float[Tensor, "3 H W"], photo: Float[Tensor, "3 H W"], usable: Bool[Tensor, "H W"], min_pixels: int
) -> Float[Tensor, "3 2 3"]:
    """Estimates the growth of log(photo / image) of each channel from the middle to the right and to the lower side.

    By all blocks of pixels, by the even and by the odd ones, as on a chessboard: medians of blocks with at least
    `min_pixels` usable pixels. nan where blocks are too few.
    """
    ratios = (photo / image).log()
    rows, columns = (side // BLOCKS for side in image.shape[1:])
    gains, places = list[Tensor](), list[tuple[int, int]]()
    for row in range(BLOCKS):
        for column in range(BLOCKS):
            here = slice(row * rows, (row + 1) * rows), slice(column * columns, (column + 1) * columns)
            if int(usable[here].sum()) >= min_pixels:
                gains.append(ratios[:, *here][:, usable[here]].double().median(1).values.cpu())
                places.append((column, row))
    at = torch.tensor(places, dtype=torch.float64).view(-1, 2)
    found = torch.stack(gains) if gains else at.new_zeros(0, 3)
    even = at.sum(1) % 2 == 0
    size = at.new_tensor([columns / image.shape[2], rows / image.shape[1]])  # pixels left over lie at the far end
    middles = (2 * at + 1) * size - 1
    return torch.stack([fit_slopes(middles[part], found[part]) for part in (torch.ones_like(even), even, ~even)])


def fit_slopes(middles: Float[Tensor, "B 2"], gains: Float[Tensor, "B 3"]) -> Float[Tensor, "2 3"]:
    """Fits slopes across and down, a constant and bows, which absorb errors of an unfinished model; returns the slopes.

    nan for too few blocks, rows or columns.
    """
    lines = min((len(column.unique()) for column in middles.T), default=0)
    if len(gains) < MIN_BLOCKS or lines < MIN_LINES:
        return torch.full((2, 3), math.nan, dtype=torch.float64)
    terms = torch.cat([torch.ones_like(middles[:, :1]), middles, bow(middles)], 1)
    return torch.linalg.lstsq(terms, gains, driver="gelsd").solution[1:3]
