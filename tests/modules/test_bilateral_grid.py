"""Light within photographs: told where it differs, absent where it does not, learnt, and placed in windows."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from module_contexts import build_module
from tiny import same_ending, stopped_at, tiny_run
from torch import Tensor

from gsx.core.data.window import Window
from gsx.modules.bilateral_grid import RANK, apply_grid, initial_grids, light_slopes, without_common
from gsx.modules.exposure import Exposure, ExposureOptions, Measure, light_of

ALL = torch.ones(36, 48, dtype=torch.bool)


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Numbers in [0, 1]."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def sides(height: int, width: int) -> tuple[Tensor, Tensor]:
    """(x, y) of pixel centres, [-1, 1] over the picture."""
    return (2 * torch.arange(width) + 1) / width - 1, ((2 * torch.arange(height) + 1) / height - 1)[:, None]


def test_a_pixel_gains_what_its_place_and_luma_say() -> None:
    """One pixel by hand: luma 0.299 * 0.5 + 0.587 * 0.2 + 0.114 * 0.8 = 0.3581, in a picture of 4 x 2 px at (3, 0)."""
    image, matrices = noise(3, 2, 4), 0.3 * noise(RANK, 3, 4, seed=1) - 0.1
    image[:, 0, 3] = torch.tensor([0.5, 0.2, 0.8])
    x, y = 0.75, -0.5
    weights = torch.tensor([2 * 0.3581 - 1, x, y, x * x - 1 / 3, y * y - 1 / 3])
    matrix = (weights[:, None, None] * matrices).sum(0)
    expected = image[:, 0, 3] + matrix @ torch.tensor([0.5, 0.2, 0.8, 1.0])
    torch.testing.assert_close(apply_grid(image, matrices)[:, 0, 3], expected)
    assert torch.equal(apply_grid(image, torch.zeros(RANK, 3, 4)), image)


def test_a_window_is_changed_as_its_part_of_the_picture() -> None:
    image, matrices, window = noise(3, 20, 30), 0.3 * noise(RANK, 3, 4, seed=1), Window(7, 4, 11, 9)
    part = apply_grid(window.cut(image), matrices, window.shares(30, 20))
    torch.testing.assert_close(part, window.cut(apply_grid(image, matrices)))


def test_gradients_are_those_of_finite_differences() -> None:
    image, matrices = 0.1 + 0.8 * noise(3, 3, 4).double(), 0.3 * noise(RANK, 3, 4, seed=1).double()
    torch.autograd.gradcheck(apply_grid, (image.requires_grad_(), matrices.requires_grad_()))


def shaded(image: Tensor, across: float, down: float) -> Tensor:
    """A photograph whose log gains grow so from its middle to its sides; red half as much across."""
    x, y = sides(*image.shape[1:])
    return torch.stack([image[c] * ((0.5 if c == 0 else 1) * across * x + down * y).exp() for c in range(3)])


def test_slopes_are_told_beside_bows_and_by_pixels_that_tell() -> None:
    image = 0.3 + 0.1 * noise(3, 36, 48)
    _, y = sides(36, 48)
    photograph = shaded(image, 0.2, -0.1) * (0.3 * y.square()).exp()
    whole, even, odd = light_slopes(image, photograph, ALL, 16)
    expected = torch.tensor([[0.1, 0.2, 0.2], [-0.1, -0.1, -0.1]], dtype=torch.float64)
    for found in (whole, even, odd):
        torch.testing.assert_close(found, expected, atol=0.02, rtol=0)
    photograph[:, :12] = 0.9  # something in the way, which does not count
    torch.testing.assert_close(light_slopes(image, photograph, ALL & (torch.arange(36) >= 12)[:, None], 16)[0],
                               expected, atol=0.03, rtol=0)  # fmt: skip
    assert light_slopes(image, photograph, ~ALL, 16).isnan().all()
    two_rows = (ALL & (torch.arange(36) >= 24)[:, None]).clone()  # 12 blocks, which tell no slope down beside a bow
    assert light_slopes(image, photograph, two_rows, 16).isnan().all()
    assert light_slopes(image[..., :4, :4], photograph[..., :4, :4], ALL[:4, :4], 16).isnan().all()


@pytest.mark.parametrize("size", [(36, 48), (35, 47), (41, 53)])
def test_slopes_are_those_of_the_whole_side(size: tuple[int, int]) -> None:
    """Also where sixths of it are no whole numbers of pixels."""
    image = torch.full((3, *size), 0.4)
    found = light_slopes(image, shaded(image, 0.3, -0.2), torch.ones(size, dtype=torch.bool), 9)[0]
    torch.testing.assert_close(found[0], torch.tensor([0.15, 0.3, 0.3], dtype=torch.float64), atol=1e-3, rtol=0)
    torch.testing.assert_close(found[1], torch.full((3,), -0.2, dtype=torch.float64), atol=1e-3, rtol=0)


def options(**changes: object) -> ExposureOptions:
    """Those of conf, asked for, and changes."""
    return replace(ExposureOptions(when="auto", grid="auto"), **changes)


def exposure_of(views: int = 4, iterations: int = 1000, **changes: object) -> Exposure:
    """The module with these options."""
    return build_module(Exposure, options(**changes), iterations=iterations, views=views)


def measure_of(pairs: list[tuple[Tensor, Tensor, None]], slopes: bool = True) -> Measure:
    """Measures light by number of a photo."""
    return lambda index: light_of(pairs[index], slopes)


def pairs_of(slopes: list[float]) -> tuple[Tensor, list[tuple[Tensor, Tensor, None]]]:
    """(what the model shows, (that, photograph that gets brighter to the right, no mask) of every view)."""
    image = 0.3 + 0.1 * noise(3, 36, 48)
    return image, [(image, shaded(image, slope, 0), None) for slope in slopes]


def test_grids_begin_where_light_differs_less_what_all_have_in_common() -> None:
    slopes = [0.3, -0.1, 0.2, -0.2]
    image, pairs = pairs_of(slopes)
    found = exposure_of()
    _, inside = found.test(measure_of(pairs), 201)
    across = torch.tensor(slopes).var() * torch.tensor([0.25, 1, 1])  # red half as much; none of them down
    assert inside == pytest.approx(math.sqrt(float(across.sum()) / 6), rel=0.05)
    assert found.grids is not None
    assert not any(found.due(number) for number in range(1, 1001)), "grids are learnt on, and not told again"
    found.context = replace(found.context, iterations=6000)
    assert not found.due(1201), "nor judged anew where the run goes on longer"
    torch.testing.assert_close(found.grids.detach().mean(0), torch.zeros(RANK, 3, 4), atol=1e-6, rtol=0)
    for index, slope in enumerate(slopes):
        wanted = shaded(image, slope - 0.05, 0)
        assert (found.expose(image, index).detach() - wanted).abs().mean() < 0.2 * (image - wanted).abs().mean()


def test_a_photograph_of_which_nothing_is_told_begins_with_the_mean_light() -> None:
    slopes = torch.tensor([[0.3] * 3, [0.1] * 3])[:, None].repeat(1, 2, 1)
    found = initial_grids(torch.cat([slopes, torch.full((1, 2, 3), math.nan)]))
    assert found[2].abs().max() < 1e-6
    torch.testing.assert_close(found[:2, 1, :, :3], torch.stack([0.1 * torch.eye(3), -0.1 * torch.eye(3)]))


def test_even_light_has_no_grids_unless_asked_for() -> None:
    _, pairs = pairs_of([0.03, -0.02, 0.01, 0.0])
    found = exposure_of()
    assert 0 < found.test(measure_of(pairs), 201)[1] < found.options.grid_spread
    assert found.grids is found.matrices is None
    assert "grids" not in found.state_dict()
    asked = exposure_of(grid="always")
    asked.test(measure_of(pairs), 201)
    assert asked.grids is not None
    never = exposure_of(grid="never")
    assert math.isnan(never.test(measure_of(pairs_of([0.3, -0.3, 0.2, -0.2])[1], slopes=False), 201)[1])
    assert never.grids is None


def test_a_grid_comes_behind_an_exposure() -> None:
    with pytest.raises(ValueError, match=r"training\.exposure\.grid is 'auto', but .*when is 'never'"):
        options(when="never")
    with pytest.raises(ValueError, match=r"training\.exposure\.grid is 'often'; choose from never, auto, always"):
        options(grid="often")


def test_grids_are_learnt_and_go_on_from_what_was_kept() -> None:
    image = 0.2 + 0.3 * noise(3, 12, 16)
    truth = without_common(0.2 * noise(2, RANK, 3, 4, seed=3))
    found = exposure_of(2, 200, rate_final=0.001)
    found.start(matrices=torch.eye(3, 4).repeat(2, 1, 1), grids=initial_grids(torch.zeros(2, 2, 3)))

    def go_on(module: Exposure, first: int, last: int) -> float:
        for step in range(first, last):
            loss = (module.expose(image, step % 2, learning=True) - apply_grid(image, truth[step % 2])).square()
            loss.mean().backward()
            module.optimizer_step(step)
        return float(loss.detach().mean())

    before = go_on(found, 41, 43)
    go_on(found, 43, 90)
    other = exposure_of(2, 200, rate_final=0.001)
    other.load_state_dict({name: value.clone() for name, value in found.state_dict().items()})
    assert go_on(found, 90, 200) == go_on(other, 90, 200) < before / 10
    assert found.grids is not None
    assert other.grids is not None
    assert torch.equal(found.grids, other.grids)
    torch.testing.assert_close(found.grids.detach().mean(0), torch.zeros(RANK, 3, 4), atol=1e-6, rtol=0)
    assert not found.expose(image, 0).requires_grad


SHADED = (
    *("scene.disturb.shade=0.4", "training.exposure.when=auto", "training.exposure.grid=auto", "iterations=18"),
    *("training.exposure.grid_spread=0.01", "backbone.capacity=adaptive"),
)
"""Growth looks at windows of photographs at steps 6 and 12."""


def test_a_run_with_grids_resumes_as_if_never_stopped(tmp_path: Path) -> None:
    whole = tiny_run(tmp_path / "whole", SHADED, evaluated=False)
    assert whole.modules["exposure"].grids is not None
    stopped_at(tmp_path / "stopped", SHADED, 9)
    a = same_ending(tmp_path / "whole", tmp_path / "stopped")
    assert "exposure.grids" in a
