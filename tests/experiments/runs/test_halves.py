"""Models of half of the training views each: what they are shown, what they show; the run goes on untouched."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from module_contexts import build_module
from small_scene import published_options, small_scene, spread
from tiny import tiny_run
from torch import Tensor

from gsx.backbones.gs3d import gs3d
from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.errors import InputError
from gsx.core.plugins import load_plugins
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.backbone import Backbone, BackboneContext
from gsx.core.training.parameter_table import table_tensors
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.run import Run, TrainingOptions
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import train_step
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.halves import half_run, held_out_renders
from gsx.experiments.runs.open import open_run
from gsx.modules.blur import Blur, BlurOptions

TRAINING = TrainingOptions(
    ssim_weight=0.2, random_background=False, log_every=1, checkpoint_every=9, checkpoints_kept=1, test_points=0
)


class Told:
    """A photograph of one grey that tells when it is looked at."""

    def __init__(self, number: int, seen: list[int]) -> None:
        self.number, self.seen = number, seen

    def image(self, camera: Camera) -> Tensor:
        self.seen.append(self.number)
        return torch.full((3, camera.height, camera.width), 250 if self.number % 2 else 5, dtype=torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def begun(folder: Path, views: int = 5, steps: int = 20) -> tuple[Run, list[int], partial[list[Tensor]]]:
    """(a run some steps on, numbers of the photographs looked at since): odd views are bright, even ones dark."""
    seen: list[int] = []
    grey = small_scene(spread(60), extent=4.0, views=views)
    scene = replace(grey, train=[replace(view, source=Told(n, seen)) for n, view in enumerate(grey.train)])

    def anew(**facts: Any) -> Backbone:
        context = BackboneContext(device=torch.device("cpu"), raster=RasterSettings(), **facts)
        return gs3d(published_options(), context)

    generator = torch.Generator().manual_seed(0)
    resolution = TrainingViews(scene=scene, modules={"blur": build_module(Blur, BlurOptions(), scene=scene)})
    run = Run(
        config={},
        folder=folder,
        backbone=anew(scene=scene, iterations=40, generator=generator, views=resolution),
        raster=RasterSettings(),
        training=TRAINING,
        iterations=40,
        photos=PhotoCache(torch.device("cpu")),
        generator=generator,
        views=resolution,
        sampler=Sampler(views, 0),
    )
    for _ in range(steps):
        train_step(run, load_plugins([], points=[]))
    seen.clear()
    return run, seen, partial(held_out_renders, run, anew)


def test_views_are_rendered_by_a_model_that_never_saw_them(tmp_path: Path) -> None:
    """Ten steps on odd views alone, then ten on even ones; dark views come out brighter than bright ones."""
    _, seen, held_out = begun(tmp_path)
    renders = held_out(0.5, 3)
    assert len(seen) == 20
    assert all(number % 2 == 1 for number in seen[:10])
    assert all(number % 2 == 0 for number in seen[10:])
    assert [tuple(render.shape) for render in renders] == [(3, 16, 24)] * 5
    bright = [float(render[:, 4:12, 6:18].mean()) for render in renders]
    assert min(bright[0::2]) > 1.5 * max(bright[1::2]), bright


def test_a_half_sees_its_views_in_one_way(tmp_path: Path) -> None:
    """What its backbone judges by knows the movements that its loss does."""
    run, *_ = begun(tmp_path, steps=0)
    run.modules["blur"].movements = {"view1": (0.1, 0.0)}
    asked = list[TrainingViews]()

    def anew(views: TrainingViews, **others: Any) -> Backbone:
        asked.append(views)
        return run.backbone

    half = half_run(run, anew, 0, 10, 3)
    assert asked == [half.views]
    assert half.modules["blur"].movements == run.modules["blur"].movements


def state_of(run: Run) -> list[Tensor]:
    values = [value.clone() for value in table_tensors(run.backbone.table).values()]
    return [*values, run.generator.get_state(), torch.random.get_rng_state(), torch.tensor(run.sampler.order)]


def test_the_run_goes_on_as_if_nothing_had_been(tmp_path: Path) -> None:
    run, _, held_out = begun(tmp_path)
    run.training = replace(TRAINING, random_background=True)
    before, seconds = state_of(run), run.progress.seconds
    held_out(0.5, 3)
    assert all(torch.equal(a, b) for a, b in zip(before, state_of(run), strict=True))
    assert (run.step, run.progress.seconds) == (20, seconds)
    undisturbed, *_ = begun(tmp_path)
    undisturbed.training = run.training
    for each in (run, undisturbed):
        train_step(each, load_plugins([], points=[]))
    assert all(torch.equal(a, b) for a, b in zip(state_of(undisturbed), state_of(run), strict=True))


def test_renders_are_kept_for_a_resumed_run_and_made_alike_without_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run, seen, held_out = begun(tmp_path)
    first = held_out(0.2, 3)
    (file,) = (tmp_path / "regenerators").glob("halves_*")
    seen.clear()
    assert all(torch.equal(a, b) for a, b in zip(first, held_out(0.2, 3), strict=True))
    assert not seen
    file.write_bytes(b"nothing")
    assert all(torch.equal(a, b) for a, b in zip(first, held_out(0.2, 3), strict=True))
    assert "rendering again" in caplog.text
    run.step = 30
    held_out(0.2, 3)
    assert [path.name for path in file.parent.glob("halves_*")] == ["halves_0000030_6.safetensors"]


def test_one_view_has_no_halves(tmp_path: Path) -> None:
    *_, held_out = begun(tmp_path, views=1, steps=1)
    with pytest.raises(InputError, match="one training view"):
        held_out(0.5, 0)


RUN = (
    "iterations=24",
    "rasterizer=eager",
    "augmenter=bootstrap",
    "regenerator/restore=scene_restorer_brief",
    "augmenter.bootstrap.timing.every=4000",
    "augmenter.bootstrap.timing.span=2000",
    "training.checkpoint_every=5",
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """One that nothing happened to."""
    return tiny_run(tmp_path_factory.mktemp("halves") / "whole", RUN)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stopped at step 13, after the event at 12."""
    folder = tmp_path_factory.mktemp("halves") / "stopped"
    tiny_run(folder, RUN, stop_after=13)
    return folder


@pytest.mark.parametrize("kept", [True, False])
def test_a_run_killed_after_its_event_makes_the_same_of_it_again(
    kept: bool, whole: Run, stopped: Path, tmp_path: Path
) -> None:
    """From the checkpoint of step 10, before the event at 12: with the file of half-models' renders, and without."""
    folder = Path(shutil.copytree(stopped, tmp_path / "killed"))
    for path in (folder / "checkpoints").glob("step_0000013*"):
        path.unlink()
    (renders,) = (folder / "regenerators").glob("halves_0000012_4.safetensors")
    if not kept:
        renders.unlink()
    run, settings = open_run(folder, plugins(), (), training=True)
    assert run.step == 10
    execute(run, settings, plugins())
    assert run.complete
    again = table_tensors(run.backbone.table)
    assert all(torch.equal(value, again[name]) for name, value in table_tensors(whole.backbone.table).items())
