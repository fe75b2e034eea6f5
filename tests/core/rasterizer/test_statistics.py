"""The absolute gradient against per-pixel Jacobians of the truth, and sums that come out the same every time."""

import hashlib
from functools import cache
from inspect import getsource

import pytest
import torch
from raster_scenes import changed, front_camera, leaves, random_splats, render_with_gradients, run_script
from reference_rasterizer import alpha_maps, frame_pixels

from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize


def scene_of(seed: int) -> tuple[Splats, torch.Tensor]:
    """(splats, weights of a picture)."""
    weights = torch.randn(3, 52, 70, generator=torch.Generator().manual_seed(seed)).double()
    return changed(random_splats(60, seed), dtype=torch.float64), weights


@cache
def brute_force(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(gradient of every screen mean, its absolute values added up over pixels, rows), from the reference's alphas.

    The derivative of a splat's alpha by its mean is minus that by the pixel's position.
    """
    (splats, weights), rules, camera = scene_of(seed), RasterSettings(cull="tight"), front_camera()
    xy = frame_pixels(camera).requires_grad_()
    alpha, rows = alpha_maps(splats, camera, rules, xy)
    by_mean = torch.stack([-torch.autograd.grad(map.sum(), xy, retain_graph=True)[0] for map in alpha])
    live = alpha.detach().requires_grad_()
    after = torch.cumprod(1 - live, 0)
    weight = live * torch.cat([torch.ones_like(after[:1]), after[:-1]]) * (after >= rules.transmittance_stop)
    (torch.einsum("nhw,nc->chw", weight, splats.colours[rows]) * weights).sum().backward()
    terms = live.grad[..., None] * by_mean
    return terms.sum((1, 2)), terms.abs().sum((1, 2)), rows


@pytest.mark.parametrize("seed", range(3))
def test_absolute_gradient_is_that_of_every_pixel_of_the_truth(seed: int) -> None:
    splats, weights = scene_of(seed)
    signed, absolute, rows = brute_force(seed)
    rules = RasterSettings(cull="tight")
    rendering = rasterize(leaves(splats), front_camera(), rules, absolute_gradient=True)
    (rendering.image * weights).sum().backward()
    screen = rendering.screen
    truth = torch.zeros(2, len(splats), 2, dtype=torch.float64)
    truth[:, rows] = torch.stack([signed, absolute])
    assert torch.allclose(screen.means2d_offset.grad, truth[0, screen.ids], rtol=1e-9, atol=1e-10)
    assert torch.allclose(screen.absgrad.grad, truth[1, screen.ids], rtol=1e-9, atol=1e-10)
    assert float(screen.absgrad.grad.sum()) > 3 * float(screen.means2d_offset.grad.abs().sum())  # the two do differ


def bits() -> list[list[str]]:
    """Of a picture and its gradients, twice with one thread and twice with two."""
    found, usual = [], torch.get_num_threads()
    for threads in (1, 1, 2, 2):
        torch.set_num_threads(threads)
        rendering, slopes = render_with_gradients(random_splats(800), front_camera(160, 120), RasterSettings())
        values = [rendering.image.detach(), *slopes.values()]
        found.append([hashlib.sha256(value.contiguous().numpy().tobytes()).hexdigest() for value in values])
    torch.set_num_threads(usual)
    return found


OTHER_PROCESS = f"""
import hashlib, json, torch
from raster_scenes import front_camera, random_splats, render_with_gradients
from gsx.core.rasterizer import RasterSettings
{getsource(bits)}
print(json.dumps(bits()))
"""


def test_pictures_and_gradients_are_the_same_bits_in_every_run_with_one_thread_and_with_two() -> None:
    here, there = bits(), run_script(OTHER_PROCESS)
    for first in (0, 2):  # with one thread, with two
        pictures = [*here[first : first + 2], *there[first : first + 2]]
        assert all(picture == pictures[0] for picture in pictures), first
