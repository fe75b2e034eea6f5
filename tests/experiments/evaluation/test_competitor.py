"""The x1 render enlarged by an upscaler, as the competitor of a zoomed render: stand-ins that paint one grey."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
from evaluating import close, decibels, run_of
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.core.training.regenerator import RegeneratorContext, Request
from gsx.core.training.run import Run
from gsx.experiments.evaluation.competitor import Competitor, competitor_for, context_of
from gsx.experiments.evaluation.detail import Detail, Details
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.evaluation.zoom_figures import ZoomFigures, zoom_entry
from gsx.regenerators.classical import Oracle, PlainOptions, Resampled

ZOOMS = [1.0, 1.5, 2.0, 8.0]
REMEDY = "span needs spandrel: pip install 'gsx[upscalers]'"


@dataclass
class Guess:
    """Adds levels of grey to the enlarged render, or does what a test sets."""

    levels: float = 3.0
    reached: Sequence[int] = (2, 4, 8)
    requests: list[Request] = field(default_factory=list)
    contexts: list[RegeneratorContext] = field(default_factory=list)
    faulty: Callable[[Request], Tensor] | None = None
    """Result of the second request and later ones."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        assert not moved
        if beyond := [scale for scale in scales if scale not in self.reached]:
            raise ConfigError(f"guess cannot enlarge x{beyond[0]}")

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        self.contexts.append(context)
        return {}

    def regenerate(self, requests: Sequence[Request]) -> list[Tensor]:
        self.requests += requests
        if self.faulty and len(self.requests) > 1:
            return [self.faulty(request) for request in requests]
        return [larger(request) + self.levels / 255 for request in requests]

    def provenance(self) -> dict[str, Any]:
        return {"name": "guess", "networks": {"x2": {"file": "guess.onnx", "sha256": "0123456789abcdef"}}}


def larger(request: Request) -> Tensor:
    return request.image.repeat_interleave(request.scale, 1).repeat_interleave(request.scale, 2)


def evaluation_of(run: Run, competitor: Competitor | None) -> dict[str, Any]:
    lpips = LpipsOptions(trunk="", head="", net="vgg", input_range="unit")
    options = EvalOptions(zoom=[1, 2, 8], quantise=True, ssim="valid", tile_pixels=1 << 20, lpips=lpips)
    return Evaluator(run, options, competitor).evaluate()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return run_of(tmp_path)


def test_a_zoom_is_compared_with_what_an_upscaler_makes_of_the_x1_render(run: Run) -> None:
    """x1 shows 100 and 60 of 104 and 71; the guess is 103 and 63, the render 110 and 70."""
    guess = Guess()
    found = evaluation_of(run, competitor_for(run.scene, "guess", lambda: guess, ZOOMS, context_of(run, "guess")))
    entry = found["zoom"]["2"]
    assert entry["upscaled_psnr"] == close(decibels(1, 8))
    assert (entry["psnr"], entry["enlarged_psnr"]) == (close(decibels(6, 1)), close(decibels(4, 11)))
    assert entry["beats_upscaled"] is (decibels(6, 1) > decibels(1, 8))
    assert found["competitor"] == Guess().provenance()
    assert "upscaled_psnr" not in found["zoom"]["1"]
    assert found["protocol"]["hash"] == evaluation_of(run, None)["protocol"]["hash"]


def test_it_sees_the_x1_render_and_learns_from_training_views_alone(run: Run) -> None:
    guess = Guess()
    evaluation_of(run, competitor_for(run.scene, "guess", lambda: guess, ZOOMS, context_of(run, "guess")))
    [context] = guess.contexts
    assert list(context.views) == list(run.train_views)
    assert [request.view.name for request in guess.requests] == ["a", "b"]  # c has no truth at x2
    assert all(request.scale == 2 and not request.photo for request in guess.requests)
    assert guess.requests[0].image.unique() == pytest.approx(100 / 255)
    with pytest.raises(ConfigError, match="learns from renders of other models"):
        context.held_out(0.5)


def test_the_oracle_meets_the_truth_pixel_by_pixel(run: Run) -> None:
    competitor = competitor_for(
        run.scene, "oracle", lambda: Oracle(PlainOptions(name="oracle")), ZOOMS, context_of(run, "oracle")
    )
    entry = evaluation_of(run, competitor)["zoom"]["2"]
    assert entry["upscaled_psnr"] == float("inf")
    assert entry["beats_upscaled"] is False


def test_lanczos_leaves_a_flat_picture_flat(run: Run) -> None:
    competitor = competitor_for(
        run.scene, "lanczos", lambda: Resampled(PlainOptions(name="lanczos")), ZOOMS, context_of(run, "lanczos")
    )
    entry = evaluation_of(run, competitor)["zoom"]["2"]
    assert entry["upscaled_psnr"] == close(entry["enlarged_psnr"])


def test_zooms_out_of_reach_are_logged_once_and_left_out(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    """No view has a truth at x8, and x1.5 is no whole factor: both are no matter of the upscaler."""
    guess = Guess(reached=[3, 4])
    with caplog.at_level(logging.INFO):
        competitor = competitor_for(run.scene, "guess", lambda: guess, [*ZOOMS, 4.0], context_of(run, "guess"))
    assert competitor is not None
    assert competitor.scales == {4}
    assert [record.message for record in caplog.records] == [
        "no upscaled x1 render to compare with at x2: guess cannot enlarge x2"
    ]
    assert not {key for key in evaluation_of(run, competitor)["zoom"]["2"] if "upscaled" in key}


def test_a_missing_package_leaves_the_figures_out_and_logs_the_remedy(
    run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    def absent() -> Guess:
        raise ConfigError(REMEDY)

    with caplog.at_level(logging.INFO):
        assert competitor_for(run.scene, "span", absent, [1.0, 2.0, 4.0], context_of(run, "span")) is None
    assert [record.message for record in caplog.records] == [
        f"no upscaled x1 render to compare with at x2, x4: {REMEDY}"
    ]
    assert "competitor" not in evaluation_of(run, None)


def test_an_upscaler_that_cannot_learn_leaves_the_figures_out(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    @dataclass
    class Poor(Guess):
        def prepare(self, context: RegeneratorContext) -> dict[str, float]:
            raise RuntimeError("out of memory")

    with caplog.at_level(logging.INFO):
        assert competitor_for(run.scene, "guess", Poor, [2.0], context_of(run, "guess")) is None
    assert "no upscaled x1 render to compare with at x2: out of memory" in caplog.text


def test_a_run_that_was_stopped_in_its_last_step_is_evaluated(run: Run) -> None:
    guess, run.progress.stopping = Guess(), True
    competitor_for(run.scene, "guess", lambda: guess, ZOOMS, context_of(run, "guess"))
    guess.contexts[0].raise_if_stopping()


def test_without_a_zoom_nothing_is_built(run: Run) -> None:
    def unused() -> Guess:
        raise AssertionError

    assert competitor_for(run.scene, "guess", unused, [1.0, 0.5, 1.5], context_of(run, "guess")) is None


@pytest.mark.parametrize(
    ("faulty", "words"),
    [
        (lambda request: request.image, "did not return one picture of shape"),
        (lambda request: larger(request) * float("nan"), "values that are not finite"),
        (lambda request: {}["tile"], "'tile'"),
    ],
)
def test_a_failure_leaves_out_the_zoom_for_all_views(
    run: Run, caplog: pytest.LogCaptureFixture, faulty: Callable[[Request], Tensor], words: str
) -> None:
    competitor = competitor_for(run.scene, "guess", lambda: Guess(faulty=faulty), ZOOMS, context_of(run, "guess"))
    entry = evaluation_of(run, competitor)["zoom"]["2"]
    assert not {key for key in entry if "upscaled" in key}
    assert entry["psnr"] == close(decibels(6, 1))
    assert words in caplog.text


def test_results_beyond_the_range_are_clamped(run: Run) -> None:
    competitor = competitor_for(run.scene, "guess", lambda: Guess(levels=300), ZOOMS, context_of(run, "guess"))
    assert competitor is not None
    result = competitor.enlarge(torch.full((3, 4, 6), 0.5), run.scene.test[0], 2)
    assert result is not None
    assert result.unique().tolist() == [1.0]


def test_detail_is_that_of_pictures_of_all_views() -> None:
    detail = Detail(low=0.1, high=0.2, recoverable=0.1, truth_high=0.4, truth_recoverable=0.2)

    def found(*details: Details) -> dict[str, Any]:
        figures = {"psnr": 20.0, "enlarged_psnr": 19.0}
        return zoom_entry(2, [ZoomFigures("", figures, one, {}) for one in details])["detail"]

    whole, partial = {"render": detail, "upscaled": detail}, {"render": detail}
    assert list(found(whole, whole)) == ["render", "upscaled"]
    assert list(found(whole, partial)) == ["render"]
    assert found(whole, {})["upscaled"]["explained"] == pytest.approx(0.5)
