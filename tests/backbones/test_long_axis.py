"""Halves along the longest axis, by hand; wholes as what they were made from; who is split, against renders."""

import math

import torch
from small_scene import published_options, small_gs3d, small_scene, spread
from torch import Tensor

from gsx.backbones.gs3d_options import GS3DOptions
from gsx.backbones.long_axis import covariances, halves, split_along, twins_of, wholes


def rows_of(scales: list[list[float]], opacity: float, quats: Tensor | None = None) -> dict[str, Tensor]:
    count = len(scales)
    generator = torch.Generator().manual_seed(4)
    return {
        "means": torch.randn(count, 3, generator=generator),
        "sh_dc": torch.randn(count, 1, 3, generator=generator),
        "sh_rest": torch.randn(count, 3, 3, generator=generator),
        "opacity_logits": torch.full((count,), math.log(opacity / (1 - opacity))),
        "log_scales": torch.tensor(scales).log(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1) if quats is None else quats,
    }


def test_halves_by_hand() -> None:
    """Scales 3, 1, 1 and opacity 0.8: 4.05 to each side, 1.65, 0.893 and 0.893, opacity 0.48."""
    whole = rows_of([[3.0, 1.0, 1.0]], 0.8)
    for side, half in zip((1, -1), halves(whole), strict=True):
        torch.testing.assert_close(half["means"], whole["means"] + torch.tensor([[4.05 * side, 0, 0]]))
        expected = torch.tensor([[1.65, 0.8930286, 0.8930286]])
        torch.testing.assert_close(half["log_scales"].exp(), expected, atol=1e-5, rtol=0)
        torch.testing.assert_close(half["opacity_logits"].sigmoid(), torch.tensor([0.48]))
        assert torch.equal(half["sh_rest"], whole["sh_rest"])


def test_halves_lie_along_the_rotated_axis() -> None:
    """A quarter turn about z takes the second axis to minus the first."""
    turned = torch.tensor([[math.sqrt(0.5), 0, 0, math.sqrt(0.5)]])
    whole = rows_of([[0.5, 2.0, 1.0]], 0.5, turned)
    first, second = halves(whole)
    torch.testing.assert_close(first["means"] - second["means"], torch.tensor([[-5.4, 0, 0]]), atol=1e-5, rtol=0)


def test_fresh_halves_make_the_whole_again() -> None:
    generator = torch.Generator().manual_seed(5)
    scales = (0.2 + torch.rand(20, 3, generator=generator)).tolist()
    whole = rows_of(scales, 0.7, torch.randn(20, 4, generator=generator))
    again = wholes(*halves(whole))
    for name in ("means", "sh_dc", "sh_rest", "opacity_logits"):
        torch.testing.assert_close(again[name], whole[name], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(covariances(again), covariances(whole), atol=1e-5, rtol=1e-4)


def test_pairs_are_those_of_which_both_are_left() -> None:
    first, second = twins_of(torch.tensor([0.0, 1, 2, 3, 0, 1, 3]))
    assert sorted(zip(first.tolist(), second.tolist(), strict=True)) == [(1, 5), (3, 6)]


def adaptive() -> GS3DOptions:
    options = published_options()
    return GS3DOptions(**{**vars(options), "capacity": "adaptive"})


def test_an_event_undone_draws_what_was_drawn_before_it() -> None:
    scene = small_scene(spread(30))
    model = small_gs3d(scene, options=adaptive())
    camera = scene.train[0].camera
    with torch.no_grad():
        model.table["log_scales"].copy_(torch.randn(30, 3, generator=torch.Generator().manual_seed(1)) * 0.5 - 2)
        before = model.draw(camera, 1).splats
    chosen = torch.zeros(30, dtype=torch.bool)
    chosen[[3, 7, 20]] = True
    split_along(model.table, chosen)
    numbers = torch.tensor([1.0, 2, 3])
    model.table.statistics["born"] = torch.cat([torch.zeros(27), numbers, numbers])
    undone = model.control.before_last_event(model.table)
    assert undone is not None
    assert len(undone) == 30
    order = torch.cat([(~chosen).nonzero()[:, 0], chosen.nonzero()[:, 0]])
    torch.testing.assert_close(undone["means"], before.means[order], atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(
        undone["log_scales"].exp().sort(1).values, before.scales[order].sort(1).values, atol=1e-5, rtol=1e-3
    )


def test_what_draws_the_error_is_split_first() -> None:
    """Two Gaussians with the same gradient: one as grey as the photographs, one white."""
    colours = torch.full((2, 3), 128, dtype=torch.uint8)
    colours[1] = 255
    scene = small_scene(torch.tensor([[-0.5, 0, 0], [0.5, 0, 0]]), colours, background=128 / 255)
    options = GS3DOptions(**{**vars(published_options()), "capacity": "budget", "budget": budget_of(3)})
    model = small_gs3d(scene, options=options)
    with torch.no_grad():
        model.table["log_scales"].fill_(-1.5)
    for name in ("absolute", "gradient", "count"):
        model.table.statistics[name] = torch.ones(2)
    done = model.control.add(model, step=14900)
    assert done == {"split": 1}
    left = model.table["means"].detach()[:, 0]
    assert float(left[0]) == -0.5  # the grey one stays
    assert (left[1:] > 0).all()
    assert len(left) == 3


def budget_of(primitives: int):
    from gsx.backbones.capacity import BudgetOptions

    return BudgetOptions(primitives=primitives)


def test_nothing_is_undone_where_nothing_was_added() -> None:
    model = small_gs3d(small_scene(spread(5)), options=adaptive())
    assert model.control.before_last_event(model.table) is None
