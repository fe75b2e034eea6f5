"""SH degrees by what they are worth: the least cost by hand, highlights that keep their bands, bands that stay away."""

import math
from dataclasses import replace

import torch
from small_scene import Grey, published_options, small_gs3d, small_scene, spread

from gsx.backbones.gs3d import GS3D
from gsx.backbones.sh_degrees import kept_bands, least_degrees, numbers_of
from gsx.core.data.camera import look_at
from gsx.core.data.scene import View
from gsx.core.training.parameter_table import restore_table, table_tensors

NUMBERS = [14, 23, 38, 59]
JUDGED = 24000
"""80 % of the published run."""


def test_numbers_of_a_gaussian() -> None:
    """3 of the mean, 4 of the rotation, 3 of the scales, 1 of the opacity; 3, 12, 27, 48 of the colour."""
    assert numbers_of(3, 11).tolist() == NUMBERS


def test_the_degree_that_costs_least_by_hand() -> None:
    """A price of one for all 59 numbers: degree 0 saves 45/59, degree 2 saves 21/59."""
    price, error = 10 * math.log(2) / math.log(10), 1.0
    squares = torch.tensor([[0.70, 0.30, 0.01, 0.0], [0.80, 0.60, 0.30, 0.0], [9.0, 9.0, 0.40, 0.0], [0.0] * 4]).T
    shown = torch.tensor([1.0, 2.0, 3.0, 0.0])
    #      0.937 0.690 0.654 1 | 1.037 0.990 0.944 1 | 9.2 9.4 1.044 1 | nothing is known
    found = least_degrees(squares, shown, error, price, torch.tensor(NUMBERS))
    assert found.tolist() == [2, 2, 3, 3]
    assert least_degrees(squares, shown, error, 3 * price, torch.tensor(NUMBERS)).tolist() == [0, 0, 2, 3]


def test_bands_within_a_degree() -> None:
    kept = kept_bands(torch.tensor([0, 1, 2, 3]), 15)
    assert kept.sum(1).tolist() == [0, 3, 8, 15]
    assert kept[1].nonzero().flatten().tolist() == [0, 1, 2]


def shiny(price: float = 0.05) -> GS3D:
    """Six Gaussians, seen from all around; three show other colours to every side by their second band, and all have
    traces of every band."""
    scene = small_scene(2 * spread(6))
    corners = [(4 * math.cos(angle), 4 * math.sin(angle)) for angle in torch.arange(8).mul(math.pi / 4).tolist()]
    cameras = [look_at([x, y, 1], [0, 0, 0], fov_x=0.9, width=24, height=16) for x, y in corners]
    scene = replace(scene, train=[View(f"view{i}", camera, Grey()) for i, camera in enumerate(cameras)])
    model = small_gs3d(scene, options=replace(published_options(), sh_judged=0.8, sh_price=price))
    with torch.no_grad():
        model.table["opacity_logits"].fill_(2.0)
        model.table["sh_rest"].normal_(0, 1e-4, generator=torch.Generator().manual_seed(1))
        model.table["sh_rest"][:3, 3:8] = 0.5
    return model


def learn(model: GS3D, step: int) -> None:
    """A step towards other colours, by all bands."""
    drawn = model.draw(model.context.scene.train[0].camera, step)
    drawn.splats.colours.square().sum().backward()
    model.update(step)


def test_bands_that_show_stay_and_others_go_for_good() -> None:
    model = shiny()
    learn(model, JUDGED - 1)  # moments
    assert "degree_0" not in model.densify_and_prune(JUDGED - 1)
    done = model.densify_and_prune(JUDGED)
    assert done == {"degree_0": 3, "degree_1": 0, "degree_2": 3, "degree_3": 0}
    assert model.table["sh_degree"].tolist() == [2, 2, 2, 0, 0, 0]
    for step in (JUDGED, JUDGED + 1):
        before = model.table["sh_rest"].detach().clone()
        learn(model, step)
        assert not model.table["sh_rest"][3:].any()
        assert not model.table["sh_rest"][:3, 8:].any()
        assert (model.table["sh_rest"][:3, :8] != before[:3, :8]).any()


def test_bands_stay_where_they_are_cheap_and_go_where_they_are_dear() -> None:
    for price, degrees in ((1e-6, [3] * 6), (100.0, [0] * 6)):
        model = shiny(price)
        with torch.no_grad():
            model.table["sh_rest"].normal_(0, 0.05, generator=torch.Generator().manual_seed(1))
        model.densify_and_prune(JUDGED)
        assert model.table["sh_degree"].tolist() == degrees


def test_bands_that_have_not_begun_to_learn_are_not_judged() -> None:
    """At step 1000 of the published run colours are of degree 1."""
    scene = small_scene(spread(3))
    model = small_gs3d(scene, options=replace(published_options(), sh_judged=1000 / 30000, sh_price=1e-6))
    with torch.no_grad():
        model.table["sh_rest"][:, :3] = torch.tensor([0.5, 0.0, 0.5])[:, None, None]
    model.densify_and_prune(1000)
    assert model.table["sh_degree"].tolist() == [3, 0, 3]


def test_degrees_are_saved_with_the_model() -> None:
    model = shiny()
    model.densify_and_prune(JUDGED)
    again = restore_table(shiny().table, table_tensors(model.table))
    assert again["sh_degree"].tolist() == [2, 2, 2, 0, 0, 0]


def test_nothing_is_judged_unless_asked_for() -> None:
    model = small_gs3d(small_scene(spread(3)))
    assert model.sh_step() == 0
    assert "sh_degree" not in model.table.columns
