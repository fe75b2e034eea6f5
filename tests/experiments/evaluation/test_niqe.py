"""NIQE: fits against known distributions, values worked by hand, and what makes a picture unlike photos."""

import logging
import math
from dataclasses import replace

import pytest
import torch
from small_scene import small_scene, spread
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from gsx.core.data.camera import Camera
from gsx.experiments.evaluation.niqe import (
    PATCH,
    Niqe,
    PatchStatistics,
    described,
    fit,
    niqe_of,
    normalise,
    product_features,
    sharp_features,
    smoothed,
    statistics_of,
)
from gsx.experiments.evaluation.perceptual import MetricSettings, load_metrics
from gsx.experiments.evaluation.weights import MetricUnavailable


def natural(seed: int, height: int = 2 * PATCH, width: int = 3 * PATCH) -> Tensor:
    """Noise on all scales, as photos have it."""
    generator = torch.Generator().manual_seed(seed)
    octaves = [torch.rand(1, 3, max(2, height >> n), max(2, width >> n), generator=generator) for n in range(7)]
    grown = [2**n * interpolate(octave, (height, width), mode="bilinear") for n, octave in enumerate(octaves)]
    return sum(grown)[0] / 127


@pytest.fixture(scope="module")
def metric() -> Niqe:
    found, patches = niqe_of(natural(seed) for seed in range(20))
    assert 37 <= patches <= 20 * 6
    return found


@pytest.mark.parametrize(
    ("shape", "left", "right"), [(2.0, 1.0, 1.0), (1.0, 1.0, 1.0), (2.0, 0.5, 1.5), (0.8, 2.0, 1.0)]
)
def test_fits_recover_the_distribution_that_values_come_from(shape: float, left: float, right: float) -> None:
    """Values at even quantiles; of |x| / scale, (.)^shape is Gamma(1 / shape), and sides have mass by their scales."""
    count = 20_000
    lower = round(count * left / (left + right))
    sides = [scale * quantiles(shape, n) for scale, n in ((-left, lower), (right, count - lower))]
    values = torch.cat(sides).view(1, 100, -1)
    found = [float(one) for one in fit(values)]
    assert found == pytest.approx([shape, left, right], rel=0.02)
    mean = (right - left) * math.gamma(2 / shape) / math.gamma(1 / shape)
    assert float(product_features(values)[0, 1]) == pytest.approx(mean, abs=0.02)


def quantiles(shape: float, count: int) -> Tensor:
    """Quantiles of a generalised Gaussian's positive side, by its integrated density."""
    places = torch.linspace(0, 60 ** (1 / shape), 400_001, dtype=torch.float64)
    mass = torch.exp(-(places**shape)).cumsum(0)
    wanted = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return places[torch.searchsorted(mass / mass[-1], wanted)]


def test_normalised_luminance_by_hand() -> None:
    """One bright pixel of 255: its window has weight w in the middle, so mean 255 w and contrast 255 sqrt(w - w^2)."""
    levels = torch.zeros(1, 15, 15, dtype=torch.float64)
    levels[0, 7, 7] = 255
    line = [math.exp(-(k**2) / (2 * (7 / 6) ** 2)) for k in range(-3, 4)]
    w = (1 / sum(line)) ** 2
    normalised, contrast = normalise(levels)
    assert float(contrast[0, 7, 7]) == pytest.approx(255 * math.sqrt(w - w**2))
    assert float(normalised[0, 7, 7]) == pytest.approx((255 - 255 * w) / (255 * math.sqrt(w - w**2) + 1))
    assert float(normalised[0, 0, 0]) == 0
    torch.testing.assert_close(smoothed(torch.ones(1, 9, 9)), torch.ones(1, 9, 9))


def test_the_distance_by_hand() -> None:
    """Means 3 apart along the first feature, variances 1 and 3 there: 3 / sqrt(2)."""

    def gaussian(first: float, variance: float) -> PatchStatistics:
        mean, covariance = torch.zeros(36, dtype=torch.float64), torch.eye(36, dtype=torch.float64)
        mean[0], covariance[0, 0] = first, variance
        return PatchStatistics(mean=mean, covariance=covariance)

    assert Niqe(gaussian(0, 1)).between(gaussian(3, 3)) == pytest.approx(3 / math.sqrt(2))
    assert Niqe(gaussian(0, 1)).between(gaussian(0, 1)) == 0


def test_blur_and_noise_are_further_from_photos_than_a_photo(metric: Niqe) -> None:
    photo = natural(99)
    blurred = avg_pool2d(photo, 5, 1, 2)
    noisy = (photo + 0.1 * torch.randn(photo.shape, generator=torch.Generator().manual_seed(1))).clamp(0, 1)
    own, blur, noise = metric.distances([photo, blurred, noisy], photo)
    assert own < blur
    assert own < noise


def test_patches_and_features() -> None:
    """2 x 3 whole patches of 36 features; sharp ones are a part; a flat picture has none and no figure."""
    features, sharpness = described(natural(0, 2 * PATCH + 5, 3 * PATCH + 90))
    assert features.shape == (6, 36)
    assert sharpness.shape == (6,)
    assert 1 <= len(sharp_features(natural(0))) <= 6
    assert len(described(torch.full((3, 200, 200), 0.5))[0]) == 0
    same = Niqe(statistics_of(features))
    assert math.isnan(same.distance(torch.full((3, 200, 200), 0.5)))
    assert same.distance(natural(0, 2 * PATCH + 5, 3 * PATCH + 90)) == pytest.approx(0, abs=1e-6)


class Photo:
    """A natural picture for any camera."""

    def image(self, camera: Camera) -> Tensor:
        return (255 * natural(round(1000 * float(camera.centre[0])) % 1000, *camera.size[::-1])).to(torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1


def test_statistics_come_from_the_scenes_photos(caplog: pytest.LogCaptureFixture) -> None:
    scene = small_scene(spread(10), views=20)
    views = [replace(view, camera=view.camera.resize(2 * PATCH, 3 * PATCH), source=Photo()) for view in scene.train]
    settings = MetricSettings(input_range="unit", pixels=0, device=torch.device("cpu"), photos=views)
    found = load_metrics(["niqe"], settings).metrics["niqe"]
    assert found.provenance["statistics"].endswith("sharp patches of 20 training photos of this scene")
    with caplog.at_level(logging.INFO):
        assert not load_metrics(["niqe"], replace(settings, photos=views[:1])).metrics
    assert "sharp patches of 96 px, it needs 37: train on larger photos" in caplog.text


def test_photos_smaller_than_a_patch_have_none() -> None:
    with pytest.raises(MetricUnavailable, match="have 0 sharp patches"):
        niqe_of([natural(0, 48, 2 * PATCH)])
