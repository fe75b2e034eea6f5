"""The figures of an evaluation, worked by hand from pictures of one grey each."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import torch
from evaluating import GROUPS, LEVELS, TRUTH, Brighter, Grey, close, decibels, run_of
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.errors import InputError
from gsx.core.quality.metrics import ssim
from gsx.experiments.evaluation.chosen_views import evenly
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.evaluation.perceptual import NamedMetric, PerceptualMetrics


def plain_options() -> EvalOptions:
    """Windows lie inside: of one grey each, so that SSIM is its first factor."""
    lpips = LpipsOptions(trunk="", head="", net="vgg", input_range="unit")
    return EvalOptions(zoom=[1, 2, 8], quantise=True, ssim="valid", tile_pixels=1 << 20, lpips=lpips)


def evaluated(folder: Path, quantise: bool = True) -> dict[str, Any]:
    return Evaluator(run_of(folder), replace(plain_options(), quantise=quantise)).evaluate()


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return evaluated(tmp_path_factory.mktemp("evaluated"))


def likeness(*pairs: tuple[float, float]) -> float:
    """Mean of (2 x y + C1) / (x^2 + y^2 + C1) over pairs of levels."""
    return fmean((2 * x * y + 2.55**2) / (x * x + y * y + 2.55**2) for x, y in pairs)


@pytest.mark.parametrize(
    ("views", "chosen"), [(3, [0, 1, 2]), (8, [*range(8)]), (10, [0, 1, 3, 4, 5, 6, 8, 9]), (24, [*range(1, 24, 3)])]
)
def test_some_views_are_looked_at_from_everywhere(views: int, chosen: list[int]) -> None:
    assert evenly(range(views), 8) == chosen


def test_means_over_views_are_means_of_their_figures(figures: dict[str, Any]) -> None:
    """100.4 is 100 in 8 bits: 10, 20 and 50 levels off."""
    assert figures["psnr"] == close(decibels(10, 20, 50))
    assert figures["ssim"] == close(likeness((100, 90), (60, 80), (200, 150)))
    assert figures["lpips"] is None
    assert [(view["name"], view["group"]) for view in figures["views"]] == list(GROUPS.items())
    assert [view["psnr"] for view in figures["views"]] == [close(decibels(level)) for level in (10, 20, 50)]


def test_groups_are_means_over_their_views(figures: dict[str, Any]) -> None:
    assert list(figures["groups"]) == ["far", "near"]
    near, far = figures["groups"]["near"], figures["groups"]["far"]
    assert (near["psnr"], near["ssim"]) == (close(decibels(10, 20)), close(likeness((100, 90), (60, 80))))
    assert (far["psnr"], far["ssim"]) == (close(decibels(50)), close(likeness((200, 150))))
    assert near["lpips"] is None


def test_a_zoom_is_compared_with_its_truth_and_with_the_enlarged_render(figures: dict[str, Any]) -> None:
    """Of the two views that have truth at x2: 110 for 104 and 70 for 71, where x1 shows 100 and 60."""
    found = figures["zoom"]["2"]
    assert found["psnr"] == close(decibels(6, 1))
    assert found["enlarged_psnr"] == close(decibels(4, 11))
    assert found["ssim"] == close(likeness((110, 104), (70, 71)))
    assert found["enlarged_ssim"] == close(likeness((100, 104), (60, 71)))
    assert (found["views"], found["beats_enlarged"]) == (2, True)


def test_zooms_have_means_of_each_group_with_truth(figures: dict[str, Any]) -> None:
    """Near views have truth at x2, the far one has none; at x1 it is its own enlargement."""
    found, own = figures["zoom"]["2"]["groups"], figures["zoom"]["1"]["groups"]
    assert list(found) == ["near"]
    assert found["near"] == {key: value for key, value in figures["zoom"]["2"].items() if key != "groups"}
    assert list(own) == ["far", "near"]
    assert (own["far"]["psnr"], own["far"]["views"]) == (close(decibels(50)), 1)
    assert (own["near"]["psnr"], own["near"]["beats_enlarged"]) == (close(decibels(10, 20)), None)
    assert "groups" not in figures["zoom"]["8"]


def test_the_other_zooms(figures: dict[str, Any]) -> None:
    """At x1 the render is its own enlargement; finer than all photographs there is nothing to compare with."""
    own = figures["zoom"]["1"]
    assert own["psnr"] == own["enlarged_psnr"] == close(decibels(10, 20, 50))
    assert (own["views"], own["beats_enlarged"]) == (3, None)
    assert list(figures["zoom"]["8"]) == ["unavailable"]


def test_a_zoom_that_loses_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """12 levels off instead of 6, and 11 as the enlargement is, which has 4 and 11."""
    monkeypatch.setitem(LEVELS, "a", {1: 100.4, 2: 116.0})
    monkeypatch.setitem(LEVELS, "b", {1: 60.0, 2: 82.0})
    found = evaluated(tmp_path)["zoom"]["2"]
    assert (found["psnr"], found["enlarged_psnr"]) == (close(decibels(12, 11)), close(decibels(4, 11)))
    assert found["beats_enlarged"] is False


def test_unquantised_renders_are_measured_as_they_are(tmp_path: Path, figures: dict[str, Any]) -> None:
    """10.4 levels off where 8 bits are 10 off; so is the enlargement, 3.6 instead of 4."""
    found = evaluated(tmp_path, quantise=False)
    assert found["psnr"] == close(decibels(10.4, 20, 50))
    assert found["zoom"]["2"]["enlarged_psnr"] == close(decibels(3.6, 11))
    assert found["protocol"]["hash"] != figures["protocol"]["hash"]


def test_the_protocol_of_defaults_keeps_its_hash(figures: dict[str, Any]) -> None:
    """Results from before `eval.rounding` and `eval.masks` stay comparable: digest of the code before them."""
    text = {key: value for key, value in figures["protocol"].items() if key not in ("zoom", "hash")}
    assert not {"rounding", "masks"} & text.keys()
    assert figures["protocol"]["hash"] == "4e444cd1677f859f"


def test_renders_are_truncated_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figures: dict[str, Any]
) -> None:
    """100.7 is 101 to the nearest level, and 100 truncated: 10 off instead of 11. At x2 109.6 is 109, 5 off."""
    monkeypatch.setitem(LEVELS, "a", {1: 100.7, 2: 109.6})
    options = replace(plain_options(), zoom=[1, 2])
    near, down = (
        Evaluator(run_of(tmp_path), replace(options, rounding=rounding)).evaluate() for rounding in ("nearest", "down")
    )
    assert (near["psnr"], down["psnr"]) == (close(decibels(11, 20, 50)), close(decibels(10, 20, 50)))
    assert (near["zoom"]["2"]["psnr"], down["zoom"]["2"]["psnr"]) == (close(decibels(6, 1)), close(decibels(5, 1)))
    assert down["protocol"]["rounding"] == "down"
    assert down["protocol"]["hash"] != near["protocol"]["hash"]


class HalfMasked(Grey):
    """The left half does not count."""

    def counted(self, camera: Camera) -> Tensor:
        columns = torch.arange(camera.width) >= camera.width // 2
        return columns.expand(camera.height, camera.width)


def test_masked_pixels_count_as_equal_on_request(tmp_path: Path) -> None:
    """Half of the squared error over all pixels: 3.01 dB more. Detail stays unknown."""
    run = run_of(tmp_path, HalfMasked)
    run.scene.provenance["masks"] = "by hand"
    left_out, black = (
        Evaluator(run, replace(plain_options(), zoom=[1, 2], masks=masks)).evaluate() for masks in ("excluded", "black")
    )
    assert left_out["psnr"] == close(decibels(10, 20, 50))
    assert black["psnr"] == close(decibels(10, 20, 50) + 10 * math.log10(2))
    assert black["zoom"]["2"]["psnr"] == close(decibels(6, 1) + 10 * math.log10(2))
    assert "detail" not in black["zoom"]["2"]
    greys = torch.full((3, 16, 24), 100 / 255), torch.full((3, 16, 24), 90 / 255)
    for grey in greys:
        grey[..., :12] = 0
    assert black["views"][0]["ssim"] == close(ssim(*greys, "valid"))
    assert black["protocol"]["hash"] != left_out["protocol"]["hash"]


def test_fitted_colours_are_those_of_the_left_half_and_judged_on_the_right(
    tmp_path: Path, figures: dict[str, Any]
) -> None:
    """The left halves are met exactly, the right ones are 5 levels off. Of the matrices that do so the least is
    t [v, v, v, 1] / (3 v^2 + 1) in each row, v and t what is shown and wanted; it holds at x2, too."""
    lpips = LpipsOptions(trunk="", head="", net="vgg", input_range="unit")
    options = EvalOptions(zoom=[1, 2], quantise=False, ssim="valid", tile_pixels=1 << 20, lpips=lpips, colours="fitted")
    found = Evaluator(run_of(tmp_path, Brighter), options).evaluate()
    assert found["psnr"] == close(decibels(5, 5, 5))

    def made(name: str) -> float:
        v, closer = (LEVELS[name][zoom] / 255 for zoom in (1, 2))
        return TRUTH[name][1] * (3 * v * closer + 1) / (3 * v * v + 1)

    off = [TRUTH[name][2] + 5 - made(name) for name in ("a", "b")]
    assert found["zoom"]["2"]["psnr"] == close(decibels(*map(abs, off)))
    assert found["zoom"]["2"]["enlarged_psnr"] == close(decibels(19, 4))
    assert "least squares" in found["protocol"]["colours"]
    assert found["protocol"]["hash"] != figures["protocol"]["hash"]


def test_a_view_of_which_nothing_would_be_judged_is_refused_by_name(tmp_path: Path) -> None:
    lpips = LpipsOptions(trunk="", head="", net="vgg", input_range="unit")
    options = EvalOptions(zoom=[1], quantise=True, ssim="inria", tile_pixels=1 << 20, lpips=lpips, colours="fitted")
    run = run_of(tmp_path, Brighter)
    view = run.scene.test[0]
    left = torch.zeros(view.camera.height, view.camera.width, dtype=torch.bool)
    left[:, : view.camera.width // 2] = True
    with pytest.raises(InputError, match=f"{view.name}: its mask covers the whole right half"):
        Evaluator(run, options).renders.evaluated_pixels(view, left)
    left[0, -1] = True
    assert Evaluator(run, options).renders.evaluated_pixels(view, left).sum() == 1


class Levels:
    """Perceptual metric of which every figure is known: the mean difference in levels of 255."""

    least = 16

    def distances(self, images: Sequence[Tensor], target: Tensor) -> list[float]:
        return [255 * float((image - target).mean()) for image in images]


def test_perceptual_figures_are_those_of_renders_and_of_their_competitor(tmp_path: Path) -> None:
    """Levels as above; requested metrics without weights have no figure."""
    lpips = LpipsOptions(trunk="", head="", net="vgg", input_range="unit")
    options = EvalOptions(zoom=[1, 2, 8], quantise=True, ssim="valid", tile_pixels=1 << 20, lpips=lpips)
    evaluator = Evaluator(run_of(tmp_path), options)
    metrics = {"levels": NamedMetric(metric=Levels(), provenance={"metric": "levels"})}
    evaluator.perceptual = PerceptualMetrics(["levels", "absent"], metrics)
    found = evaluator.evaluate()
    assert found["perceptual"] == {"levels": close(fmean((10, -20, 50))), "absent": None}
    assert found["groups"]["near"]["perceptual"]["levels"] == close(fmean((10, -20)))
    assert [view["perceptual"] for view in found["views"]] == [{"levels": close(level)} for level in (10, -20, 50)]
    assert found["zoom"]["1"]["perceptual"]["levels"]["render"] == found["perceptual"]["levels"]
    assert found["zoom"]["2"]["perceptual"] == {
        "levels": {"render": close(fmean((6, -1))), "enlarged": close(fmean((-4, -11)))}
    }
    assert list(found["zoom"]["8"]) == ["unavailable"]
    assert found["perceptual_metrics"] == {"levels": {"metric": "levels"}}


def test_counts_and_sizes(figures: dict[str, Any]) -> None:
    """The table has 50 Gaussians of 59 float32 numbers; of the two splats handed out one is in view."""
    assert (figures["primitives"], figures["visible_primitives"]) == (50, 1)
    assert figures["megabytes"] == pytest.approx(50 * 59 * 4 / 1e6)
    assert (figures["step"], figures["train_seconds"]) == (7, 3.0)
    assert figures["groups"]["near"]["visible_primitives"] == 1
