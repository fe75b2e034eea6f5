"""A poisoned step changes nothing and is named; three in a row end the run."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_scene import published_options, small_gs3d, small_scene, spread
from torch import Tensor
from torch.nn import Parameter

from gsx.backbones.gs3d import GS3D
from gsx.core.data.camera import Camera
from gsx.core.errors import TrainingError
from gsx.core.plugins import Plugins, hookimpl, load_plugins
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.backbone import DrawnSplats
from gsx.core.training.parameter_table import gradients, keep_rows, table_tensors
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.run import Run, StepResult, TrainingOptions
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import train, train_step
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.guard import Guard


class Poisoned(GS3D):
    """gs3d with a term that spoils the loss, or the gradient alone, at chosen steps."""

    poison: dict[int, str] = {}  # noqa: RUF012
    now = 0

    def draw(self, camera: Camera, step: int) -> DrawnSplats:
        self.now = step
        return super().draw(camera, step)

    def regulariser(self, drawn: DrawnSplats) -> Tensor | None:
        kind = self.poison.get(self.now)
        if kind is None:
            return None
        if kind == "gradient":  # the root of 0 has value 0 and an infinite slope
            return (self.table["means"][2:4] * 0).sqrt().sum()
        return self.table["means"].sum() * 0 + float(kind)


def run_with(poison: dict[int, str], folder: Path, iterations: int = 8, points: int = 5) -> Run:
    scene = small_scene(spread(points))
    backbone = small_gs3d(scene, iterations=iterations, options=replace(published_options(), published_iterations=9))
    backbone.__class__ = Poisoned
    backbone.poison = poison
    generator = torch.Generator().manual_seed(0)
    return Run(
        config={},
        folder=folder,
        backbone=backbone,
        raster=RasterSettings(),
        training=TrainingOptions(
            ssim_weight=0.2, random_background=False, log_every=1, checkpoint_every=9, checkpoints_kept=1, test_points=0
        ),
        iterations=iterations,
        photos=PhotoCache(torch.device("cpu")),
        generator=generator,
        views=TrainingViews(scene=scene),
        sampler=Sampler(4, 0),
    )


class Diary:
    """Listener: keeps every step."""

    def __init__(self) -> None:
        self.steps: list[StepResult] = []

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        self.steps.append(step)


def train_guarded(run: Run) -> tuple[Diary, Plugins]:
    diary, plugins = Diary(), load_plugins([], points=[])
    with plugins.listening([Guard(), diary]):
        train(run, plugins)
    return diary, plugins


def state(run: Run) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in table_tensors(run.backbone.table).items()}


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("nan", "the loss is nan"),
        ("inf", "the loss is inf"),
        ("gradient", "the gradient of means is not finite in 2 of 5 rows"),
    ],
)
def test_a_poisoned_step_changes_nothing_and_names_the_culprit(
    kind: str, reason: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run, plugins = run_with({2: kind}, tmp_path), load_plugins([], points=[])
    with plugins.listening([Guard()]):
        assert train_step(run, plugins).skipped == ""
        before = state(run)
        with caplog.at_level(logging.WARNING, "gsx.experiments.runs.guard"):
            bad = train_step(run, plugins)
        assert bad.skipped == reason
        assert f"step 2 on view {bad.view.name} skipped: {reason}" in caplog.text
        assert run.step == 2
        after = state(run)
        assert after.keys() == before.keys()
        assert all(torch.equal(after[name], before[name]) for name in before)
        assert gradients(run.backbone.table) == {}
        assert train_step(run, plugins).skipped == ""
        assert not torch.equal(state(run)["parameters.means"], before["parameters.means"])
        assert all(torch.isfinite(value).all() for value in state(run).values())


def test_unguarded_the_same_step_spoils_the_run(tmp_path: Path) -> None:
    run, plugins = run_with({2: "gradient"}, tmp_path), load_plugins([], points=[])
    train_step(run, plugins)
    train_step(run, plugins)
    assert not torch.isfinite(state(run)["parameters.means"]).all()


def test_three_bad_steps_in_a_row_end_the_run(tmp_path: Path) -> None:
    run = run_with({3: "nan", 4: "gradient", 5: "inf"}, tmp_path)
    with pytest.raises(TrainingError, match=r"3 steps in a row .* at step 5, view view\d: the loss is inf; .*lower"):
        train_guarded(run)
    assert run.step == 4  # the third is not counted as done


def test_a_good_step_between_starts_the_count_anew(tmp_path: Path) -> None:
    run = run_with({2: "nan", 3: "nan", 5: "nan", 6: "gradient", 8: "nan"}, tmp_path)
    diary, _ = train_guarded(run)
    assert [bool(step.skipped) for step in diary.steps] == [False, True, True, False, True, True, False, True]
    assert run.complete


def test_finite_gradients_of_any_shape_pass_and_others_are_counted_by_row(tmp_path: Path) -> None:
    run = run_with({}, tmp_path)
    step = train_step(run, load_plugins([], points=[]))
    odd = torch.ones(3, 4, 2).transpose(0, 1)  # rows that do not lie one after the other in memory
    weights = Parameter(torch.zeros(4, 3, 2))
    run.backbone.table.parameters["weights"], weights.grad = weights, odd
    assert Guard().gsx_gradients_ready(run, step) is None
    odd[1, 2, 0] = odd[3, 0, 1] = odd[3, 1, 0] = torch.nan
    reason = Guard().gsx_gradients_ready(run, step)
    assert reason == "the gradient of weights is not finite in 2 of 4 rows"


def test_primitives_that_are_not_finite_are_removed_and_the_run_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run, plugins = run_with({}, tmp_path), load_plugins([], points=[])
    before = len(run.backbone.table)
    with plugins.listening([Guard()]), caplog.at_level(logging.WARNING, "gsx.core.training.trainer"):
        with torch.no_grad():
            run.backbone.table["log_scales"][1] = torch.nan
        skipped, after = train_step(run, plugins), train_step(run, plugins)
    assert skipped.skipped == "removed 1 primitives"
    assert not after.skipped
    assert after.rendering.dropped == 0
    assert len(run.backbone.table) == len(run.backbone.table.statistics["count"]) == before - 1
    assert "removed 1 primitives with values that are not finite" in caplog.text


def test_a_run_that_loses_a_part_of_its_model_at_once_ends(tmp_path: Path) -> None:
    """Of 2,000 primitives 20 may go, 21 may not; of few any ten."""
    for count, lost, ends in ((2000, 20, False), (2000, 21, True), (12, 10, False), (12, 11, True)):
        run, plugins = run_with({}, tmp_path, points=count), load_plugins([], points=[])
        with torch.no_grad():
            run.backbone.table["log_scales"][:lost] = torch.nan
        if not ends:
            assert train_step(run, plugins).skipped == f"removed {lost} primitives"
            continue
        with pytest.raises(
            TrainingError, match=rf"step 1: {lost} of {count:,} primitives have values .* learning rates"
        ):
            train_step(run, plugins)


def test_a_run_without_a_primitive_ends(tmp_path: Path) -> None:
    run = run_with({}, tmp_path)
    keep_rows(run.backbone.table, torch.zeros(len(run.backbone.table), dtype=torch.bool))
    plugins = load_plugins([], points=[])
    with plugins.listening([Guard()]), pytest.raises(TrainingError, match="no primitive is left after step 1"):
        train(run, plugins)
