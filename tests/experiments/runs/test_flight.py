"""The flight into the detail, and depth as colours, against hand-worked cameras and distances."""

import itertools
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch
from raster_scenes import front_camera, random_splats
from small_scene import small_scene

from gsx.core.data.camera import look_at
from gsx.core.errors import InputError, TooManyPairs
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.experiments.evaluation import evaluated_renders
from gsx.experiments.reports.pictures import colour_ramp
from gsx.experiments.runs import evaluate as evaluation
from gsx.experiments.runs.flight import FRAMES, LONGEST, depth_colours, flight

CAMERA = look_at([0, -4, 1], [0, 0, 0], fov_x=0.9, width=640, height=480)


def test_a_flight_begins_with_the_whole_and_ends_in_the_window():
    """A window of 64 x 48 px whose middle is at (480, 120) of 640 x 480, ten times as fine."""
    cameras = flight(CAMERA, (0.75, 0.25), 10.0)
    assert len(cameras) == FRAMES
    assert {camera.size for camera in cameras} == {(LONGEST, 240)}
    whole, last = CAMERA.resize(LONGEST, 240), cameras[-1]
    assert (cameras[0].fx, cameras[0].cx, cameras[0].cy) == (whole.fx, whole.cx, whole.cy)
    points = torch.tensor([[0.3, 0.2, 0.4], [-0.2, 0.5, 0.1]], dtype=torch.float64)
    seen, expected = last.project(points)[0], (CAMERA.project(points)[0] - torch.tensor([448.0, 96.0])) * (LONGEST / 64)
    assert (seen - expected).abs().max() < 1, "within the rounding of the crop to whole pixels"
    focal = [camera.fx for camera in cameras]
    assert all(
        later / earlier == pytest.approx(10 ** (1 / (FRAMES - 1)), rel=0.02)
        for earlier, later in itertools.pairwise(focal)
    )


def test_a_window_at_the_border_stays_inside():
    for camera in flight(CAMERA, (1.0, 0.0), 4.0):
        low, high = camera.cx - CAMERA.cx / CAMERA.fx * camera.fx, camera.fx / CAMERA.fx * CAMERA.width
        assert -1 <= -low <= high - camera.width + 1


def test_depth_is_that_of_the_rasterizer_without_what_stands_behind_the_scene(monkeypatch: pytest.MonkeyPatch):
    """One large splat a thousand units behind 200 others, which cover some of the picture half."""
    splats, camera, rules = random_splats(200, seed=3), front_camera(), RasterSettings(path="eager")
    middle = camera.centre + 1000.0 * camera.rotation[2]
    with_sky = Splats(
        means=torch.cat([splats.means, middle[None].float()]),
        scales=torch.cat([splats.scales, torch.full((1, 3), 500.0)]),
        quats=torch.cat([splats.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0]])]),
        log_opacities=torch.cat([splats.log_opacities, torch.tensor([-0.01])]),
        colours=torch.cat([splats.colours, torch.ones(1, 3)]),
    )
    monkeypatch.setattr(evaluated_renders, "splats_for", lambda run, camera: with_sky)
    last = len(splats.means)
    monkeypatch.setattr(evaluated_renders, "behind_scene", lambda backbone, means: torch.arange(len(means)) == last)
    run = SimpleNamespace(raster=rules, scene=small_scene(splats.means), backbone=None)
    depth, coverage = evaluated_renders.depth_and_coverage(run, camera, 1 << 20)
    drawn = rasterize(splats, camera, rules, depth=True)
    torch.testing.assert_close(depth, drawn.depth, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(coverage, drawn.alpha, rtol=1e-5, atol=1e-6)
    assert 0.1 < coverage.mean() < 0.9, "near splats cover some of the sky"


def test_depth_is_coloured_by_its_inverse():
    """Two halves, 2 and 8 units away, half covered pixels among them; nothing in one row."""
    alpha = torch.ones(20, 20)
    alpha[5], alpha[0] = 0.6, 0.3
    depth = torch.full((20, 20), 2.0)
    depth[:, 10:] = 8.0
    picture, limits = depth_colours(depth * alpha, alpha)
    assert limits == pytest.approx([2.0, 8.0], rel=1e-5)
    bright, dark = colour_ramp(torch.tensor([[1.0, 0.1]]))[:, 0].T
    assert torch.allclose(picture[:, 5, 3], bright, atol=1e-5), "covering counts for nothing"
    assert torch.allclose(picture[:, 7, 15], dark, atol=1e-5)
    assert picture[:, 0].abs().max() == 0


@pytest.mark.parametrize(
    ("error", "told"), [(TooManyPairs("4 pairs"), True), (MemoryError(), True), (InputError("disk full"), False)]
)
def test_what_cannot_be_drawn_is_done_without_and_what_cannot_be_written_ends_the_evaluation(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, error: Exception, told: bool
):
    def fails(*_):
        raise error

    monkeypatch.setattr(evaluation, "add_depth", fails)
    with nullcontext() if told else pytest.raises(InputError, match="disk full"):
        evaluation.add_depth_and_flight(None, None, SimpleNamespace(tile_pixels=1, flight=True))
    assert ("no depth or flight" in caplog.text) is told


def test_depth_of_nothing():
    assert depth_colours(torch.zeros(4, 4), torch.zeros(4, 4)) == (pytest.approx(torch.zeros(3, 4, 4)), [])
