"""No held-out picture is looked at before the evaluation, by whatever redraws pseudo views."""

from pathlib import Path

import pytest
from sealed import trained_sealed
from torch import Tensor

from gsx.core.data.reduction import as_blocks


def blocks(image: Tensor, *, scale: int, **more: object) -> Tensor:
    """Every pixel as a block: a function as a regenerator."""
    return as_blocks(image, scale)


CALLED = "callable", "function=test_leakage:blocks"
REGENERATORS = {
    "lanczos, identity": (("lanczos",), ("identity",)),
    "oracle, scene_restorer": (("oracle",), ("scene_restorer_brief",)),
    "scene_sr, callable": (("scene_sr_brief",), CALLED),
    "callable, scene_restorer": (CALLED, ("scene_restorer_brief",)),
}
SMALLER = ("scene.width=32", "scene.height=24", "scene.train_views=4", "scene.points=100", "iterations=16",
           "rasterizer=eager", "augmenter.upscale.checks.agreement.action=warn")  # fmt: skip
"""Thumbnails of one ray a pixel alias: even true pixels disagree with them."""


@pytest.mark.parametrize("names", REGENERATORS)
def test_a_run_needs_no_held_out_picture(names: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["augmenter=[upscale,bootstrap]", *SMALLER]
    for role, (name, *options) in zip(("upscale", "restore"), REGENERATORS[names], strict=True):
        words += [f"regenerator/{role}={name}", *(f"regenerator.{role}.{option}" for option in options)]
    run = trained_sealed(tmp_path / "run", words, monkeypatch)
    made = {path.name.split("_")[0] for path in (run.folder / "pseudo").glob("*.safetensors")}
    assert made == {"upscale", "bootstrap"}
