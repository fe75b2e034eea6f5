"""What a scene is told to be when a run loads it."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from small_scene import Grey, small_scene
from synthetic_colmap import synthesize, write_scene

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.core.errors import InputError
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import checked, load_scene


@pytest.mark.parametrize(("published", "noted"), [(11, False), (12, True), (10, True)])
def test_another_number_of_images_than_was_published_is_noted(tmp_path: Path, published: int, noted: bool) -> None:
    write_scene(synthesize("SIMPLE_PINHOLE", [80.0, 32.0, 24.0], frames=11), tmp_path / "yard")
    named = ["+dataset.scenes.yard=Yard", f"+dataset.images.yard={published}", "dataset.scene=yard"]
    scene = load_scene(compose(["dataset=own", *named, f"data_root={tmp_path}"], plugins()))
    assert [note for note in scene.notes if "published" in note] == (
        [f"images/ holds 11 files, published are {published}: figures cannot be compared with published ones."]
        if noted
        else []
    )


def odd_camera(scene: Scene) -> Scene:
    view = scene.train[2]
    return replace(scene, train=[*scene.train[:2], replace(view, camera=replace(view.camera, cx=math.nan))])


@pytest.mark.parametrize(
    ("spoilt", "told"),
    [
        (lambda scene: vars(scene), r"dict: a loader returns a gsx.core.data.scene.Scene"),
        (lambda scene: replace(scene, train=[]), "without training views"),
        (odd_camera, "camera value that is not finite, of 'view2'"),
        (lambda scene: replace(scene, test=scene.train[3:]), "with 'view3' among training and test views"),
        (
            lambda scene: replace(scene, background=torch.full((3,), 255.0)),
            r"background of \[255.0, 255.0, 255.0\]: give",
        ),
        (lambda scene: replace(scene, background=torch.zeros(1)), r"background of \[0.0\]: give"),
        (
            lambda scene: replace(scene, points=replace(scene.points, positions=scene.points.positions * math.nan)),
            "points that are not finite",
        ),
    ],
)
def test_what_a_loader_returns_is_looked_at(spoilt: Callable[[Scene], Any], told: str) -> None:
    scene = small_scene(torch.zeros(5, 3))
    other = replace(scene.train[0], camera=scene.train[1].camera)  # names may come again, as blender's do
    assert checked(replace(scene, test=[other]), "mine").test == [other]
    with pytest.raises(InputError, match=f"^scene=mine returned .*{told}"):
        checked(spoilt(scene), "mine")


class Odd(Grey):
    """Its pictures are not those of its camera."""

    def __init__(self, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
        self.change = change

    def image(self, camera: Camera) -> torch.Tensor:
        return self.change(super().image(camera))


@pytest.mark.parametrize("change", [lambda p: p / 255, lambda p: p[:1], lambda p: p[:, 1:], lambda p: p.mT])
def test_a_picture_that_is_not_its_camera_s_is_refused_by_name(
    change: Callable[[torch.Tensor], torch.Tensor],
) -> None:
    view = small_scene(torch.zeros(5, 3)).train[1]
    assert view.image().mean() == pytest.approx(128 / 255)
    with pytest.raises(InputError, match=r"view 'view1' is torch.* but its camera needs torch.uint8 \[3, 16, 24\]"):
        View(view.name, view.camera, Odd(change)).image()
