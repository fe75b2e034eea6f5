"""What each Gaussian has to do with an error, against renders with one of them painted, and without one of them."""

import itertools
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import View
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.training.finer_raster import FinerRaster, finer_raster
from gsx.core.training.importance import (
    random_signs,
    render_with_leaves,
)

RULES = RasterSettings(evaluation="float64", accumulation="float64", alpha_min=1e-9, transmittance_stop=0, cull="tight")
BACKGROUND = torch.tensor([0.2, 0.5, 0.7], dtype=torch.float64)


@dataclass(frozen=True)
class Shot:
    """A photograph of noise."""

    seed: int = 1

    def image(self, camera: Camera) -> Tensor:
        generator = torch.Generator().manual_seed(self.seed)
        return torch.randint(0, 256, (3, camera.height, camera.width), generator=generator, dtype=torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def view_of(width: int, height: int) -> View:
    camera = look_at([0, -3, 0.5], [0, 0, 0], fov_x=0.8, width=width, height=height)
    return View(name="noise", camera=camera, source=Shot())


def cloud(count: int) -> Splats:
    """Large splats, one behind the other, with opacities below the bound of alphas."""
    generator = torch.Generator().manual_seed(3)
    draws = [torch.rand(count, size, generator=generator, dtype=torch.float64) for size in (3, 3, 4, 1, 3)]
    return Splats(
        means=draws[0] - 0.5,
        scales=0.2 + 0.3 * draws[1],
        quats=draws[2] - 0.5,
        log_opacities=(0.2 + 0.6 * draws[3][:, 0]).log(),
        colours=draws[4],
    )


def plain(camera: Camera) -> FinerRaster:
    """Rendered at the camera's own resolution."""
    return finer_raster(camera, Reduction(filter="bicubic"), 1)


def without(splats: Splats, row: int) -> Splats:
    kept = torch.arange(len(splats)) != row
    return Splats(**{name: value[kept] for name, value in vars(splats).items()})


def test_errors_are_shared_by_blending_weights() -> None:
    """Against renders in which one splat is white and all else black: these are its weights."""
    splats, view = cloud(5), view_of(12, 9)
    seen = render_with_leaves(splats, plain(view.camera), RULES, BACKGROUND)
    off = seen.image.detach() - view.image()
    error = (rasterize(splats, view.camera, RULES, background=BACKGROUND).image - view.image()).square().sum(0)
    for row, found in enumerate(seen.error_sums(off)):
        white = torch.zeros(5, 3, dtype=torch.float64)
        white[row] = 1
        weights = rasterize(replace(splats, colours=white), view.camera, RULES).image[0]
        assert float(found) == pytest.approx(float((weights * error).sum()), rel=1e-9)
    assert float(off.square().sum()) == pytest.approx(float(error.sum()), rel=1e-12)


def test_weights_are_summed_where_pixels_do_not_count_and_everywhere() -> None:
    """A splat's blending weights are what it alone adds, painted white before black; two splats make the second row."""
    splats, camera = cloud(3), view_of(24, 16).camera
    counted = torch.ones(16, 24, dtype=torch.bool)
    counted[3:9, 5:14] = False
    seen = render_with_leaves(splats, plain(camera), RULES, BACKGROUND, torch.tensor([0, 1, 1]), 2)
    hidden, shown = seen.blending_weights(counted)
    weights = []
    for number in range(3):
        painted = replace(splats, colours=torch.zeros_like(splats.colours).index_fill(0, torch.tensor([number]), 1.0))
        weights.append(rasterize(painted, camera, RULES, background=0 * BACKGROUND).image[0])
    by_row = torch.stack([weights[0], weights[1] + weights[2]])
    torch.testing.assert_close(shown, by_row.sum((1, 2)))
    torch.testing.assert_close(hidden, by_row[:, 3:9, 5:14].sum((1, 2)))
    none, all_over = seen.blending_weights(None)
    assert not none.any()
    torch.testing.assert_close(all_over, shown)


def test_rows_count_in_a_view_that_draws_none_of_their_splats() -> None:
    """Models whose splats are decoded for each view, such as anchors of a coarse level, may draw nothing there."""
    camera, nothing = view_of(12, 9).camera, torch.zeros(0, dtype=torch.long)
    none = Splats(**{name: value[:0] for name, value in vars(cloud(1)).items()})
    seen = render_with_leaves(none, plain(camera), RULES, BACKGROUND, nothing, 4)
    assert seen.squared_changes(None, 2, torch.Generator()).tolist() == [0.0] * 4
    assert not seen.visible_rows().any()
    assert all(not part.any() for part in seen.blending_weights(None))


def test_what_the_picture_loses_without_a_splat() -> None:
    """Two pixels, six values: the mean over all 64 signs is the difference between two renders, squared."""
    splats, view = cloud(4), view_of(2, 1)
    seen = render_with_leaves(splats, plain(view.camera), RULES, BACKGROUND)
    patterns = [torch.tensor(signs).double().view(3, 1, 2) for signs in itertools.product((1, -1), repeat=6)]
    found = torch.stack([seen.removal_changes(signs).square() for signs in patterns]).mean(0)
    for row in range(4):
        less = rasterize(without(splats, row), view.camera, RULES, background=BACKGROUND).image
        expected = float((less - seen.rendering.image.detach()).square().sum())
        assert float(found[row]) == pytest.approx(expected, rel=1e-6)


def test_blending_weights_squared() -> None:
    """Against renders in which one splat is white and all else black; two pixels, six values, all 64 signs."""
    splats, view = cloud(4), view_of(2, 1)
    seen = render_with_leaves(splats, plain(view.camera), RULES, BACKGROUND)
    patterns = [torch.tensor(signs).double().view(3, 1, 2) for signs in itertools.product((1, -1), repeat=6)]
    found = torch.stack([seen.blending_squares(signs) for signs in patterns]).mean(0)
    for row in range(4):
        white = torch.zeros(4, 3, dtype=torch.float64)
        white[row] = 1
        weights = rasterize(replace(splats, colours=white), view.camera, RULES).image[0]
        assert float(found[row]) == pytest.approx(float(weights.square().sum()), rel=1e-9)


def test_signs_come_from_the_generator_alone() -> None:
    seen = torch.zeros(3, 8, 8)
    one, again, other = (random_signs(seen, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    assert set(one.unique().tolist()) == {-1, 1}


def test_signs_are_none_where_a_picture_does_not_count() -> None:
    counted = torch.zeros(2, 3, dtype=torch.bool)
    counted[0, 1] = True
    signs = random_signs(torch.zeros(3, 2, 3), torch.Generator().manual_seed(1), counted)
    assert signs.abs().sum(0).tolist() == [[0, 3, 0], [0, 0, 0]]


def test_a_finer_raster_is_judged_as_it_is_reduced() -> None:
    """What goes with a splat, of a picture that is rendered twice as fine and reduced: against two such pictures."""
    splats, view = cloud(4), view_of(2, 1)
    raster = finer_raster(view.camera, Reduction(filter="area"), 2)
    seen = render_with_leaves(splats, raster, RULES, BACKGROUND)
    patterns = [torch.tensor(signs).double().view(3, 1, 2) for signs in itertools.product((1, -1), repeat=6)]
    found = torch.stack([seen.removal_changes(signs).square() for signs in patterns]).mean(0)
    for row in range(4):
        less = raster.reduced(rasterize(without(splats, row), raster.camera, RULES, background=BACKGROUND).image)
        assert float(found[row]) == pytest.approx(float((less - seen.image.detach()).square().sum()), rel=1e-6)


def test_a_row_of_several_splats_goes_as_a_whole() -> None:
    """Two splats of one row, seen through each other by little: what both change together, not each by itself."""
    splats, view = cloud(4), view_of(12, 9)
    splats = replace(splats, log_opacities=splats.log_opacities - 4)  # so faint that what lies behind hardly matters
    seen = render_with_leaves(splats, plain(view.camera), RULES, BACKGROUND, torch.tensor([0, 0, 1, 1]), 2)
    squares = seen.squared_changes(None, 512, torch.Generator().manual_seed(2))
    whole = rasterize(splats, view.camera, RULES, background=BACKGROUND).image
    for row in range(2):
        kept = torch.tensor([0, 0, 1, 1]) != row
        rest = Splats(**{name: value[kept] for name, value in vars(splats).items()})
        less = rasterize(rest, view.camera, RULES, background=BACKGROUND).image
        assert float(squares[row]) == pytest.approx(float((less - whole).square().sum()), rel=0.2)
