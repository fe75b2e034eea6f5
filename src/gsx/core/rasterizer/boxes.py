"""Tiles that splats reach: bounding boxes, and spans of columns on each row. Nothing here is differentiated.

Vectors are columns (see geometry.py); a box is (first, past-the-last) tile along an axis.
"""

import math

import torch
from torch import Tensor

from gsx.core.rasterizer.settings import CUTOFF_SLACK, WINDOW_TILE
from gsx.core.shapes import Float, Int

FAR = 1 << 20
"""Bound of pixel and tile indices, beyond any raster; keeps integers in range."""


def three_sigma(xx: Float[Tensor, "M"], xy: Float[Tensor, "M"], yy: Float[Tensor, "M"]) -> Float[Tensor, "M"]:
    """Returns 3 sqrt(lambda_max) of covariances, with the published floor of 0.1 in the root (3D-GS, forward.cu)."""
    half = (xx - yy) / 2
    return 3 * ((xx + yy) / 2 + (half * half + xy * xy).clamp_min(0.1).sqrt()).sqrt()


def window(
    mean: Float[Tensor, "M"], radius: Float[Tensor, "M"], tiles: Int[Tensor, ""]
) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"]]:
    """Returns first and past-the-last pixel of a splat's published 16 px tiles along an axis (3D-GS, forward.cu).

    `tiles`: number of such tiles on the frame.
    """
    corner = mean - 0.5  # the published mean is relative to integer pixel positions
    edges = (corner - radius, corner + radius + (WINDOW_TILE - 1))
    first, last = ((edge / WINDOW_TILE).nan_to_num().clamp(0, FAR).int().minimum(tiles) for edge in edges)
    return WINDOW_TILE * first, WINDOW_TILE * last


def touched(edge: Float[Tensor, "*M"], tile: int, past: bool = False) -> Int[Tensor, "*M"]:
    """Returns the tile of the first pixel centre >= `edge`; `past`: one past the tile of the last centre <= `edge`."""
    pixel = (edge - 0.5).floor() if past else (edge - 0.5).ceil()
    return (pixel / tile).floor().clamp(-FAR, FAR).nan_to_num().int() + int(past)


def box(
    mean: Float[Tensor, "M"],
    variance: Float[Tensor, "M"],
    limit: Float[Tensor, "M"],
    begin: Int[Tensor, ""],
    end: Int[Tensor, ""],
    tile: int,
    reach: float,
) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"]]:
    """Returns first and past-the-last tile of a splat's bounding box along an axis, on the frame, inside the raster."""
    half = (2 * limit.clamp_min(0) * variance).sqrt() + reach
    first = touched(mean - half, tile).maximum(begin)
    last = touched(mean + half, tile, past=True).minimum(end)
    return first, torch.where(limit >= 0, last, first).maximum(first)


def boxes(
    means: Float[Tensor, "M 2"],
    covariances: Float[Tensor, "M 3"],
    log_opacities: Float[Tensor, "M"],
    raster: Int[Tensor, "2 5"],
    alpha_min: float,
    tile: int,
    reach: float,
    windowed: bool,
) -> tuple[
    Int[Tensor, "M"], Int[Tensor, "M"], Int[Tensor, "M"], Int[Tensor, "M"], Int[Tensor, "M"], Float[Tensor, "M"]
]:
    """Returns first column and row, past-the-last column and row, published radius or 0, and limit of s^2 + r^2.

    `raster` holds for each axis: 16 px tiles of the frame, first and past-the-last pixel and tile of the raster.
    `windowed`: a splat reaches only the 16 px tiles of its 3-sigma square.
    """
    (xx, xy, yy), limit = covariances.unbind(1), log_opacities - math.log(alpha_min) + CUTOFF_SLACK
    radius, edges = three_sigma(xx, xy, yy).ceil(), []
    visible = torch.ones_like(radius, dtype=torch.bool)
    for mean, variance, numbers in zip(means.unbind(1), (xx, yy), raster.unbind(), strict=True):
        tiles, first_pixel, past_pixel, begin, end = numbers.unbind()
        first, last = box(mean, variance, limit, begin, end, tile, reach)
        left, right = window(mean, radius, tiles)
        if windowed:
            first = first.maximum(left // tile)
            last = last.minimum(right // tile).maximum(first)
        visible = visible & (right.minimum(past_pixel) > left.maximum(first_pixel))
        edges.append((first, last))
    radii = torch.where(visible, radius, 0.0).nan_to_num().clamp_max(FAR).int()
    (first_column, last_column), (first_row, last_row) = edges
    return first_column, first_row, last_column, last_row, radii, limit


def row_spans(
    mean_x: Float[Tensor, "R"],
    mean_y: Float[Tensor, "R"],
    factor: tuple[Float[Tensor, "R"], Float[Tensor, "R"], Float[Tensor, "R"]],
    limit: Float[Tensor, "R"],
    row: Int[Tensor, "R"],
    tile: int,
    reach: float = 0.0,
) -> tuple[Int[Tensor, "R"], Int[Tensor, "R"]]:
    """Returns first and past-the-last column, of the frame, where s^2 + r^2 <= limit within `reach` px of a tile row.

    Exact: the part of an ellipse between two lines is convex, so its tiles on the row are those of its x-interval.
    """
    u0, u1, u2 = factor
    top = row * tile + (0.5 - reach) - mean_y
    height = limit.sqrt() / u2
    low, high = top.maximum(-height), (top + (tile - 1 + 2 * reach)).minimum(height)
    rightmost = -u1 * height * torch.rsqrt(u1 * u1 + u2 * u2)

    def half_width(y: Tensor) -> Tensor:
        return (limit - (u2 * y).square()).clamp_min(0).sqrt()

    at_right, at_left = rightmost.maximum(low).minimum(high), (-rightmost).maximum(low).minimum(high)
    right = mean_x + (half_width(at_right) - u1 * at_right) / u0
    left = mean_x - (half_width(at_left) + u1 * at_left) / u0
    first, last = touched(left - reach, tile), touched(right + reach, tile, past=True)
    return first, torch.where(low <= high, last, first)


def spans(
    rank: Int[Tensor, "R"],
    shapes: Float[Tensor, "V 6"],
    sides: Int[Tensor, "V 3"],
    starts: Int[Tensor, "V"],
    tile: int,
    reach: float,
) -> tuple[Int[Tensor, "R"], Int[Tensor, "R"], Int[Tensor, "R"]]:
    """Returns tile row, first column and number of columns of each row of tiles of V splats.

    `rank`: splat of each row; `shapes`: mean x, mean y, u0, u1, u2, limit; `sides`: first row, first and past-the-last
    column; `starts`: index of each splat's first row.
    """
    mean_x, mean_y, u0, u1, u2, limit = (column[rank] for column in shapes.unbind(1))
    top, left, right = (column[rank] for column in sides.unbind(1))
    place = torch.arange(rank.shape[0], device=rank.device)
    row = top + (place - starts[rank]).int()
    begin, end = row_spans(mean_x, mean_y, (u0, u1, u2), limit, row, tile, reach)
    begin, end = begin.maximum(left), end.minimum(right)
    return row, begin, (end - begin).clamp_min(0)
