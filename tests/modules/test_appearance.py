"""Appearance codes: responses measured, decoded, learnt, resumed, and fitted to halves of held-out photos."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from module_contexts import build_module
from tiny import final_tensors, stopped_at, tiny_run
from torch import Tensor

from gsx.core.files import read_json
from gsx.modules.appearance import (
    NUMBERS,
    Appearance,
    AppearanceOptions,
    fit_code,
    light_fields,
    principal_codes,
    respond,
    response_of,
    response_slopes,
)
from gsx.modules.bilateral_grid import WHOLE
from gsx.modules.photo_pairs import Pair

EVERYWHERE = torch.ones(24, 32, dtype=torch.bool)
LOOSE = torch.full((NUMBERS,), 1e-6)


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Numbers in [0, 1]."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def render() -> Tensor:
    return 0.2 + 0.4 * noise(3, 24, 32)


def photo_of(image: Tensor, gains: tuple[float, float, float], across: float, down: float) -> Tensor:
    """A photo by the formulas of a camera, pixel by pixel: light, then gains."""
    height, width = image.shape[1:]
    out = torch.empty_like(image)
    for row in range(height):
        for column in range(width):
            x, y = 2 * (column + 0.5) / width - 1, 2 * (row + 0.5) / height - 1
            out[:, row, column] = torch.tensor(gains) * image[:, row, column] * math.exp(across * x + down * y)
    return out


def test_a_known_response_is_recovered_from_a_photo() -> None:
    image = render()
    photo = photo_of(image, (1.2, 0.9, 1.1), across=0.2, down=-0.3)
    numbers = fit_code(image, photo, EVERYWHERE, torch.eye(NUMBERS), LOOSE)
    truth = torch.zeros(NUMBERS)
    truth[[0, 5, 10, 12, 13]] = torch.tensor([0.2, -0.1, 0.1, 0.2, -0.3])
    torch.testing.assert_close(numbers, truth, atol=1e-3, rtol=0)
    torch.testing.assert_close(respond(image, light_fields(image), truth), photo, atol=1e-5, rtol=0)


def test_gradients_are_those_of_finite_differences_and_zero_numbers_change_nothing() -> None:
    image, fields = render()[:, :3, :4].double().requires_grad_(), light_fields(render()[:, :3, :4].double())
    numbers = (0.2 * noise(NUMBERS) - 0.1).double().requires_grad_()
    torch.autograd.gradcheck(lambda i, n: respond(i, fields, n), (image, numbers))
    torch.testing.assert_close(respond(image, fields, torch.zeros(NUMBERS).double()), image)
    step = 1e-6 * torch.eye(NUMBERS).double()
    ends = [[respond(image, fields, numbers + sign * row) for row in step] for sign in (1, -1)]
    differences = ((torch.stack(ends[0], 3) - torch.stack(ends[1], 3)) / 2e-6).detach().flatten(1, 2)
    slopes = response_slopes(image.detach().flatten(1), fields.flatten(1), numbers.detach())
    torch.testing.assert_close(slopes, differences, atol=1e-8, rtol=0)


def test_a_part_of_a_photo_has_the_light_of_its_place() -> None:
    whole, edges = render(), (0.25, 0.5, 0.75, 1.0)
    part = whole[:, 12:, 8:24]
    torch.testing.assert_close(light_fields(part, edges), light_fields(whole, WHOLE)[:, 12:, 8:24])


def test_codes_are_principal_components_with_the_mean_photo_as_neutral() -> None:
    true = torch.randn(9, 2, generator=torch.Generator().manual_seed(0)) @ noise(2, NUMBERS) + noise(NUMBERS)
    codes, decoder = principal_codes(true, 8)
    assert codes.shape == (9, 8)
    assert codes[:, 2:].abs().max() < 1e-5  # two directions hold all
    torch.testing.assert_close(codes[:, :2] @ decoder[:, :2].T, true - true.mean(0), atol=1e-5, rtol=0)
    torch.testing.assert_close(codes.mean(0), torch.zeros(8), atol=1e-6, rtol=0)


def appearance_of(photos: int = 4, **changes: object) -> Appearance:
    """The module with options of conf, and changes."""
    return build_module(Appearance, replace(AppearanceOptions(when="auto"), **changes), views=photos)


def pairs_at(gains: list[float]) -> list[Pair]:
    """(render, photo at its gain, no mask) of every view."""
    return [(render(), gain * render(), None) for gain in gains]


def test_equal_photos_have_no_codes_and_others_theirs() -> None:
    module, image, [view, *_] = appearance_of(), render(), appearance_of().context.scene.train
    assert module.test(pairs_at([1.01, 1.0, 0.99, 1.0]).__getitem__, 201)["appearances"] == 0
    assert module.state_dict() == {}
    assert module.transform_render(image, view, image, None, learning=True) is image
    assert module.fit_render(image, image, EVERYWHERE) is None
    gains = [0.8, 1.3, 1.0, 0.9]
    assert module.test(pairs_at(gains).__getitem__, 201)["appearances"] == 4
    for gain, view in zip(gains, module.context.scene.train, strict=True):
        shown = module.transform_render(image, view, None, None, learning=False)
        torch.testing.assert_close(shown, (gain - sum(gains) / 4 + 1) * image, atol=5e-3, rtol=0)


def test_they_learn_and_go_on_from_a_checkpoint() -> None:
    image, modules = render(), [appearance_of(photos=2, rate_final=0.01) for _ in range(2)]
    lights = (((1.1, 1.0, 0.9), 0.1), ((0.9, 1.0, 1.1), -0.1))
    targets = [photo_of(image, gains, slope, 0.0) for gains, slope in lights]

    def learn(module: Appearance, first: int, last: int) -> None:
        for step in range(first, last):
            view, target = module.context.scene.train[step % 2], targets[step % 2]
            rendered = module.transform_render(image, view, target, None, learning=True)
            (rendered - target).square().mean().backward()
            module.optimizer_step(step)

    modules[0].start(**dict(zip(("codes", "decoder"), principal_codes(0.1 * noise(2, NUMBERS), 2), strict=True)))
    learn(modules[0], 201, 240)
    modules[1].load_state_dict({name: value.clone() for name, value in modules[0].state_dict().items()})
    for module in modules:
        learn(module, 240, 500)
    first, second = (module.state_dict() for module in modules)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert first["codes"].mean(0).abs().max() < 1e-6
    seen = [modules[0].transform_render(image, v, None, None, False) for v in modules[0].context.scene.train]
    torch.testing.assert_close(seen[0] - seen[1], targets[0] - targets[1], atol=1e-2, rtol=0)


def test_only_the_left_half_of_a_held_out_photo_is_used() -> None:
    module, image = appearance_of(), render()
    module.test(pairs_at([0.8, 1.3, 1.0, 0.9]).__getitem__, 201)
    left, photo = EVERYWHERE.clone(), 1.2 * image
    left[:, 16:] = False
    fitted = module.fit_render(image, photo, left)
    torch.testing.assert_close(fitted, photo, atol=1e-2, rtol=0)
    other = photo.clone()
    other[..., 16:] = noise(3, 24, 16, seed=1)
    assert torch.equal(module.fit_render(image, other, left), fitted)
    other[..., :16] *= 0.8
    assert not torch.equal(module.fit_render(image, other, left), fitted)


def test_where_no_pixel_counts_a_photo_is_neutral() -> None:
    image = render()
    assert response_of((image, image, ~EVERYWHERE)).abs().max() == 0


CODES = ("training.appearance.when=always", "scene.disturb.exposure=0.3", "iterations=30")


def test_a_run_resumes_as_if_never_stopped_and_reports_fitted_views(tmp_path: Path) -> None:
    whole = tiny_run(tmp_path / "whole", CODES)
    stopped_at(tmp_path / "stopped", CODES, 12)
    a, b = final_tensors(tmp_path / "whole"), final_tensors(tmp_path / "stopped")
    assert whole.modules["appearance"].active
    assert a.keys() == b.keys()
    assert "appearance.codes" in a
    assert all(torch.equal(a[name], b[name]) for name in a)
    evaluation = read_json(tmp_path / "whole" / "evaluation.json")
    fitted, views = evaluation["fitted"]["appearance"], [view["fitted"]["appearance"] for view in evaluation["views"]]
    assert "left half" in evaluation["fitted"]["protocol"]
    assert fitted["psnr"] == pytest.approx(sum(view["psnr"] for view in views) / 2)
    assert any(f"{fitted['psnr_rendered']:.2f} dB without codes" in remark for remark in evaluation["remarks"])
    assert evaluation["appearance"]["photos"] == 6
    assert sum(view["psnr"] for view in evaluation["views"]) / 2 == pytest.approx(evaluation["psnr"])
