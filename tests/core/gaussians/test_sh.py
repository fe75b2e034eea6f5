"""Spherical harmonics against numbers worked by hand, associated Legendre functions and quadrature."""

import math

import numpy as np
import pytest
import torch
from compilations import new_code
from numpy.polynomial import Legendre, Polynomial
from torch import Tensor
from torch.nn import Parameter

from gsx.core.backend import EAGER, Backend
from gsx.core.gaussians.sh import BAND_0, colours_of, constant_from_colour, harmonics
from gsx.engine.backend import COMPILED, compiled_kernel
from gsx.engine.compiling import available

R3 = 1 / math.sqrt(3)
HAND_WORKED = {
    (1, 0, 0): {3: -0.488603, 6: -0.315392, 8: 0.546274, 13: 0.457046, 15: -0.590044},
    (-1, 0, 0): {3: 0.488603, 6: -0.315392, 8: 0.546274, 13: -0.457046, 15: 0.590044},
    (0, 1, 0): {1: -0.488603, 6: -0.315392, 8: -0.546274, 9: 0.590044, 11: 0.457046},
    (0, 0, 1): {2: 0.488603, 6: 0.630783, 12: 0.746353},
    (R3, R3, R3): {1: -0.282095, 2: 0.282095, 3: -0.282095, 4: 0.364183, 5: -0.364183, 7: -0.364183}
    | {9: -0.227108, 10: 0.556298, 11: -0.175917, 12: -0.287271, 13: -0.175917, 15: 0.227108},
}


@pytest.mark.parametrize("direction", HAND_WORKED)
def test_table_at_given_directions(direction: tuple[float, float, float]) -> None:
    expected = torch.zeros(15)
    for number, value in HAND_WORKED[direction].items():
        expected[number - 1] = value
    got = harmonics(torch.tensor([direction], dtype=torch.float32), 3)[0]
    torch.testing.assert_close(got, expected, atol=2e-6, rtol=0)


needs_compiler = pytest.mark.skipif(not available(), reason="no working compiler")


def legendre_harmonic(band: int, order: int, directions: np.ndarray) -> np.ndarray:
    """Real Y_lm with the Condon-Shortley sign, from derivatives of the Legendre polynomial."""
    x, y, z = directions.T
    m = abs(order)
    polynomial = Legendre.basis(band).convert(kind=Polynomial)
    derivative = polynomial.deriv(m) if m else polynomial
    associated = (-1) ** m * (1 - z**2) ** (m / 2) * derivative(z)
    norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
    angle = np.arctan2(y, x)
    if order == 0:
        return norm * associated
    return math.sqrt(2) * norm * associated * (np.cos(m * angle) if order > 0 else np.sin(m * angle))


def test_bands_are_the_real_harmonics_with_condon_shortley_signs() -> None:
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    got = harmonics(torch.from_numpy(directions), 3).numpy()
    pairs = [(band, order) for band in (1, 2, 3) for order in range(-band, band + 1)]
    expected = np.stack([legendre_harmonic(band, order, directions) for band, order in pairs], 1)
    np.testing.assert_allclose(got, expected, atol=1e-14)


def test_basis_is_orthonormal_on_the_sphere() -> None:
    heights, weights = np.polynomial.legendre.leggauss(8)  # exact: products are polynomials of degree 6
    angles = 2 * np.pi * np.arange(16) / 16
    z, angle = (grid.ravel() for grid in np.meshgrid(heights, angles, indexing="ij"))
    ring = np.sqrt(1 - z**2)
    directions = torch.from_numpy(np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1))
    area = torch.from_numpy(np.repeat(weights, 16) * 2 * np.pi / 16)
    basis = torch.cat([torch.full((len(z), 1), BAND_0, dtype=torch.float64), harmonics(directions, 3)], 1)
    gram = basis.T @ (area[:, None] * basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-13, rtol=0)


@pytest.mark.parametrize(("degree", "bands"), [(1, 3), (2, 8), (3, 15)])
def test_lower_degrees_are_the_first_bands(degree: int, bands: int) -> None:
    direction = torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, 0.7]]), dim=1)
    assert torch.equal(harmonics(direction, degree), harmonics(direction, 3)[:, :bands])


def coefficients(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    shapes = (9, 1, 3), (9, 15, 3), (9, 3)
    return tuple(torch.randn(shape, generator=g) for shape in shapes)


def test_colour_of_one_splat_worked_by_hand() -> None:
    rest = torch.zeros(1, 15, 3)
    rest[0, 1] = torch.tensor([0.2, -2.0, 4.0])  # k = 2: 0.488603 z
    colour = colours_of(torch.tensor([[[0.1, 0.0, 1.0]]]), rest, torch.tensor([[0.0, 0.0, 7.0]]), 1)
    # 0.5 + 0.282095 * (0.1, 0, 1) + 0.488603 * (0.2, -2, 4): the green is below 0, the blue may pass 1
    torch.testing.assert_close(colour, torch.tensor([[0.625930, 0.0, 2.736507]]), atol=2e-6, rtol=0)


def test_only_the_direction_counts_and_degree_0_ignores_it() -> None:
    constant, rest, offsets = coefficients()
    near, far = (colours_of(constant, rest, offsets * length, 3) for length in (1e-3, 1e4))
    torch.testing.assert_close(near, far, atol=1e-5, rtol=0)
    flat = (0.5 + 0.28209479177387814 * constant[:, 0]).clamp_min(0)
    assert torch.equal(colours_of(constant, rest, offsets, 0), flat)


def test_clamped_channels_get_no_gradient_and_bright_ones_do() -> None:
    constant = torch.tensor([[[-5.0, 0.0, 5.0]]], requires_grad=True)  # colours -0.91, 0.5, 1.91
    rest = torch.zeros(1, 15, 3, requires_grad=True)
    colours_of(constant, rest, torch.tensor([[1.0, 2.0, -1.0]]), 3).sum().backward()
    torch.testing.assert_close(constant.grad, torch.tensor([[[0.0, 0.28209479, 0.28209479]]]))
    assert torch.all(rest.grad[:, :, 0] == 0)
    assert torch.all(rest.grad[:, :, 1:].abs().sum(1) > 0)


@pytest.mark.parametrize(("degree", "bands"), [(1, 3), (2, 8)])
def test_inactive_bands_neither_show_nor_learn(degree: int, bands: int) -> None:
    constant, rest, offsets = coefficients()
    cut = rest.clone()
    cut[:, bands:] = 0
    rest.requires_grad_()
    colours = colours_of(constant, rest, offsets, degree)
    torch.testing.assert_close(colours, colours_of(constant, cut, offsets, 3))
    colours.sum().backward()
    assert torch.all(rest.grad[:, bands:] == 0)
    assert torch.any(rest.grad[:, :bands] != 0)


def test_constant_band_of_a_colour() -> None:
    colour = torch.tensor([[0.0, 0.5, 1.0]])
    constant = constant_from_colour(colour)
    torch.testing.assert_close(constant, torch.tensor([[-1.7724539, 0.0, 1.7724539]]))
    shown = colours_of(constant[:, None], torch.zeros(1, 15, 3), torch.ones(1, 3), 0)
    torch.testing.assert_close(shown, colour)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_gradient_is_that_of_finite_differences(degree: int) -> None:
    generator = torch.Generator().manual_seed(degree)
    constant, rest, offsets = (
        torch.randn(shape, generator=generator, dtype=torch.float64, requires_grad=True)
        for shape in ((5, 1, 3), (5, 15, 3), (5, 3))
    )
    assert torch.autograd.gradcheck(lambda c, *a: colours_of(c + 30, *a, degree), (constant, rest, offsets))  # above 0


@pytest.mark.parametrize("backend", [EAGER, pytest.param(COMPILED, marks=needs_compiler)])
def test_a_splat_at_the_camera_has_a_finite_gradient(backend: Backend) -> None:
    constant, rest, offsets = coefficients()
    offsets[4] = 0
    constant, rest, offsets = (value.requires_grad_() for value in (constant, rest, offsets))
    colours_of(constant, rest, offsets, 3, backend).sum().backward()
    assert offsets.grad is not None
    assert torch.isfinite(offsets.grad).all()


@needs_compiler
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_compiled_colours_and_their_gradients_are_the_eager_ones(degree: int) -> None:
    found = []
    for backend in (EAGER, COMPILED):
        leaves = [value.clone().requires_grad_() for value in coefficients(seed=3)]
        colours = colours_of(*leaves, degree, backend)
        (colours * torch.linspace(0.5, 2, 27).view(9, 3)).sum().backward()
        found.append([colours.detach(), *(leaf.grad for leaf in leaves)])
    for eager, fast in zip(*found, strict=True):
        torch.testing.assert_close(fast, eager, rtol=1e-5, atol=1e-5)


@needs_compiler
def test_colours_of_parameters_compile_once_whatever_their_number() -> None:
    """Density control replaces parameters by others of another size at every event."""

    def learn(count: int) -> None:
        generator = torch.Generator().manual_seed(count)
        sizes = ((count, 1, 3), (count, 15, 3), (count, 3))
        constant, rest, offsets = (Parameter(torch.randn(size, generator=generator)) for size in sizes)
        colours_of(constant, rest, offsets, 3, COMPILED).sum().backward()
        assert rest.grad is not None

    compiled_kernel.cache_clear()
    with new_code() as first:
        learn(9)
    assert "contraction" in first
    with new_code() as later:
        for count in (14, 40, 23):
            learn(count)
    assert later == []
