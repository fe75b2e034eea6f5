"""Which pixels count: sampling by hand, and agreement with the photograph."""

import pytest
import torch

from gsx.augmenters.pixel_weights import (
    agreeing,
    best_densities,
    blended,
    densities,
    in_bytes,
    sampled_better,
    sampling_ratios,
    seen_alike,
)
from gsx.augmenters.pseudo_options import WEIGHT_MAPS
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.reduction import Reduction
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings


def at(distance: float, width: int = 40, target: float = 0.0) -> Camera:
    return look_at([target, -distance, 0.0], [target, 0.0, 0.0], fov_x=0.9, width=width, height=width)


def test_densities_are_pixels_per_unit() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [9.0, 0.0, 0.0], [0.0, -9.0, 0.0]])
    camera = at(4.0)
    found = densities(points, camera)
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
    assert (middle(sampled_better(wall(), own.zoom(zoom), [own], raster)) > 0.9) == counts
    assert middle(sampled_better(wall(), own.zoom(zoom), [own, at(0.8)], raster)) < 0.1


def test_only_the_part_that_the_nearer_photograph_shows_does_not_count() -> None:
    """A photograph from 1 unit away sees about a unit of the wall, on the left."""
    own = at(4.0)
    trust = sampled_better(wall(), own.zoom(2), [own, at(1.0, target=-0.6)], RasterSettings())
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


@pytest.mark.parametrize("scale", [0.2, 0.002])
@pytest.mark.parametrize(("distances", "ratio"), [((1.0, 4.0), 4.0), ((4.0, 4.2), 1.05), ((2.0, 3.0, 4.0), 2.0)])
def test_splats_are_sampled_as_finely_as_their_nearest_camera_over_their_farthest(
    scale: float, distances: tuple[float, ...], ratio: float
) -> None:
    """On the axis a sphere is fx s / z wide, whatever the dilation, which at 0.002 is all there is to be seen."""
    splats, cameras = dots((0.0, 0.0, 0.0), scale=scale), [at(distance) for distance in distances]
    assert float(sampling_ratios(splats, cameras, RasterSettings())) == pytest.approx(ratio, rel=1e-2)


def test_only_training_views_that_see_a_splat_count() -> None:
    """Beside the near camera's field of view only the far one sees; behind both, and far off, none."""
    splats = dots((0.0, 0.0, 0.0), (1.6, 0.0, 0.0), (0.0, -9.0, 0.0), (500.0, 0.0, 0.0), scale=0.05)
    ratios = sampling_ratios(splats, [at(1.0), at(4.0)], RasterSettings())
    assert ratios.tolist() == pytest.approx([4.0, 1.0, 1.0, 1.0], rel=1e-2)


@pytest.mark.parametrize(("distances", "published", "ours"), [
    ((1.0, 4.0), 0.0, 0.0),  # the near photograph has the detail
    ((4.0, 4.0), 0.8808, 1.0),  # ratio 1: 1 - sigmoid(-2)
    ((4.0, 4.2), 0.7311, 1.0),  # 1 - sigmoid(-1)
    ((4.0, 8.0), 0.0, 1.0),  # the nearest photograph itself, zoomed in: only its own distance counts for ours
])  # fmt: skip
def test_the_published_weights_by_hand(distances: tuple[float, ...], published: float, ours: float) -> None:
    """A wall seen from 4 units through twice the focal length, beside photographs at these distances."""
    raster, own, photographs = RasterSettings(), at(4.0).zoom(2), [at(distance) for distance in distances]
    assert (WEIGHT_MAPS["splatsure"], WEIGHT_MAPS["finer"]) == (seen_alike, sampled_better)
    drawn = seen_alike(wall(), own, photographs, raster) / blended(torch.ones(441), wall(), own, raster)
    assert middle(drawn) == pytest.approx(published, abs=0.03)
    assert middle(sampled_better(wall(), own, photographs, raster)) == pytest.approx(ours, abs=0.1)


def test_blocks_that_contradict_the_photograph_do_not_count() -> None:
    given = torch.full((3, 2, 3), 0.5)
    result = given.repeat_interleave(2, 1).repeat_interleave(2, 2)
    result[1, 0, 0] += 4 * 5 / 255  # the block's average is five levels off in one channel
    result[:, 2:, 4:] += torch.tensor([[0.2, -0.2], [-0.2, 0.2]])  # detail that averages out
    assert agreeing(result, given, 2, Reduction(), 4.0).tolist() == [[0, 0, 1, 1, 1, 1]] * 2 + [[1] * 6] * 2
    assert bool((agreeing(result, given, 2, Reduction(), 6.0) == 1).all())
    assert in_bytes(torch.tensor([[0.0, 0.5, 1.0]])).tolist() == [[0, 128, 255]]
