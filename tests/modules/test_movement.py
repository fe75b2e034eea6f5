"""Pictures of moving cameras: against means worked by hand, and of pictures shifted one by one."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from gsx.modules.motion_blur import DAMPING, SharpenedBlur, line_kernel, motion_blurred, sharpened


def shifted(image: Tensor, across: float, down: float) -> Tensor:
    """The picture moved to the right and down by bilinear interpolation, its edges held."""
    height, width = image.shape[1:]
    x, y = (torch.arange(side, dtype=torch.float64) for side in (width, height))
    u, v = 2 * (x - across) / (width - 1) - 1, 2 * (y - down) / (height - 1) - 1
    grid = torch.stack([u.expand(height, -1), v[:, None].expand(-1, width)], 2)
    return grid_sample(image[None], grid[None], padding_mode="border", align_corners=True)[0]


def test_kernels_by_hand() -> None:
    """A point between pixels is shared out by its distances: the mean over 2 px is a quarter, a half, a quarter."""
    assert torch.equal(line_kernel(2.0, 0.0)[1], torch.tensor([0.25, 0.5, 0.25], dtype=torch.float64))
    assert torch.equal(line_kernel(0.0, 2.0)[:, 1], line_kernel(2.0, 0.0)[1])
    assert torch.equal(line_kernel(0.0, 0.0), torch.ones(1, 1, dtype=torch.float64))


@pytest.mark.parametrize("movement", [(3.0, 0.0), (-4.5, 2.0), (0.3, -0.2), (7.0, 11.0)])
def test_kernels_are_means_without_a_direction(movement: tuple[float, float]) -> None:
    kernel = line_kernel(*movement)
    assert float(kernel.sum()) == pytest.approx(1, abs=1e-12)
    assert torch.allclose(kernel, kernel.flip(0, 1), atol=1e-12)
    assert torch.allclose(kernel, line_kernel(-movement[0], -movement[1]), atol=1e-12)


@pytest.mark.parametrize("movement", [(5.0, 0.0), (-3.0, 4.0)])
def test_it_is_the_mean_of_shifted_pictures(movement: tuple[float, float]) -> None:
    image = torch.rand(3, 24, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    places = (torch.arange(500) + 0.5) / 500 - 0.5
    truth = torch.stack([shifted(image, *(float(t) * part for part in movement)) for t in places]).mean(0)
    assert (motion_blurred(image, *movement) - truth).abs().max() < 0.01
    assert (motion_blurred(image, *movement) - image).abs().max() > 0.2


def test_gradients_come_back_the_same_way() -> None:
    """A mean without a direction is its own transpose, but for what the edges hold."""
    image = torch.zeros(1, 21, 21, dtype=torch.float64, requires_grad=True)
    pulled = pad(torch.ones(1, 1, 1, dtype=torch.float64), (10, 10, 10, 10))
    motion_blurred(image, 3.0, 2.0).backward(pulled)
    assert torch.allclose(image.grad, motion_blurred(pulled, 3.0, 2.0), atol=1e-12)


@pytest.mark.parametrize("movement", [(0.0, 0.0), (3.0, 2.0), (-6.0, 1.0)])
def test_sharpened_gradients_solve_their_equations(movement: tuple[float, float]) -> None:
    """Those of all pixels at once, around a gradient in the middle; and they go down."""
    gradient = pad(torch.randn(1, 5, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64), (22,) * 4)
    mean = motion_blurred(torch.eye(49**2, dtype=torch.float64).view(-1, 49, 49), *movement).flatten(1).T
    equations = mean.T @ mean + DAMPING * torch.eye(49**2, dtype=torch.float64)
    slope = mean.T @ gradient.flatten()
    truth = (1 + DAMPING) * torch.linalg.solve(equations, slope).view(49, 49)
    found = sharpened(gradient, *movement)[0]
    assert (found - truth)[16:-16, 16:-16].abs().max() < 1e-3 * truth.abs().max()
    assert float(found.flatten() @ slope) > 0


def test_what_is_beyond_an_edge_pulls_at_nothing() -> None:
    """A gradient in the last column moves the first ones as it does far from every edge: not at all."""
    gradient = torch.zeros(1, 24, 32, dtype=torch.float64)
    gradient[:, :, -1] = torch.randn(24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found, alone = sharpened(gradient, 2.0, 0.0), sharpened(pad(gradient, (300, 300, 300, 300)), 2.0, 0.0)
    assert (found - alone[:, 300:-300, 300:-300]).abs().max() < 1e-3 * found.abs().max()


def error_after(steps: int, blur: Callable[[Tensor, float, float], Tensor]) -> float:
    """Of a picture that is learnt from a blurred one by going down the gradient, from grey on."""
    truth = torch.rand(1, 24, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    photograph, image = motion_blurred(truth, 3.0, 2.0), torch.full_like(truth, 0.5)
    assert torch.equal(blur(truth, 3.0, 2.0), photograph)
    for _ in range(steps):
        image.requires_grad_()
        [slope] = torch.autograd.grad((blur(image, 3.0, 2.0) - photograph).square().sum() / 2, image)
        image = (image - slope).detach()
    return float((image - truth).square().mean().sqrt())


def test_a_sharp_picture_is_learnt_from_a_blurred_one_in_a_fifth_of_the_steps() -> None:
    assert error_after(10, SharpenedBlur.apply) < error_after(50, motion_blurred)
