"""Distance of two pictures by features of a network: the form that LPIPS and shift-tolerant LPIPS share.

Large pictures, whose whole takes seconds on a CPU, are measured in windows.
"""

import math
import statistics
from collections.abc import Iterator, Sequence
from itertools import product

import torch
from torch import Tensor, nn

from gsx.core.shapes import Float

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""LPIPS input normalisation for values in [-1, 1]."""


class FeatureDistance(nn.Module):
    """Weighted squared differences of unit-normalised features after each stage, averaged over space.

    Source: Zhang et al. 2018, equation 1.
    """

    least = 32
    """Edge of the smallest picture that is measured as a perceptual metric, px."""

    def __init__(self, stages: nn.ModuleList, widths: Sequence[int], signed: bool) -> None:
        """Builds the heads; `widths`: channels after each stage; `signed`: the network gets values in [-1, 1]."""
        super().__init__()
        self.stages, self.signed = stages, signed
        self.heads = nn.ParameterList([torch.zeros(width) for width in widths])

    @property
    def input(self) -> str:
        """Returns the range of values that the network gets."""
        return "[-1,1]" if self.signed else "[0,1]"

    def distance(self, image: Float[Tensor, "3 H W"], target: Float[Tensor, "3 H W"]) -> float:
        """Computes the distance of two pictures with values in [0, 1]."""
        return self.distances([image], target)[0]

    @torch.no_grad()
    def distances(self, images: Sequence[Float[Tensor, "3 H W"]], target: Float[Tensor, "3 H W"]) -> list[float]:
        """Computes the distances of pictures from one target, whose features are computed once."""
        batch = torch.stack([*images, target]).to(self.heads[0])
        features = (batch * 2 - 1 if self.signed else batch) - batch.new_tensor(SHIFT)[:, None, None]
        features = features / batch.new_tensor(SCALE)[:, None, None]
        totals = [0.0] * len(images)
        for stage, head in zip(self.stages, self.heads, strict=True):
            features = stage(features)
            unit = features / (features.norm(dim=1, keepdim=True) + 1e-10)
            for number in range(len(images)):
                difference = (unit[number] - unit[-1]).square_().mul_(head[:, None, None])
                totals[number] += float(difference.sum(0).mean())
        return totals


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
