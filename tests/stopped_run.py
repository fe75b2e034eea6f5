"""A tiny run that is interrupted several times, and the words that make it lighter still."""

from collections.abc import Sequence
from pathlib import Path

from tiny import StopAfter, tiny_run

from gsx.builtin import plugins
from gsx.core.training.run import Run
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run

LIGHT = (
    "scene.points=120",
    "scene.train_views=3",
    "scene.test_views=1",
    "training.test_points=0",
    "rasterizer.chunk=64",
)
"""Few points, an event every three steps at most, one picture to evaluate, the rasterizer's loop in fewer turns."""


def stopped_at(folder: Path, more: Sequence[str], *stops: int) -> Run:
    """The run stopped after each of these steps, each time opened from its folder again, and at last run to its end."""
    tiny_run(folder, more, stops[0])
    for stop in (*stops[1:], None):
        loaded = plugins()
        run, settings = open_run(folder, loaded, training=True)
        with loaded.listening([] if stop is None else [StopAfter(stop)]):
            execute(run, settings, loaded)
        assert run.step == stop or (stop is None and run.complete)
    return run
