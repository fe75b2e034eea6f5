"""Pictures of made-up methods on a small COLMAP scene, and what the judge says of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from synthetic_colmap import synthesize, write_scene
from torch import Tensor

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene, View
from gsx.core.files import read_json
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene

QUICK = ("eval.competitor=null", "metrics.perceptual=[]")
"""Settings without networks."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A scene in a folder, reduced by two."""

    folder: Path
    scene: Scene
    split: str

    @property
    def words(self) -> list[str]:
        return [str(self.folder), "scene.downscale=2", f"scene.split={self.split}", *QUICK]

    def truths(self, factor: float) -> Iterator[tuple[View, Tensor]]:
        """Yields test views with their photos at a zoom, 8 bits."""
        for view in self.scene.test:
            finer = view.zoom(factor)
            assert finer is not None
            yield view, finer.picture()


def made_subject(folder: Path, split: str = "every:4") -> Subject:
    """Writes twelve photos of 64 x 48 px with their COLMAP model; three are test views by default."""
    folder.mkdir(parents=True)
    write_scene(synthesize(frames=12), folder)
    words = ["scene=colmap", f"scene.path={folder}", "scene.downscale=2", f"scene.split={split}"]
    return Subject(folder=folder, split=split, scene=load_scene(compose(words, plugins())))


def noisy(picture: Tensor, strength: float, seed: int = 0) -> Tensor:
    """Returns an 8-bit picture with noise."""
    noise = strength * torch.randn(picture.shape, generator=torch.Generator().manual_seed(seed))
    return (picture.float() + noise).clamp(0, 255).to(torch.uint8)


def write_method(subject: Subject, folder: Path, strength: float = 10, zooms: tuple[float, ...] = (1, 2)) -> Path:
    """Writes noisy photos as the pictures of a method: x1/NAME.png, x2/NAME.png."""
    for factor in zooms:
        (folder / f"x{factor:g}").mkdir(parents=True)
        for number, (view, truth) in enumerate(subject.truths(factor)):
            write_image(folder / f"x{factor:g}" / f"{Path(view.name).stem}.png", noisy(truth, strength, number))
    return folder


def judged(to: Path, *words: str) -> dict[str, Any]:
    """Returns comparison.json of a command."""
    assert main(["judge", *words, "--to", str(to)]) == 0
    content: dict[str, Any] = read_json(to / "comparison.json")
    return content
