"""NIQE, explained detail and enlargement against implementations of their own: NumPy in double precision and Pillow."""

import math
from itertools import product

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from gsx.core.quality.metrics import bicubic
from gsx.experiments.evaluation.detail import details_of, explained
from gsx.experiments.evaluation.niqe import Niqe, described, statistics_of

Values = NDArray[np.float64]


def textured(seed: int, height: int, width: int) -> Tensor:
    """Noise on all scales in three colours, in [0, 1]."""
    generator = np.random.default_rng(seed)
    total = np.zeros((3, height, width))
    for octave in range(6):
        noise = generator.random((3, (height >> octave) + 1, (width >> octave) + 1))
        total += 2**octave * np.kron(noise, np.ones((1, 1 << octave, 1 << octave)))[:, :height, :width]
    return torch.from_numpy(total / 64).float()


def resized(plane: Values, width: int, height: int) -> Values:
    """Pillow's bicubic filter on floats."""
    picture = Image.fromarray(plane.astype(np.float32))
    return np.asarray(picture.resize((width, height), Image.Resampling.BICUBIC), dtype=np.float64)


# -- enlargement -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(40, 28), (80, 56), (37, 22), (10, 7)])
def test_the_enlarged_picture_is_that_of_pillow(width: int, height: int) -> None:
    image = textured(1, 14, 20)
    theirs = np.stack([resized(plane, width, height) for plane in image.double().numpy()])
    np.testing.assert_allclose(bicubic(image, width, height).numpy(), theirs.clip(0, 1), atol=2e-6)


# -- explained detail ------------------------------------------------------------------------------------------------


def spectrum(plane: Values) -> Values:
    """Squares of the orthonormal DCT-II, by the sum of cosines in both directions."""
    tables = []
    for size in plane.shape:
        n = np.arange(size)
        table = np.cos(np.pi * np.outer(n, n + 0.5) / size) * math.sqrt(2 / size)
        table[0] /= math.sqrt(2)
        tables.append(table)
    return (tables[0] @ plane @ tables[1].T) ** 2


def energies(picture: Values, zoom: int) -> Values:
    """Sums of squares below the training pixels' Nyquist frequency, up to 1.5 times that, and of all."""
    border = math.ceil(max(8 * zoom, 0.02 * max(picture.shape)))
    inner = picture[:, border:-border, border:-border]
    total = sum(spectrum(plane) for plane in inner)
    down, across = (np.arange(side)[:, None] * zoom / side for side in inner.shape[1:])
    finest = np.maximum(down, across.T)
    return np.array([total[finest < limit].sum() for limit in (1, 1.5, np.inf)]) / inner.size


@pytest.mark.parametrize("zoom", [2, 4])
def test_explained_detail_is_a_ratio_of_sums_over_views(zoom: int) -> None:
    pairs = [(textured(seed, 90, 84), textured(seed, 90, 84)) for seed in (1, 2)]
    pairs = [(0.7 * truth + 0.3 * textured(seed + 7, 90, 84), truth) for seed, (truth, _) in enumerate(pairs)]
    found = explained([details_of({"it": image}, truth, zoom)["it"] for image, truth in pairs])
    differences = sum(energies((image - truth).double().numpy(), zoom) for image, truth in pairs)
    truths = sum(energies(truth.double().numpy(), zoom) for _, truth in pairs)
    assert found["explained"] == pytest.approx(
        1 - (differences[2] - differences[0]) / (truths[2] - truths[0]), abs=1e-4
    )
    assert found["recoverable"] == pytest.approx(
        1 - (differences[1] - differences[0]) / (truths[1] - truths[0]), abs=1e-4
    )
    assert found["psnr_low"] == pytest.approx(-10 * math.log10(differences[0] / 2), abs=1e-3)
    assert found["psnr_high"] == pytest.approx(-10 * math.log10((differences[2] - differences[0]) / 2), abs=1e-3)


# -- NIQE ------------------------------------------------------------------------------------------------------------


def averaged(plane: Values) -> Values:
    """Means of 7 x 7 px with a Gaussian of standard deviation 7/6, borders repeated."""
    places = np.arange(-3, 4)
    weights = np.exp(-(places[:, None] ** 2 + places**2) / (2 * (7 / 6) ** 2))
    windows = sliding_window_view(np.pad(plane, 3, mode="edge"), (7, 7))
    return np.einsum("hwij,ij->hw", windows, weights / weights.sum())


def moment_ratio(shape: float) -> float:
    """(E|x|)^2 / E x^2 of a generalised Gaussian."""
    return math.gamma(2 / shape) ** 2 / (math.gamma(1 / shape) * math.gamma(3 / shape))


def fitted(values: Values) -> tuple[float, float, float]:
    """Shape, left and right scale by moments; the shape by bisection."""
    left = math.sqrt((values[values < 0] ** 2).mean())
    right = math.sqrt((values[values > 0] ** 2).mean())
    skew = left / right
    target = np.abs(values).mean() ** 2 / (values**2).mean() * (skew**3 + 1) * (skew + 1) / (skew**2 + 1) ** 2
    low, high = 0.2, 10.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if moment_ratio(middle) < target else (low, middle)
    scale = math.sqrt(math.gamma(1 / low) / math.gamma(3 / low))
    return low, left * scale, right * scale


def patch_features(patch: Values) -> list[float]:
    """Eighteen numbers of one patch of one scale."""
    shape, left, right = fitted(patch)
    numbers = [shape, (left + right) / 2]
    for down, across in ((0, 1), (1, 0), (1, 1), (-1, 1)):
        shape, left, right = fitted(patch * np.roll(patch, (down, across), (0, 1)))
        numbers += [shape, (right - left) * math.gamma(2 / shape) / math.gamma(1 / shape), left, right]
    return numbers


def features_of(image: Tensor) -> Values:
    """A row of 36 numbers for each patch of 96 px."""
    luma = np.tensordot([0.299, 0.587, 0.114], image.double().numpy(), 1)
    rows, columns = luma.shape[0] // 96, luma.shape[1] // 96
    luma = luma[: 96 * rows, : 96 * columns]
    scales = []
    for plane, edge in ((luma, 96), (resized(luma, 48 * columns, 48 * rows), 48)):
        mean = averaged(255 * plane)
        contrast = np.sqrt(np.abs(averaged((255 * plane) ** 2) - mean**2))
        normalised = (255 * plane - mean) / (contrast + 1)
        places = product(range(rows), range(columns))
        scales.append([patch_features(normalised[edge * y :, edge * x :][:edge, :edge]) for y, x in places])
    return np.concatenate(scales, axis=1)


def test_niqe_has_the_numbers_and_the_distance_of_another_implementation() -> None:
    """Shapes are tabulated in steps of 0.001."""
    pictures = [textured(seed, 200, 300) for seed in range(9)]
    ours, theirs = zip(*((described(image)[0], features_of(image)) for image in pictures), strict=True)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one.numpy(), other, atol=2e-3)
    photos, own = np.concatenate(theirs[1:]), theirs[0]
    pooled = (np.cov(photos.T) + np.cov(own.T)) / 2
    difference = photos.mean(0) - own.mean(0)
    distance = math.sqrt(difference @ np.linalg.solve(pooled, difference))
    metric = Niqe(statistics_of(torch.cat(list(ours[1:]))))
    assert metric.distance(pictures[0]) == pytest.approx(distance, rel=2e-2)
