"""Which pixels count: sampling by hand, and agreement with the photograph."""

from dataclasses import replace

import pytest
import torch

from gsx.augmenters.pixel_weights import (
    SplatSuRe,
    agreeing,
    best_densities,
    contributes,
    in_bytes,
    normalised,
    sampled_better,
    sampling_scores,
    undilated_radii,
)
from gsx.augmenters.pseudo_options import WEIGHT_MAPS
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.reduction import Reduction
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.backbone import DrawnSplats


def at(distance: float, width: int = 40, target: float = 0.0) -> Camera:
    return look_at([target, -distance, 0.0], [target, 0.0, 0.0], fov_x=0.9, width=width, height=width)


def test_densities_are_pixels_per_unit() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [9.0, 0.0, 0.0], [0.0, -9.0, 0.0]])
    camera = at(4.0)
    found = best_densities(points, [camera])
    assert found.tolist() == pytest.approx([camera.fx / 4, camera.fx / 6, 0.0, 0.0])
    assert float(best_densities(points, [camera, at(2.0)])[0]) == pytest.approx(camera.fx / 2)


def wall() -> Splats:
    """Opaque discs on a plane through the origin, facing the cameras."""
    row, column = torch.meshgrid(torch.linspace(-1, 1, 21), torch.linspace(-1, 1, 21), indexing="ij")
    means = torch.stack([column.flatten(), torch.zeros(441), row.flatten()], 1)
    return Splats(
        means=means,
        scales=torch.full((441, 3), 0.08),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(441, 1),
        log_opacities=torch.full((441,), 0.99).log(),
        colours=torch.rand(441, 3, generator=torch.Generator().manual_seed(0)),
    )


def middle(picture: torch.Tensor) -> float:
    height, width = picture.shape
    return float(picture[height // 2 - 3 : height // 2 + 3, width // 2 - 3 : width // 2 + 3].mean())


@pytest.mark.parametrize(("zoom", "counts"), [(1, False), (2, True), (4, True)])
def test_a_zoomed_view_counts_unless_a_photograph_came_as_near(zoom: int, counts: bool) -> None:
    raster, own = RasterSettings(), at(4.0)
    assert (
        middle(sampled_better(lambda _: DrawnSplats(splats=wall()), own.zoom(zoom), [own], 0, raster)) > 0.9
    ) == counts
    assert middle(sampled_better(lambda _: DrawnSplats(splats=wall()), own.zoom(zoom), [own, at(0.8)], 0, raster)) < 0.1


def test_only_the_part_that_the_nearer_photograph_shows_does_not_count() -> None:
    """A photograph from 1 unit away sees about a unit of the wall, on the left."""
    own = at(4.0)
    trust = sampled_better(
        lambda _: DrawnSplats(splats=wall()), own.zoom(2), [own, at(1.0, target=-0.6)], 0, RasterSettings()
    )
    assert float(trust[36:44, 22:30].mean()) < 0.1
    assert float(trust[36:44, 50:58].mean()) > 0.9


def dots(*places: tuple[float, float, float], scale: float = 0.2) -> Splats:
    count = len(places)
    return Splats(
        means=torch.tensor(places),
        scales=torch.full((count, 3), scale),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_opacities=torch.zeros(count),
        colours=torch.rand(count, 3, generator=torch.Generator().manual_seed(0)),
    )


@pytest.mark.parametrize(("distances", "score"), [
    ((1.0, 4.0, 4.0), 1.0),
    ((4.0, 4.0, 4.0), 0.1192),  # ratio 1: sigmoid(-2)
    ((4.0, 4.4, 4.4), 0.5),  # ratio 1.1
    ((4.0, 4.0, 5.0), 0.9526),  # 1.25: sigmoid(3)
    ((4.0, 5.0), 0.0),  # seen twice: nothing is sure
])  # fmt: skip
def test_how_sure_a_splats_detail_is_by_hand(distances: tuple[float, ...], score: float) -> None:
    """On the axis a small sphere is fx s / z wide; at 400 px the floor under the root is out of sight."""
    splats, cameras = dots((0.0, 0.0, 0.0), scale=0.02), [at(distance, width=2000) for distance in distances]
    found, finest = sampling_scores(splats, cameras, RasterSettings())
    assert float(found) == pytest.approx(score, abs=0.01)
    assert int(finest) == distances.index(min(distances))


def test_splats_far_below_a_pixel_are_alike_by_the_published_floor_and_dilation_does_not_count() -> None:
    cameras = [at(1.0), at(4.0), at(4.0)]
    tiny, small = (
        sampling_scores(dots((0.0, 0.0, 0.0), scale=scale), cameras, RasterSettings()) for scale in (1e-5, 0.2)
    )
    assert float(tiny[0]) == pytest.approx(0.1192, abs=1e-3)
    assert float(small[0]) == pytest.approx(1.0, abs=1e-3)
    radii = undilated_radii(dots((0.0, 0.0, 0.0), scale=0.2), at(1.0), RasterSettings())
    variance = (at(1.0).fx * 0.2) ** 2
    assert float(radii) == pytest.approx(3 * (variance + 0.1**0.5) ** 0.5, rel=1e-3)


def test_only_training_views_that_see_a_splat_count() -> None:
    """Beside the near camera's field of view only the far ones see; behind all, and far off, none."""
    splats = dots((0.0, 0.0, 0.0), (1.6, 0.0, 0.0), (0.0, -9.0, 0.0), (500.0, 0.0, 0.0), scale=0.05)
    score, finest = sampling_scores(splats, [at(4.0), at(1.0), at(4.0), at(4.0)], RasterSettings())
    assert score.tolist() == pytest.approx([1.0, 0.1192, 0.0, 0.0], abs=1e-3)
    assert finest.tolist() == [1, 0, -1, -1]


@pytest.mark.parametrize(("distances", "published", "ours"), [
    ((4.0, 1.0, 4.0), 0.0, 0.0),  # the near photograph has the detail
    ((1.0, 4.0, 4.0), 1.0, 0.0),  # and is the one that was zoomed in
    ((4.2, 4.0, 4.2), 1 - 0.2096, 1.0),  # of 0.6859 and 0.6221 px^2, each + sqrt(0.1): ratio 1.0336
    ((8.0, 4.0, 8.0), 0.0, 1.0),  # only the pseudo view's own distance counts for ours
    ((8.0, 4.0), 1.0, 1.0),  # seen twice
])  # fmt: skip
def test_the_published_weights_by_hand(distances: tuple[float, ...], published: float, ours: float) -> None:
    """A wall seen from 4 units through twice the focal length, made from the first of these photographs."""
    raster, own, photographs = RasterSettings(), at(4.0).zoom(2), [at(distance) for distance in distances]
    made, finer = WEIGHT_MAPS["splatsure"](), WEIGHT_MAPS["finer"]()
    assert isinstance(made, SplatSuRe)
    assert finer is sampled_better
    assert middle(made(lambda _: DrawnSplats(splats=wall()), own, photographs, 0, raster)) == pytest.approx(
        published, abs=0.03
    )
    assert middle(sampled_better(lambda _: DrawnSplats(splats=wall()), own, photographs, 0, raster)) == pytest.approx(
        ours, abs=0.1
    )


@pytest.mark.parametrize(("kind", "number", "weight"), [
    ("splatsure", 0, 0.0474), ("splatsure", 1, 0.0474), ("splatsure", 2, 1.0), ("splatsure_1.7", 0, 0.9999),
])  # fmt: skip
def test_one_opaque_splat_by_hand(kind: str, number: int, weight: float) -> None:
    """Ratio 1.25, score 0.9526: 1 - 0.9526 in photos at 5 units, 1 - 0.9526 + 1 clamped in the one at 4.

    By the other ratio the score is sigmoid(-9) = 0.0001.
    """
    splats = replace(dots((0.0, 0.0, 0.0), scale=0.3), log_opacities=torch.tensor([0.0]))
    photographs = [at(distance, width=2000) for distance in (5.0, 5.0, 4.0)]
    own = photographs[number].crop(999, 999, 2, 2)
    drawn, weights = DrawnSplats(splats=splats), WEIGHT_MAPS[kind]()
    assert isinstance(weights, SplatSuRe)
    made = weights.unscaled(drawn, own, photographs, number, RasterSettings(alpha_max=0.999))
    assert float(made.clamp(0, 1).mean()) == pytest.approx(weight, abs=2e-3)


def test_a_photograph_shows_no_splat_behind_an_opaque_one_as_published() -> None:
    """From 1 unit in front the wall hides the ball; only three far photos from behind show it, from one distance."""
    ball, front = dots((0.0, 0.5, 0.0), scale=0.05), replace(wall(), scales=torch.full((441, 3), 0.12))
    scene = Splats(**{name: torch.cat([value, getattr(ball, name)]) for name, value in vars(front).items()})
    behind = look_at([0.0, 4.5, 0.0], [0.0, 0.0, 0.0], fov_x=0.9, width=40, height=40)
    photographs, raster = [at(1.0), behind, behind, behind], RasterSettings()
    assert [bool(contributes(scene, camera, raster)[-1]) for camera in photographs[:2]] == [False, True]
    score, finest = sampling_scores(scene, photographs, raster)
    assert (float(score[-1]), int(finest[-1])) == (pytest.approx(0.1192, abs=1e-3), 1)
    score, finest = sampling_scores(scene, photographs, raster, occlusion=False)
    assert (float(score[-1]), int(finest[-1])) == (pytest.approx(1.0, abs=1e-3), 0)
    of_rows = DrawnSplats(splats=scene, rows=torch.arange(len(scene)))
    assert torch.equal(SplatSuRe().sampling(of_rows, photographs, raster).score, score)


def test_scores_are_computed_once_for_splats_that_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Again where training has moved a splat in place, or a pose was corrected."""
    calls = list[int]()

    def counting(*arguments: object, **more: object) -> object:
        calls.append(1)
        return sampling_scores(*arguments, **more)

    monkeypatch.setattr("gsx.augmenters.pixel_weights.sampling_scores", counting)
    weights, splats, photographs = SplatSuRe(), wall(), [at(4.0), at(1.0), at(4.0)]
    for number in (0, 2):
        weights(lambda _: DrawnSplats(splats=splats), at(4.0).zoom(2), photographs, number, RasterSettings())
    assert len(calls) == 1
    splats.means[0] += 0.01
    weights.sampling(DrawnSplats(splats=splats), photographs, RasterSettings())
    weights.sampling(DrawnSplats(splats=splats), [*photographs[:2], at(4.1)], RasterSettings())
    assert len(calls) == 3


def test_where_nothing_is_drawn_the_published_weight_is_1_and_low_maps_are_normalised() -> None:
    near, far = at(1.0), at(4.0)
    dot = dots((0.0, 0.0, 0.0), scale=0.05)
    weights = SplatSuRe()(lambda _: DrawnSplats(splats=dot), far.zoom(2), [far, near, far], 0, RasterSettings())
    assert float(weights[0, 0]) == 1.0
    low = torch.tensor([[0.1, 0.3], [0.5, 0.2]])
    assert normalised(low, 0.1, 0.5).tolist() == [[0.0, pytest.approx(0.5)], [1.0, pytest.approx(0.25)]]
    assert normalised(low, 0.1, 0.95).tolist() == low.tolist()
    assert normalised(torch.tensor([[-0.1, 1.7]]), -0.1, 1.7).tolist() == [[0.0, 1.0]]


def test_low_maps_are_normalised_by_the_whole_photograph_not_by_the_window() -> None:
    """Everything in the photograph is seen three times as finely by another, by one part less than by the rest."""
    raster, own, weights = RasterSettings(), at(4.0), SplatSuRe()
    photographs, asked = [own, at(4.0 / 1.14), own], list[Camera]()

    def drawn(camera: Camera) -> DrawnSplats:
        asked.append(camera)
        return broad

    broad = DrawnSplats(splats=replace(wall(), scales=torch.full((441, 3), 4.0)))
    low = weights.unscaled(broad, own, photographs, 0, raster)
    assert 0 < float(low.max()) < 0.9
    window = own.crop(10, 10, 8, 8)
    wanted = (weights.unscaled(broad, window, photographs, 0, raster) - low.min()) / (low.max() - low.min())
    assert torch.allclose(weights(drawn, window, photographs, 0, raster), wanted.clamp(0, 1))
    assert asked == [window, own]


def test_blocks_that_contradict_the_photograph_do_not_count() -> None:
    given = torch.full((3, 2, 3), 0.5)
    result = given.repeat_interleave(2, 1).repeat_interleave(2, 2)
    result[1, 0, 0] += 4 * 5 / 255  # the block's average is five levels off in one channel
    result[:, 2:, 4:] += torch.tensor([[0.2, -0.2], [-0.2, 0.2]])  # detail that averages out
    assert agreeing(result, given, 2, Reduction(), 4.0).tolist() == [[0, 0, 1, 1, 1, 1]] * 2 + [[1] * 6] * 2
    assert bool((agreeing(result, given, 2, Reduction(), 6.0) == 1).all())
    assert in_bytes(torch.tensor([[0.0, 0.5, 1.0]])).tolist() == [[0, 128, 255]]
