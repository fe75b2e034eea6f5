"""Enlarged photos as targets from the first step: one render serves both losses."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_pseudo_details import augmenter_of, copied_gradients, run_at
from torch import Tensor

from gsx.augmenters.checked_regenerator import MOST_GAIN, gain, gain_over_filter, request_of
from gsx.augmenters.redraw import batches
from gsx.core.data.camera import look_at
from gsx.core.errors import TrainingError
from gsx.core.quality.losses import photometric, ssim_map
from gsx.core.rasterizer import rasterize
from gsx.core.training import render as training_render
from gsx.core.training.parameter_table import gradients, zero_grad
from gsx.core.training.pseudo_views import PseudoView, pseudo_loss
from gsx.core.training.trainer import backward

TOGETHER = (
    *("augmenter=super_resolved", "augmenter.super_resolved.least_gain=0"),
    *("training.supersampling.factor=2", "training.supersampling.start=0"),
)


def random_picture(seed: int) -> Tensor:
    return torch.rand(3, 20, 24, generator=torch.Generator().manual_seed(seed))


def pseudo_view(target: Tensor, pixel_weight: Tensor | None = None) -> PseudoView:
    camera = look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=24, height=20)
    return PseudoView(camera=camera, target=target, parent=0, pixel_weight=pixel_weight)


def test_the_photos_loss_of_a_pseudo_view() -> None:
    image, target = random_picture(0), (random_picture(1) * 255).to(torch.uint8)
    truth = target.float() / 255
    found = float(pseudo_loss(image, pseudo_view(target), ssim_weight=0.2))
    assert found == pytest.approx(float(photometric(image, truth, 0.2)), rel=1e-5)
    half = torch.zeros(20, 24, dtype=torch.uint8)
    half[:, :12] = 255
    counted = (half > 0).float()  # what does not count is black in both, as in the loss of photos
    unlike = 1 - ssim_map(image * counted, truth * counted)
    by_hand = 0.8 * (image - truth).abs()[..., :12].sum() + 0.2 * unlike[..., :12].sum()
    found = float(pseudo_loss(image, pseudo_view(target, half), ssim_weight=0.2))
    assert found == pytest.approx(float(by_hand) / image.numel(), rel=1e-5)


def test_one_render_serves_both_losses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """0.2 photometric(reduced render, photo) + 0.8 photometric(render, enlarged photo), with its gradients."""
    run = run_at(tmp_path / "run", 1, *TOGETHER)
    picked = run.sampler.count - 1
    run.sampler.order = [picked]
    drawn = list[tuple[int, int]]()

    def counted(splats, camera, *arguments, **named):
        drawn.append(camera.size)
        return rasterize(splats, camera, *arguments, **named)

    monkeypatch.setattr(training_render, "rasterize", counted)
    step = backward(run)
    found = copied_gradients(run)
    zero_grad(run.backbone.table)
    view = run.scene.train[picked]
    (pseudo,) = augmenter_of(run).views[picked]
    assert drawn == [pseudo.camera.size] == [(96, 72)]
    splats = run.backbone.draw(view.camera, run.step + 1).splats
    image = rasterize(splats, view.camera.zoom(2), run.raster, background=run.background).image
    own = photometric(run.scene.reduction.unclamped(image, 2), view.image(), 0.2)
    loss = 0.2 * own + 0.8 * photometric(image, pseudo.target.float() / 255, 0.2)
    loss.backward()
    assert float(step.loss) == pytest.approx(float(loss.detach()), rel=1e-5)
    for name, gradient in gradients(run.backbone.table).items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-3, atol=1e-7, msg=name)


def test_a_longer_run_goes_on_with_its_pictures(tmp_path: Path) -> None:
    """The only event was at step 1, for fewer steps."""
    augmenter = augmenter_of(run := run_at(tmp_path / "run", 1, *TOGETHER))
    assert augmenter.term(run, 2, 0) is not None
    longer = augmenter_of(again := run_at(tmp_path / "again", 44, *TOGETHER, "iterations=90"))
    again.folder = run.folder
    term = longer.term(again, 45, 0)
    assert term is not None
    assert torch.equal(term.parts[0][0].target, augmenter.views[0][0].target)


def test_pictures_of_photos_follow_their_corrected_pose(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 1, *TOGETHER)
    augmenter = augmenter_of(run)
    (first, _), *_ = augmenter.term(run, 2, 0).parts
    assert first.camera.draws_as(run.scene.train[0].camera.zoom(2))
    moved = replace(run.scene.train[0].camera, translation=run.scene.train[0].camera.translation + 0.1)
    views = [replace(run.scene.train[0], camera=moved), *run.scene.train[1:]]
    run.views = replace(run.views, scene=replace(run.scene, train=views))
    (later, _), *_ = augmenter.term(run, 3, 0).parts
    assert later.camera.draws_as(moved.zoom(2))


def test_masked_pixels_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_at(tmp_path / "run", 1, *TOGETHER)
    counted = torch.ones(36, 48, dtype=torch.bool)
    counted[3:9, 5:17] = False
    monkeypatch.setattr(type(run.scene.train[0]), "counted", lambda view: counted)
    (view, _), *_ = augmenter_of(run).term(run, 2, 0).parts
    assert torch.equal(view.pixel_weight > 0, counted.repeat_interleave(2, 0).repeat_interleave(2, 1))


def test_trust_is_the_gain_over_a_filter_on_reduced_photos(tmp_path: Path) -> None:
    """0 for the filter itself, and -20 log10(0.1 / e) for an error of 0.1 where the filter has an error of e."""
    run = run_at(tmp_path / "run", 1, *TOGETHER)
    augmenter = augmenter_of(run)
    assert gain_over_filter(run, augmenter.regenerator, 2, 1) == 0
    (request,) = (request_of(run, 0, 2, 1),)
    photo, lanczos = run.scene.train[0].image(), augmenter.regenerator.regenerate([request])[0]
    error = float((lanczos - photo).square().mean().sqrt())
    off = photo + torch.where(photo > 0.5, -0.1, 0.1)
    assert gain(request, off) == pytest.approx(-20 * math.log10(0.1 / error), abs=1e-3)
    assert gain(request, photo) == MOST_GAIN
    with pytest.raises(TrainingError, match=r"is \(3, 2, 2\) and should be \(3, 36, 48\)"):
        gain(request, photo[:, :2, :2])


def test_an_upscaler_without_gain_makes_no_pseudo_views(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = run_at(tmp_path / "run", 1, *TOGETHER, least_gain=2.0)
    assert augmenter_of(run).term(run, 2, 0) is None
    assert "0.0 dB better than by Lanczos' filter < 2.0 dB, no pseudo views" in caplog.text
    assert "augmenter.super_resolved.least_gain=0 makes them all the same" in caplog.text
    run = run_at(tmp_path / "oracle", 1, *TOGETHER, "regenerator/upscale=oracle", least_gain=2.0)
    assert augmenter_of(run).trust(run, 1) == (MOST_GAIN, True)


def test_batches_are_bounded_by_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six pictures of 96 x 72 px: two of them are 13,824 px."""
    run = run_at(tmp_path / "run", 1, *TOGETHER)
    specs = list(augmenter_of(run).planner.specs(run, 1, set(range(6))))
    assert [len(batch) for batch in batches(specs)] == [6]
    monkeypatch.setattr("gsx.augmenters.redraw.BATCH_PIXELS", 13_824)
    assert [len(batch) for batch in batches(specs)] == [2, 2, 2]
    monkeypatch.setattr("gsx.augmenters.redraw.BATCH_PIXELS", 1)
    assert [one for batch in batches(specs) for one in batch] == specs


def test_large_pictures_are_announced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Six photos of 48 x 36 px at x2 are 3 * 6 * 48 * 36 * 4 bytes."""
    monkeypatch.setattr("gsx.augmenters.pseudo_details.LARGE", 1e-4)
    run = run_at(tmp_path / "run", 44, *TOGETHER)
    assert augmenter_of(run).gigabytes() == pytest.approx(124416e-9)
    (message,) = [one.message for one in caplog.records if "keeps 0.0 GB of pictures in memory" in one.message]
    remedy = message.partition("windows: ")[2].split()
    less = augmenter_of(run_at(tmp_path / "less", 44, *TOGETHER, *remedy))
    assert less.gigabytes() == pytest.approx(124416e-9 / 4)
    assert less.plan()["events"] == list(range(1, 80))
    assert less.plan()["span"] == 1


def test_one_event_covers_the_run(tmp_path: Path) -> None:
    plan = augmenter_of(run_at(tmp_path / "run", 44, *TOGETHER)).plan()
    assert plan["events"] == [1]
    assert plan["span"] >= 79
