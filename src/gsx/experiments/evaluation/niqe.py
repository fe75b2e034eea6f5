"""NIQE (Mittal, Soundararajan and Bovik 2013): how unlike photos a picture is, without a reference.

Patches are described by how their normalised luminance and its products with neighbours are distributed. The figure is
the distance between a picture's patches and the sharp patches of photos. The paper's photos come with no licence, so
gsx takes the scene's training photos: figures are comparable within a scene, not with published ones.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from gsx.core.quality.metrics import bicubic
from gsx.core.shapes import Float
from gsx.experiments.evaluation.weights import MetricUnavailable

PATCH = 96
"""Edge of a patch, px; half of it at the coarse scale."""
LUMA = (0.299, 0.587, 0.114)
"""Weights of display red, green and blue in luminance (ITU-R BT.601)."""
WINDOW, DEVIATION = 7, 7 / 6
"""Edge and standard deviation of the Gaussian window, px."""
SHARP = 0.75
"""Photos' patches below this share of the sharpest patch of their photo are left out."""
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (-1, 1))
"""Shifts (down, across) of the products."""
SHAPES = (0.2, 10.0, 0.001)
"""First, last and step of the tabulated shape parameters."""
FEATURES = 36
"""Two scales of two parameters of the luminance, and four of each product."""
LEAST_PATCHES = FEATURES + 1
"""Sharp patches of photos below which their covariance has no full rank."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PatchStatistics:
    """Gaussian of patches' features, in float64."""

    mean: Float[Tensor, "F"]
    covariance: Float[Tensor, "F F"]


class Niqe:
    """Distance of a picture's patches from those of photos; lower is closer."""

    least = PATCH
    """Edge of the smallest picture that is measured, px."""

    def __init__(self, photos: PatchStatistics) -> None:
        self.photos = photos

    def distances(self, images: Sequence[Float[Tensor, "3 H W"]], target: Float[Tensor, "3 H W"]) -> list[float]:
        """Computes NIQE of each picture; the target does not matter. NaN: fewer than two patches have structure."""
        return [self.distance(image) for image in images]

    def distance(self, image: Float[Tensor, "3 H W"]) -> float:
        """Computes NIQE of a picture with values in [0, 1]."""
        features, _ = described(image)
        if len(features) < 2:
            return math.nan
        return self.between(statistics_of(features))

    def between(self, other: PatchStatistics) -> float:
        """Computes the distance of patches' statistics from those of photos."""
        difference = self.photos.mean - other.mean
        pooled = (self.photos.covariance + other.covariance) / 2
        return math.sqrt(max(0.0, float(difference @ torch.linalg.pinv(pooled, hermitian=True) @ difference)))


def niqe_of(photos: Iterable[Float[Tensor, "3 H W"]]) -> tuple[Niqe, int]:
    """Builds the metric from photos; returns it and the number of their sharp patches.

    Raises:
        MetricUnavailable: they have too few.
    """
    features = torch.cat([torch.zeros(0, FEATURES, dtype=torch.float64), *map(sharp_features, photos)])
    if len(features) < LEAST_PATCHES:
        raise MetricUnavailable(
            f"the training photos have {len(features)} sharp patches of {PATCH} px, it needs {LEAST_PATCHES}: "
            "train on larger photos"
        )
    return Niqe(statistics_of(features)), len(features)


def sharp_features(photo: Float[Tensor, "3 H W"]) -> Float[Tensor, "P F"]:
    """Describes the sharp patches of a photo; none of one smaller than a patch."""
    if min(photo.shape[1:]) < PATCH:
        return torch.zeros(0, FEATURES, dtype=torch.float64)
    features, sharpness = described(photo)
    return features[sharpness > SHARP * sharpness.max()] if len(features) else features


def statistics_of(features: Float[Tensor, "P F"]) -> PatchStatistics:
    """Returns mean and covariance over patches."""
    return PatchStatistics(mean=features.mean(0), covariance=torch.cov(features.mT))


def described(image: Float[Tensor, "3 H W"]) -> tuple[Float[Tensor, "P F"], Float[Tensor, "P"]]:
    """Returns features and sharpness of the patches that have structure at both scales."""
    luma = luminance(image)
    coarse = bicubic(luma, luma.shape[2] // 2, luma.shape[1] // 2)
    (fine, sharpness), (half, _) = (scale_features(one, edge) for one, edge in ((luma, PATCH), (coarse, PATCH // 2)))
    features = torch.cat([fine, half], 1)
    known = features.isfinite().all(1)
    return features[known], sharpness[known]


def luminance(image: Float[Tensor, "3 H W"]) -> Float[Tensor, "1 H W"]:
    """Returns luminance in [0, 1], cut to whole patches."""
    height, width = (side // PATCH * PATCH for side in image.shape[1:])
    return (image[:, :height, :width].double() * image.new_tensor(LUMA)[:, None, None]).sum(0, keepdim=True)


def scale_features(luma: Float[Tensor, "1 H W"], edge: int) -> tuple[Float[Tensor, "P f"], Float[Tensor, "P"]]:
    """Describes patches of one scale; also returns their mean local contrast, in levels of 255."""
    normalised, contrast = normalise(255 * luma)
    patches = patches_of(normalised, edge)
    products = [patches * patches.roll(shift, (1, 2)) for shift in NEIGHBOURS]
    shape, left, right = fit(patches)
    features = [torch.stack([shape, (left + right) / 2], 1), *map(product_features, products)]
    return torch.cat(features, 1), patches_of(contrast, edge).mean((1, 2))


def normalise(levels: Float[Tensor, "1 H W"]) -> tuple[Float[Tensor, "1 H W"], Float[Tensor, "1 H W"]]:
    """Subtracts the local mean and divides by the local contrast plus one level; also returns the contrast."""
    mean = smoothed(levels)
    contrast = (smoothed(levels.square()) - mean.square()).abs().sqrt()
    return (levels - mean) / (contrast + 1), contrast


def smoothed(levels: Float[Tensor, "1 H W"]) -> Float[Tensor, "1 H W"]:
    """Averages over the Gaussian window, with repeated borders."""
    places = torch.arange(WINDOW, dtype=levels.dtype) - WINDOW // 2
    line = torch.exp(-(places**2) / (2 * DEVIATION**2))
    line = (line / line.sum()).to(levels)
    wide = pad(levels[None], [WINDOW // 2] * 4, "replicate")
    return conv2d(conv2d(wide, line.view(1, 1, -1, 1)), line.view(1, 1, 1, -1))[0]


def patches_of(picture: Float[Tensor, "1 H W"], edge: int) -> Float[Tensor, "P e e"]:
    """Cuts a picture into patches."""
    return picture[0].unfold(0, edge, edge).unfold(1, edge, edge).reshape(-1, edge, edge)


def product_features(patches: Float[Tensor, "P e e"]) -> Float[Tensor, "P 4"]:
    """Returns shape, mean, and both scales of the fitted distribution."""
    shape, left, right = fit(patches)
    mean = (right - left) * torch.exp(torch.lgamma(2 / shape) - torch.lgamma(1 / shape))
    return torch.stack([shape, mean, left, right], 1)


def fit(patches: Float[Tensor, "P e e"]) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Fits asymmetric generalised Gaussians by moments; returns shape, left and right scale of each patch.

    NaN or infinite where a patch has values of one sign only.

    Source: Lasmar, Stitou and Berthoumieu 2009.
    """
    values = patches.flatten(1)
    sides = (values < 0, values > 0)
    left, right = (((values.square() * side).sum(1) / side.sum(1)).sqrt() for side in sides)  # root mean squares
    ratio = left / right
    ratio_of_moments = values.abs().mean(1).square() / values.square().mean(1)
    target = ratio_of_moments * (ratio**3 + 1) * (ratio + 1) / (ratio**2 + 1).square()
    shapes, moments = (table.to(values) for table in shape_table())
    shape = shapes[(moments - target[:, None]).abs().argmin(1)]
    scale = torch.exp((torch.lgamma(1 / shape) - torch.lgamma(3 / shape)) / 2)
    return shape, left * scale, right * scale


@cache
def shape_table() -> tuple[Tensor, Tensor]:
    """Tabulates (E|x|)^2 / E x^2 of a generalised Gaussian by its shape."""
    first, last, step = SHAPES
    shapes = torch.arange(first, last, step, dtype=torch.float64)
    log = 2 * torch.lgamma(2 / shapes) - torch.lgamma(1 / shapes) - torch.lgamma(3 / shapes)
    return shapes, torch.exp(log)
