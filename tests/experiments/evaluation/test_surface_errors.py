"""Errors of depth, by hand on painted views, and true depth of the built-in scenes against their solids."""

from pathlib import Path

import pytest
import torch
from evaluating import Grey, close, run_of
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.evaluation.surface_errors import surface_errors
from gsx.scenes.demo.cameras import spiral_camera
from gsx.scenes.demo.still_life import StillLife, make_still_life
from gsx.scenes.demo.tracing import depth_of
from gsx.scenes.room import make_room, walking_camera


class Walled(Grey):
    """A wall at 2.05 before the left half of a picture, at 4 before a quarter of it, nothing before the rest."""

    def exact_depth(self, camera: Camera) -> Tensor:
        out = torch.full((camera.height, camera.width), torch.inf)
        out[:, : camera.width // 2] = 2.05
        out[:, camera.width // 2 : 3 * camera.width // 4] = 4.0
        return out


def test_errors_of_a_model_that_is_everywhere_2_away(tmp_path: Path) -> None:
    """0.05 on two thirds of the pixels that show a wall, 2 on one third."""
    options = EvalOptions(
        lpips=LpipsOptions(trunk="", head="", net="vgg", input_range="unit"),
        zoom=[1],
        quantise=True,
        ssim="inria",
        tile_pixels=1 << 20,
    )
    evaluation = Evaluator(run_of(tmp_path, Walled), options).evaluate()
    expected = {"absolute": (2 * 0.05 + 2) / 3, "relative": (2 * 0.05 / 2.05 + 0.5) / 3, "within": 2 / 3}
    assert evaluation["depth"] == {name: close(value) for name, value in expected.items()}
    assert all(view["depth"] == pytest.approx(evaluation["depth"]) for view in evaluation["views"])
    assert "depth" not in Evaluator(run_of(tmp_path, Grey), options).evaluate()


def test_masked_pixels_and_views_of_sky_alone_have_no_error() -> None:
    truth, counted = torch.tensor([[1.0, 4.0, torch.inf]]), torch.tensor([[True, False, True]])
    figures = surface_errors(torch.tensor([[1.5, 9.0, 0.0]]), truth, counted)["depth"]
    assert figures == {"absolute": 0.5, "relative": 0.5, "within": 0.0}
    assert surface_errors(torch.ones(1, 3), truth.fill_(torch.inf), None) == {}


@pytest.mark.parametrize(
    ("life", "camera"), [(make_room(), walking_camera(0.4, 40, 30)), (make_still_life(), spiral_camera(0.1, 40, 30))]
)
def test_true_depth_lies_on_the_solids(life: StillLife, camera: Camera) -> None:
    """Signed distances, which the ray tracer does not use."""
    depth = depth_of(life, camera)
    row, column = depth.isfinite().nonzero().unbind(1)
    points = camera.unproject(torch.stack([column + 0.5, row + 0.5], 1), depth[row, column]).T
    distances = torch.stack([points[2].abs(), *(solid.distance(points).abs() for solid in life.solids)]).amin(0)
    assert len(row) > 300
    assert float(distances.max()) < 1e-4
    middle = camera.crop(7, 5, 9, 9)
    torch.testing.assert_close(depth_of(life, middle), depth[5:14, 7:16], rtol=0, atol=0)
