"""Distance of two pictures by features of a network: the form that LPIPS and shift-tolerant LPIPS share."""

from collections.abc import Sequence

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
