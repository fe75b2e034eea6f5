"""Light that differs within a photo: a bilateral grid of colour matrices, of low rank.

A pixel at (x, y) of luma l gains sum_r w_r(x, y, l) M_r [r g b 1]^T: matrices that vary with place and luma, as in Wang
et al. 2024 (Bilateral guided radiance field processing). Ours: the weights w_r are given, not learnt (luma, slopes and
bows across and down): what lenses and shadows do is smooth, a photo is shown a few dozen times in a short run, and
what all photographs have in common can be taken from them again. Slopes begin as photographs and renders say; whether
there are any is judged first.
"""

import math

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float

LUMA = (0.299, 0.587, 0.114)
"""Of display values (Rec. 601), as Wang et al."""
RANK = 5
BLOCKS = 6
"""Along each side of a picture: what is told of its light, block by block."""
MIN_BLOCKS, MIN_LINES = 8, 3
"""That tell slopes; rows and columns that these lie in."""
WHOLE = (0.0, 0.0, 1.0, 1.0)
"""Left, top, right, bottom of a picture, as shares of its sides."""


def bow(at: Tensor) -> Tensor:
    """A parabola over [-1, 1] whose mean is 0."""
    return at.square() - 1 / 3


def centres(first: float, last: float, count: int, like: Tensor) -> Float[Tensor, "count"]:
    """Middles of so many pixels between two shares of a side, which is [-1, 1]."""
    middles = torch.arange(count, device=like.device, dtype=like.dtype) + 0.5
    return 2 * (first + (last - first) * middles / count) - 1


def grid_weights(
    image: Float[Tensor, "3 H W"], edges: tuple[float, float, float, float] = WHOLE
) -> Float[Tensor, "rank H W"]:
    """Weights of the matrices at each pixel: luma in [-1, 1], slope across, slope down, bow across, bow down."""
    left, top, right, bottom = edges
    height, width = image.shape[1:]
    x = centres(left, right, width, image).expand(height, -1)
    y = centres(top, bottom, height, image)[:, None].expand(-1, width)
    luma = 2 * sum(share * channel for share, channel in zip(LUMA, image, strict=True)).clamp(0, 1) - 1
    return torch.stack([luma, x, y, bow(x), bow(y)])


def apply_grid(
    image: Float[Tensor, "3 H W"],
    matrices: Float[Tensor, "rank 3 4"],
    edges: tuple[float, float, float, float] = WHOLE,
) -> Float[Tensor, "3 H W"]:
    """A picture, or the part of one between these edges, by a photo's light. Differentiable in both."""
    pixels = torch.cat([image, torch.ones_like(image[:1])]).flatten(1)
    weights, each = grid_weights(image, edges).flatten(1), (matrices.flatten(0, 1) @ pixels).view(RANK, 3, -1)
    return image + (weights[:, None] * each).sum(0).view_as(image)


def initial_grids(slopes: Float[Tensor, "N 2 3"]) -> Float[Tensor, "N rank 3 4"]:
    """Matrices of photographs whose channels have such slopes of log gains, less what they have in common; zero where
    these are nan."""
    matrices = torch.zeros(len(slopes), RANK, 3, 4)
    matrices[:, 1:3, :, :3] = torch.diag_embed((slopes - slopes.nanmean(0)).nan_to_num(0.0).float())
    return without_common(matrices)


def without_common(matrices: Float[Tensor, "N rank 3 4"]) -> Float[Tensor, "N rank 3 4"]:
    """Matrices of mean zero: what all photographs have in common is the model's."""
    return matrices - matrices.mean(0)


# -- what photographs and renders say ----------------------------------------------------------------------------------


def light_slopes(
    image: Float[Tensor, "3 H W"],
    photo: Float[Tensor, "3 H W"],
    usable: Bool[Tensor, "H W"],
    min_pixels: int,
) -> Float[Tensor, "3 2 3"]:
    """By how much log(photo / image) of each channel grows from the middle of a picture to its right side and to
    its lower one: told by all blocks of pixels, by the even ones, and by the odd ones, as on a chessboard; nan where
    too few tell. Medians of blocks in which at least so many pixels tell something."""
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
    size = at.new_tensor([columns / image.shape[2], rows / image.shape[1]])  # what no block holds is at the far end
    middles = (2 * at + 1) * size - 1
    return torch.stack([fit_slopes(middles[part], found[part]) for part in (torch.ones_like(even), even, ~even)])


def fit_slopes(middles: Float[Tensor, "B 2"], gains: Float[Tensor, "B 3"]) -> Float[Tensor, "2 3"]:
    """Slopes across and down by least squares, beside a constant and bows, which an unfinished model shows where there
    are none; nan where too few blocks tell, or these lie in too few rows or columns."""
    lines = min((len(column.unique()) for column in middles.T), default=0)
    if len(gains) < MIN_BLOCKS or lines < MIN_LINES:
        return torch.full((2, 3), math.nan, dtype=torch.float64)
    terms = torch.cat([torch.ones_like(middles[:, :1]), middles, bow(middles)], 1)
    return torch.linalg.lstsq(terms, gains, driver="gelsd").solution[1:3]
