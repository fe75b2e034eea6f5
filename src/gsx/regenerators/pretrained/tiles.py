"""Large pictures through a network in parts that overlap."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Picture: TypeAlias = npt.NDArray[np.float32]
"""[3, h, w], display values."""
Network: TypeAlias = Callable[[Picture], Picture]


def run_in_tiles(network: Network, image: Picture, scale: int, tile: int, border: int) -> Picture:
    """Runs a network on parts of a picture and joins the results.

    Args:
        network: Function that makes pictures `scale` times as large.
        tile: Largest side of a part, px.
        border: Pixels around each part that are cut off again; at the rim of the picture they are its reflection.

    Returns:
        Picture [3, scale h, scale w].
    """
    _, height, width = image.shape
    padded = reflected(image, border)
    out = np.empty((3, scale * height, scale * width), np.float32)
    for rows in spans(height, tile):
        for columns in spans(width, tile):
            part = padded[:, rows.start : rows.stop + 2 * border, columns.start : columns.stop + 2 * border]
            result = network(np.ascontiguousarray(part))
            out[:, scaled(rows, scale), scaled(columns, scale)] = inner(result, scale * border)
    return out


def spans(size: int, tile: int) -> Iterator[slice]:
    """Yields the fewest parts of a side, of `tile` px at most and alike in length."""
    count = -(-size // tile)
    edges = [size * part // count for part in range(count + 1)]
    yield from (slice(start, stop) for start, stop in pairwise(edges))


def scaled(span: slice, scale: int) -> slice:
    """Returns the pixels of the result for those of the input."""
    return slice(scale * span.start, scale * span.stop)


def reflected(image: Picture, border: int) -> Picture:
    """Pads a picture by its reflection; a side of one pixel is repeated."""
    return np.pad(image, ((0, 0), (border, border), (border, border)), "reflect")


def inner(image: Picture, border: int) -> Picture:
    """Cuts a border off."""
    return image[:, border : image.shape[1] - border, border : image.shape[2] - border]
