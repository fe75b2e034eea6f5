"""The smallest experiment that exercises everything: the built-in scene as thumbnails, a dozen steps."""

import copy
import json
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from safetensors.torch import load_file
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.scene import Scene
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run
from gsx.core.training.trainer import train_step
from gsx.experiments.run_folder.files import LOG, REPORT, RESULTS, SPLATS
from gsx.experiments.runs.build import build
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run, start
from gsx.experiments.runs.settings import Settings

OVERRIDES = (
    "backbone=gs3d",
    "scene.width=48",
    "scene.height=36",
    "scene.train_views=6",
    "scene.test_views=2",
    "scene.points=300",
    "scene.samples=1",
    "training.test_points=2",
    "eval.flight=false",
    "device=cpu",
)

LIGHT = (
    "scene.points=120",
    "scene.train_views=3",
    "scene.test_views=1",
    "training.test_points=0",
    "rasterizer.chunk=64",
)
"""Lighter still: few points, an event every three steps at most, one picture to evaluate, the rasterizer's loop in
fewer turns."""


def words(folder: Path, *more: str) -> list[str]:
    """Command-line overrides of a tiny run in `folder`."""
    return [*OVERRIDES, f"folder={folder}", *more]


loaded: dict[str, Scene] = {}
"""Built-in scenes by their options: their points take longer to find than some runs to train."""


@cache
def composed(*more: str) -> Settings:
    """The tiny experiment in a folder that is named later."""
    return compose(words(Path("later"), *more), plugins())


def tiny_settings(folder: Path, *more: str) -> Settings:
    """The composed tiny experiment; the built-in scene is made once by each process."""
    settings = composed(*more)
    general = replace(settings.general, folder=str(folder))
    resolved = copy.deepcopy(settings.resolved) | {"folder": str(folder)}
    settings = replace(settings, general=general, resolved=resolved)
    chosen = settings.scene
    if chosen.component.name != "demo":
        return settings

    def load(options: Any) -> Scene:
        key = repr(options)
        if key not in loaded:
            loaded[key] = chosen.component.factory(options)
        return loaded[key]

    return replace(settings, scene=replace(chosen, component=replace(chosen.component, factory=load)))


def tiny_run(folder: Path, more: Sequence[str] = (), stop_after: int | None = None, evaluated: bool = True) -> Run:
    """Run the tiny experiment, interrupted after `stop_after` steps if given."""
    settings, loaded = tiny_settings(folder, *more), plugins()
    run = start(settings, loaded)
    listeners = [StopAfter(stop_after)] if stop_after is not None else []
    with loaded.listening(listeners), nullcontext() if evaluated else unevaluated():
        execute(run, settings, loaded, keep_states=True)
    return run


def unevaluated() -> Any:
    """Let runs end with their last checkpoint: evaluation and report take as long as a dozen steps."""
    return patch("gsx.experiments.runs.execute.finish")


def trained(folder: Path, steps: int, *more: str) -> Run:
    """The run after so many steps, of which nothing is kept or evaluated."""
    settings, loaded = tiny_settings(folder, *more), plugins()
    run = build(settings, load_scene(settings), folder, training=True)
    for _ in range(steps):
        train_step(run, loaded)
    return run


def stopped_at(folder: Path, more: Sequence[str], *stops: int) -> Run:
    """The run stopped after these steps, opened again each time, and at last trained to its end, unevaluated."""
    tiny_run(folder, more, stops[0])
    for stop in (*stops[1:], None):
        loaded = plugins()
        run, settings = open_run(folder, loaded, training=True)
        with loaded.listening([] if stop is None else [StopAfter(stop)]), unevaluated():
            execute(run, settings, loaded)
        assert run.step == stop or (stop is None and run.complete)
    return run


def final_tensors(folder: Path) -> dict[str, Tensor]:
    """All tensors of a run's newest checkpoint."""
    return load_file(sorted((folder / "checkpoints").glob("*.safetensors"))[-1])


def same_ending(one: Path, other: Path) -> dict[str, Tensor]:
    """Check that two runs end in the same bits; return them."""
    ours, theirs = final_tensors(one), final_tensors(other)
    assert ours.keys() == theirs.keys()
    for name, tensor in ours.items():
        assert tensor.dtype == theirs[name].dtype, name
        assert torch.equal(tensor, theirs[name]), name
    return ours


EMPTY = {SPLATS: "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n"}
"""Contents of files of a run that hold nothing, where that is not an empty text or object."""


def leave_results(folder: Path, step: int = 0) -> None:
    """Give a folder the files that it lacks of a run finished at a step, with nothing in them."""
    names = ("environment.json", "status.json", *RESULTS, LOG, REPORT, f"checkpoints/step_{step:07d}.safetensors")
    for path in (folder / name for name in names):
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text(EMPTY.get(path.name, "{}" if path.suffix == ".json" else ""))
    head = b"{}"
    path.write_bytes(len(head).to_bytes(8, "little") + head)
    sidecar = {"schema": 1, "step": step, "seconds": 0.0, "sampler": [], "views": {"train": [], "test": []}}
    path.with_suffix(".json").write_text(json.dumps(sidecar))
    if not (folder / "metrics.jsonl").exists():
        (folder / "metrics.jsonl").write_text('{"step": 1}\n')


class StopAfter:
    """Listener that does what Ctrl-C does."""

    def __init__(self, step: int) -> None:
        self.step = step

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Ask the run to stop."""
        run.progress.stopping = run.step >= self.step


class Raises:
    """Listener that ends the run after a step."""

    def __init__(self, error: BaseException, step: int = 3) -> None:
        self.error, self.step = error, step

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Raise when due."""
        if run.step == self.step:
            raise self.error
