"""Networks measured in windows of large pictures, whose whole takes seconds on a CPU."""

import math
import statistics
from collections.abc import Iterator, Sequence
from itertools import product

import torch
from torch import Tensor

from gsx.core.shapes import Float
from gsx.experiments.evaluation.feature_distance import FeatureDistance


class WindowedDistance:
    """Perceptual metric: mean distance over the windows of a picture."""

    def __init__(self, network: FeatureDistance, pixels: int) -> None:
        """Takes over a network; `pixels`: largest picture that is measured as a whole, 0: any."""
        self.network, self.pixels, self.least = interleaved(network), pixels, network.least

    def distances(self, images: Sequence[Float[Tensor, "3 H W"]], target: Float[Tensor, "3 H W"]) -> list[float]:
        """Computes the mean distance of each picture from the target over the windows."""
        windows = list(windows_of(target.shape[1], target.shape[2], self.pixels, self.least))
        found = [self.network.distances([image[:, *w] for image in images], target[:, *w]) for w in windows]
        return [statistics.fmean(values) for values in zip(*found, strict=True)]


def interleaved(network: FeatureDistance) -> FeatureDistance:
    """Lays the weights of convolutions out with channels last, with which a CPU needs half the time."""
    for weight in network.stages.parameters():
        if weight.dim() == 4:
            weight.data = weight.data.contiguous(memory_format=torch.channels_last)
    return network


def windows_of(height: int, width: int, pixels: int, least: int) -> Iterator[tuple[slice, slice]]:
    """Yields a whole picture, or the middles of its quarters if it has more pixels, together of so many."""
    if not pixels or height * width <= pixels:
        yield slice(0, height), slice(0, width)
        return
    share = math.sqrt(pixels / (height * width)) / 2
    yield from product(*(middles(side, max(least, round(share * side))) for side in (height, width)))


def middles(side: int, size: int) -> list[slice]:
    """Returns the middles of both halves of a side, of so many pixels each."""
    starts = [min(max(0, round(centre * side - size / 2)), side - size) for centre in (0.25, 0.75)]
    return [slice(start, start + size) for start in starts]
