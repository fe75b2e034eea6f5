"""Runs whose held-out pictures nobody may look at before they are evaluated."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from tiny import tiny_settings
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.scene import ImageSource, Scene, View
from gsx.core.training.run import Run
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import start


@dataclass(frozen=True)
class Sealed:
    """A source that gives no picture of a held-out camera, nor of any at its place."""

    source: ImageSource
    places: Sequence[Tensor]

    def image(self, camera: Camera) -> Tensor:
        if any(torch.allclose(camera.centre.double(), place, atol=1e-6) for place in self.places):
            raise AssertionError("a held-out picture was looked at")
        return self.source.image(camera)

    def max_zoom(self, camera: Camera) -> float:
        return self.source.max_zoom(camera)


def sealed(scene: Scene) -> Scene:
    """The built-in scene could show training views' sources at held-out places too."""
    places = [view.camera.centre.double() for view in scene.test]

    def closed(views: Sequence[View]) -> list[View]:
        return [replace(view, source=Sealed(view.source, places)) for view in views]

    return replace(scene, train=closed(scene.train), test=closed(scene.test))


def trained_sealed(folder: Path, words: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """A tiny run, all of it but the evaluation at its end."""
    evaluated = list[Run]()
    runs = "gsx.experiments.runs"
    monkeypatch.setattr(f"{runs}.open.load_scene", lambda settings: sealed(load_scene(settings)))
    monkeypatch.setattr(f"{runs}.execute.finish", lambda run, settings, plugins: evaluated.append(run))
    settings, loaded = tiny_settings(folder, *words, "training.test_points=0"), plugins()
    execute(start(settings, loaded), settings, loaded)
    (run,) = evaluated
    with pytest.raises(AssertionError, match="held-out picture"):
        run.scene.test[0].image()
    return run
