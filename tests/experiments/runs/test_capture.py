"""What gsx scenes says of a capture, against captures whose faults are known."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from small_scene import Grey
from synthetic_colmap import shipped

from gsx.core.data.camera import look_at
from gsx.core.data.images import write_image
from gsx.core.data.resize import display_from_linear, linear_from_display, to_uint8
from gsx.core.data.scene import PointCloud, View
from gsx.core.quality.sharpness import blurred, sharpness, sharpness_line
from gsx.experiments.runs.capture import (
    coverage_line,
    exposure_line,
    exposures,
    ring,
    ring_line,
    shared,
)
from gsx.experiments.runs.typed import typed
from gsx.scenes.demo import DemoOptions, load


def texture(seed: int) -> torch.Tensor:
    """Noise at all scales, 160 x 200 px."""
    generator = torch.Generator().manual_seed(seed)
    picture = torch.zeros(3, 160, 200)
    for size in (1, 2, 4, 8, 16, 32):
        coarse = torch.rand(3, 160 // size + 1, 200 // size + 1, generator=generator)
        picture += coarse.repeat_interleave(size, 1).repeat_interleave(size, 2)[:, :160, :200]
    return picture / 6


def moved(picture: torch.Tensor, pixels: int, axis: int) -> torch.Tensor:
    """Averaged over a movement along an axis, its ends repeated."""
    shifts = [picture.roll(shift, axis) for shift in range(pixels)]
    return torch.stack(shifts).mean(0)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Twelve photographs, of which two were blurred: one along the rows, one down."""
    folder = tmp_path_factory.mktemp("walk")
    for number in range(12):
        picture = texture(number)
        picture = moved(picture, 3, 2) if number == 4 else moved(picture, 6, 1) if number == 9 else picture
        write_image(folder / f"{number:02d}.png", picture)
    return sorted(folder.iterdir())


def test_blurred_photographs_are_named_whichever_way_they_moved(walk):
    found = blurred(sharpness(walk))
    assert [path.name for path, _ in found] == ["09.png", "04.png"], "worst first"
    assert all(ratio < 0.6 for _, ratio in found)
    assert "2 of 12 photos are blurred" in sharpness_line(walk)
    assert "none of 4" in sharpness_line(walk[:4])


def test_photographs_without_contrast_are_not_blamed(walk, tmp_path):
    flat = tmp_path / "03b.png"
    write_image(flat, torch.full((3, 160, 200), 0.5))
    small = tmp_path / "03c.png"
    write_image(small, torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0)))
    photos = [*walk[:4], flat, small]
    assert {path.name for path, _ in blurred(sharpness(photos))} == set()
    unknown = "2 have too few pixels or too little contrast to compare"
    assert sharpness_line(photos) == f"sharpness none of 4 photos is blurred against its neighbours; {unknown}"
    assert sharpness_line([flat, small]) == f"sharpness not known; {unknown}"


@pytest.fixture(scope="module")
def demo_scene():
    """The built-in scene, small."""
    small = {"width": 96, "height": 72, "train_views": 24, "test_views": 4, "samples": 1}
    return load(typed(DemoOptions, shipped("demo") | small, "scene"))


def test_a_photograph_that_shows_no_point_has_no_exposure(demo_scene):
    """It looks away from all points, and neither moves the others nor is named for its own."""
    away = replace(
        demo_scene.train[0], name="away", camera=look_at([9, 9, 9], [99, 99, 99], fov_x=0.5, width=96, height=72)
    )
    away = replace(away, source=Grey())
    views = [*demo_scene.train[:8], away]
    gains = exposures(views, demo_scene.points)
    assert gains is not None
    assert gains.isfinite().tolist() == [True] * 8 + [False]
    torch.testing.assert_close(gains[:8], exposures(views[:8], demo_scene.points))
    assert exposure_line(views, gains).endswith("; 1 show too few of them")


@dataclass(frozen=True)
class Brighter:
    """A source whose light is multiplied."""

    source: object
    stops: float

    def image(self, camera):
        light = linear_from_display(self.source.image(camera).float() / 255) * 2**self.stops
        return to_uint8(display_from_linear(light))

    def max_zoom(self, camera):
        return self.source.max_zoom(camera)


def test_exposures_are_found(demo_scene):
    """Of the built-in scene, whose true exposures are alike, some views made brighter or darker by known stops."""
    views = list(demo_scene.train)
    stops = torch.zeros(len(views))
    stops[1], stops[4], stops[8] = 0.4, -0.6, 0.2
    disturbed = [replace(view, source=Brighter(view.source, float(s))) for view, s in zip(views, stops, strict=True)]
    before, after = exposures(views, demo_scene.points), exposures(disturbed, demo_scene.points)
    assert before.abs().max() < 0.05, "what is behind something else is left out"
    assert (after - before - stops).abs().max() < 0.03
    line = exposure_line(views, after)
    assert f"{views[4].name} (-0.6" in line
    assert f"{views[1].name} (+0.4" in line
    assert views[8].name not in line, "within a third of a stop"


def test_points_of_no_colour_tell_nothing_of_exposure(demo_scene):
    """Random ones, as loaders make without a reconstruction."""
    generator = torch.Generator().manual_seed(0)
    cloud = demo_scene.points
    random = PointCloud(cloud.positions, torch.randint(0, 256, (len(cloud), 3), generator=generator).to(torch.uint8))
    assert exposures(list(demo_scene.train), random) is None


def test_views_that_share_little_are_named():
    seen = torch.zeros(3, 10, dtype=torch.bool)
    seen[0, :6], seen[1, :5], seen[2, 5:] = True, True, True
    assert shared(seen) == [(pytest.approx(5 / 6), 1), (1.0, 0), (pytest.approx(1 / 5), 0)]
    views = [View(f"{name}.jpg", look_at([1, 0, 0], [0, 0, 0], fov_x=1, width=8, height=8), Grey()) for name in "abc"]
    line = coverage_line(views, seen)
    assert "c.jpg (20%, with a.jpg)" in line
    assert "a.jpg (" not in line
    assert "100% in fewer than 3" in line


def around(degrees):
    return [
        View(f"{d:03d}.jpg", look_at(
            [4 * math.cos(math.radians(d)), 4 * math.sin(math.radians(d)), 1], [0, 0, 0.5], fov_x=1, width=8, height=8
        ), Grey()) for d in degrees
    ]  # fmt: skip


def test_a_gap_around_an_object_is_named_by_its_neighbours():
    views = around([*range(0, 100, 10), *range(150, 360, 10)])
    found = ring(views)
    assert sorted(found.gaps) == pytest.approx([10.0] * 30 + [60.0], abs=0.05)
    line = ring_line(views, found)
    assert "300 of 360" in line or "301 of 360" in line
    assert "60 between 090.jpg and 150.jpg" in line or "60 between 150.jpg and 090.jpg" in line


def test_one_side_of_an_object_is_no_gap():
    views = around(range(0, 120, 10))
    assert "gaps" not in ring_line(views, ring(views))


def test_a_walk_is_no_ring():
    views = [View(f"{x}", look_at([x, 0, 0], [x, 4, 0], fov_x=1, width=8, height=8), Grey()) for x in range(10)]
    assert ring(views) is None


def test_in_view():
    camera = look_at([0, -4, 0], [0, 0, 0], fov_x=math.pi / 2, width=10, height=10)
    points = torch.tensor([[0.0, 0, 0], [3.9, 0, 0], [4.1, 0, 0], [0, -5, 0]])
    assert camera.sees(points).tolist() == [True, True, False, False]
