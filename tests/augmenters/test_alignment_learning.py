"""What a regenerator gives is learnt where it belongs: true pixels sharpen zoomed renders, displaced ones move them."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from gsx.augmenters.pseudo_details import PseudoDetails
from gsx.cli import plugins
from gsx.core.config import compose
from gsx.core.material import rendered
from gsx.core.regenerator import Material, Request, displacement
from gsx.core.run import Run
from gsx.core.session import start
from gsx.core.trainer import train

SCENE = (
    "scene.width=96",
    "scene.height=72",
    "scene.train_views=6",
    "scene.test_views=2",
    "scene.points=4000",
    "scene.samples=16",
)
WORDS = (
    "iterations=160",
    "augmenter=upscale_paper",
    "augmenter.upscale.variants=0",
    "augmenter.upscale.narrow=1",
    "augmenter.upscale.direct_weight=3",
    "augmenter.upscale.timing.every=20000",
    "augmenter.upscale.timing.span=20000",
)


class Displaced:
    """The true pixels, as much too far to the right as told, in pixels of the result."""

    def __init__(self, pixels: float) -> None:
        self.pixels = pixels

    def prepare(self, material: Material) -> dict[str, float]:
        return {}

    def regenerate(self, requests: list[Request]) -> list[Tensor]:
        cameras = [request.camera.zoom(request.scale) for request in requests]
        return [
            request.view.source.image(replace(camera, cx=camera.cx + self.pixels)).float() / 255
            for request, camera in zip(requests, cameras, strict=True)
        ]


def trained(folder: Path, pixels: float | None) -> Run:
    """A run with pseudo views displaced so far; None: without any."""
    words = [*SCENE, *(WORDS if pixels is not None else WORDS[:1]), f"folder={folder}", "device=cpu"]
    run = start(compose(words, plugins()), plugins())
    if pixels is not None:
        (augmenter,) = run.augmenters
        assert isinstance(augmenter, PseudoDetails)
        setting = replace(augmenter.setting, regenerator=lambda role: Displaced(pixels))
        run = replace(run, augmenters=[PseudoDetails(augmenter.options, setting)])
    train(run, plugins())
    return run


def zoomed(run: Run) -> tuple[float, float]:
    """(PSNR, displacement in px) of renders of the training views at twice their density."""
    errors, shifts = [], []
    for view in run.scene.train:
        camera = view.camera.zoom(2)
        image, truth = rendered(run, camera), view.source.image(camera).float() / 255
        errors.append(float((image - truth).square().mean()))
        shifts.append(displacement(image, truth))
    return -10 * float(torch.tensor(errors).mean().log10()), sum(shifts) / len(shifts)


@pytest.mark.slow
def test_true_pixels_sharpen_and_displaced_ones_move_what_is_learnt(tmp_path: Path) -> None:
    """Half a pixel of the result is a quarter of one of the input: checks may let it pass, training may not hide it."""
    plain, still = zoomed(trained(tmp_path / "control", None))
    perfect, place = zoomed(trained(tmp_path / "perfect", 0.0))
    displaced, moved = zoomed(trained(tmp_path / "displaced", 0.5))
    print(plain, still, perfect, place, displaced, moved)
    assert perfect > plain + 0.5
    assert displaced < perfect - 0.5
    assert place < 0.08
    assert moved == pytest.approx(0.5, abs=0.25)
