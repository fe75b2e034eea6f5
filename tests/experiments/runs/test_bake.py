"""Models that decode splats for each camera as one standard file for all."""

import logging
import math
from pathlib import Path

import pytest
import torch
from tiny import tiny_run
from torch.nn.functional import normalize

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.data.camera import look_at, offsets_from
from gsx.core.errors import InputError
from gsx.core.gaussians.quaternions import rotation_matrices
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Splats, splats_of
from gsx.core.quality.metrics import psnr
from gsx.core.training.render import render
from gsx.experiments.runs import bake as baking
from gsx.experiments.runs import export as exporting
from gsx.experiments.runs.bake import Sums, bake
from gsx.experiments.runs.open import open_run
from gsx.formats.splat_files import read_gaussians


@pytest.fixture(scope="module")
def scaffold(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scaffold") / "run"
    tiny_run(folder, ["backbone=scaffold", "iterations=30", "rasterizer=eager"])
    return folder


def test_harmonics_that_cameras_see_are_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baking, "RIDGE", 0.0)
    g = torch.Generator().manual_seed(0)
    means, dc = torch.randn(4, 3, generator=g), torch.randn(4, 3, generator=g)
    rest, logits = 0.1 * torch.randn(4, 8, 3, generator=g), torch.tensor([-1.0, 0.0, 1.0, 2.0])
    scales, quats = torch.rand(4, 3, generator=g) + 0.1, torch.randn(4, 4, generator=g)
    sums = Sums.of(6, torch.device("cpu"))
    slots = torch.tensor([0, 2, 3, 5])
    for eye in 8 * normalize(torch.randn(40, 3, generator=g), dim=1):
        camera = look_at(eye.tolist(), [0.0, 0, 0], up=(0.1, 0.2, 1), fov_x=1.0, width=20, height=20)
        colours = 0.5 + colours_of(dc[:, None], rest, offsets_from(means, camera.centre), 2) - 0.5
        splats = Splats(means=means, scales=scales, quats=quats, log_opacities=logits.sigmoid().log(), colours=colours)
        if bool((colours > 0).all()):  # harmonics end at 0, a fit does not
            sums.add(splats, slots, torch.cat([slots, torch.tensor([1])]), camera)
    assert int(sums.visits[0]) >= 9  # as many as there are coefficients
    found = sums.gaussians()
    assert torch.allclose(found.means, means)
    assert torch.allclose(found.opacity_logits, logits, atol=1e-4)
    assert torch.allclose(found.sh_dc, dc, atol=1e-2)
    assert torch.allclose(found.sh_rest, rest, atol=1e-2)

    def covariances(scales: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
        axes = rotation_matrices(quats) * scales[:, None]
        return axes @ axes.mT

    assert torch.allclose(covariances(found.log_scales.exp(), found.quats), covariances(scales, quats), atol=1e-5)


def test_what_is_not_drawn_counts_as_transparent() -> None:
    """Drawn at opacity 0.8 in one of the two cameras that could see it: 0.4; never drawn: left out."""
    sums = Sums.of(3, torch.device("cpu"))
    camera = look_at([5.0, 0, 0], [0.0, 0, 0], fov_x=1.0, width=20, height=20)
    one = Splats(means=torch.zeros(1, 3), scales=torch.ones(1, 3), quats=torch.eye(4)[:1],
                 log_opacities=torch.tensor([math.log(0.8)]), colours=torch.full((1, 3), 0.7))  # fmt: skip
    none = Splats(**{name: value[:0] for name, value in vars(one).items()})
    visited = torch.tensor([0, 1])
    sums.add(one, torch.tensor([1]), visited, camera)
    sums.add(none, torch.tensor([], dtype=torch.int64), visited, camera)
    found = sums.gaussians()
    assert len(found.means) == 1
    assert float(found.opacity_logits.sigmoid()) == pytest.approx(0.4)


def test_a_baked_model_looks_like_the_model(scaffold: Path) -> None:
    run, _ = open_run(scaffold, plugins())
    gaussians = bake(run)
    for view in run.scene.test:
        baked = render(run, view.camera, splats=splats_of(gaussians, view.camera.centre)).image
        assert psnr(baked, render(run, view.camera).image) > 30


def test_a_model_without_splats_for_all_views_is_baked_for_its_file(
    scaffold: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a plugin's may be, whose published files hold no more than others."""
    run, _ = open_run(scaffold, plugins())
    monkeypatch.setattr(exporting, "own_columns", lambda run: None)
    written = exporting.export(run, tmp_path / "x.ply")
    assert written is not None
    assert written.baked
    assert torch.equal(read_gaussians(tmp_path / "x.ply").means, bake(run).means)
    monkeypatch.setattr(exporting, "Bakeable", type(None))
    with pytest.raises(InputError, match="--view"):
        exporting.export(run, tmp_path / "y.ply")


def test_compact_formats_and_pages_of_it_are_baked_and_their_loss_is_told(
    scaffold: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger("gsx"), "propagate", True)
    caplog.set_level(logging.INFO, logger="gsx")
    for name, words in (("a.spz", []), ("b.html", []), ("c.ply", ["--bake", "2"])):
        monkeypatch.setattr("gsx.cli.dispatch.set_up_logging", lambda: None)
        caplog.clear()
        assert main(["export", str(scaffold), str(tmp_path / name), *words]) == 0
        assert "baked for all views" in caplog.text
    assert len(read_gaussians(tmp_path / "c.ply").means) > 100
    assert "at 2 times their resolution" in (tmp_path / "c.ply").read_bytes()[:2000].decode("latin-1")


def test_what_has_no_names_for_its_splats_is_refused(tmp_path: Path) -> None:
    run = tiny_run(tmp_path / "run", ["iterations=1", "rasterizer=eager"])
    run.backbone = object()  # type: ignore[assignment]
    with pytest.raises(InputError, match="cannot be baked"):
        bake(run)
