"""Augmenters in the training loop: the hybrid loss by hand, provenance, resume, and what goes wrong."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from regenerating import of_role
from safetensors.torch import save_file
from tiny import final_tensors, same_ending, stopped_at, tiny_run, tiny_settings
from torch import Tensor

from gsx.augmenters.planner import Slot
from gsx.augmenters.pseudo_details import PseudoDetails
from gsx.augmenters.store import load_views, save_views
from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.images import read_image
from gsx.core.data.reduction import Reduction
from gsx.core.errors import ConfigError, InputError, TrainingError
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import rasterize
from gsx.core.training.augmenter import Augmenter
from gsx.core.training.parameter_table import gradients, zero_grad
from gsx.core.training.pseudo_views import PseudoView, Term, pseudo_loss
from gsx.core.training.regenerator import RegeneratorContext
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.core.training.trainer import backward
from gsx.experiments.runs.build import build
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run, start
from gsx.experiments.runs.settings import Settings

PLAIN = ("regenerator/upscale=lanczos", "regenerator/restore=identity", "rasterizer=eager")


def settings_of(folder: Path, *words: str) -> Settings:
    """A tiny run of 80 steps. Windows are long enough for every training view to be picked in them."""
    chosen = [name for name in ("upscale", "bootstrap") if any("augmenter=" in w and name in w for w in words)]
    long = [f"augmenter.{name}.timing.{key}=4000" for name in chosen for key in ("every", "span")]
    if "bootstrap" in chosen:
        long.append("augmenter.bootstrap.timing.start=" + ("22000" if "upscale" in chosen else "20000"))
    return tiny_settings(folder, "iterations=80", *PLAIN, *long, *words)


def run_at(folder: Path, step: int, *words: str, **options: Any) -> Run:
    """A run that stands at a step without having been trained there; options: of its augmenter."""
    folder.mkdir()
    settings = settings_of(folder, *words)
    chosen = {name: replace(one, options=replace(one.options, **options)) for name, one in settings.augmenters.items()}
    settings = replace(settings, augmenters=chosen)
    run = build(settings, load_scene(settings), folder, training=True)
    run.step = step
    return run


def augmenter_of(run: Run, number: int = 0) -> PseudoDetails:
    found = list(run.augmenters.values())[number]
    assert isinstance(found, PseudoDetails)
    assert isinstance(found, Augmenter)
    return found


def by_options(run: Run, **changes: Any) -> PseudoDetails:
    """The run's first augmenter with other options."""
    old = augmenter_of(run)
    return PseudoDetails(replace(old.options, **changes), old.context)


# -- the loss ----------------------------------------------------------------------------------------------------------


def copied_gradients(run: Run) -> dict[str, Tensor]:
    return {name: gradient.clone() for name, gradient in gradients(run.backbone.table).items()}


def picture(run: Run, camera: Camera) -> Tensor:
    """What the next step sees."""
    splats = run.backbone.draw(camera, run.step + 1).splats
    return rasterize(splats, camera, run.raster, background=run.background).image


def own_loss(run: Run, view: int) -> Tensor:
    camera, truth = run.scene.train[view].camera, run.scene.train[view].image()
    drawn = run.backbone.draw(camera, run.step + 1)
    image = rasterize(drawn.splats, camera, run.raster, background=run.background).image
    extra = run.backbone.regulariser(drawn)
    loss = photometric(image, truth, 0.2)
    return loss if extra is None else loss + extra


@pytest.mark.parametrize(("backbone", "mode", "taken"), [
    ("octree_scaffold", "auto", 0.1),
    ("gs3d", "auto", 0.0),
    ("gs3d", "hybrid", 0.1),
    ("octree_scaffold", "direct", 0.0),
])  # fmt: skip
def test_the_hybrid_loss_by_hand(backbone: str, mode: str, taken: float, tmp_path: Path) -> None:
    """(1 - lambda) L_o + lambda / M sum L1, or L_o + 1 / M sum L1, with its gradients."""
    run = run_at(tmp_path / "run", 44, f"backbone={backbone}", "augmenter=upscale_paper", mode=mode)
    picked = run.sampler.count - 1
    run.sampler.order = [picked]
    step = backward(run)
    found = copied_gradients(run)
    zero_grad(run.backbone.table)
    views = augmenter_of(run).views[picked]
    assert len(views) == 3
    losses = [pseudo_loss(picture(run, view.camera), view) for view in views]
    weight = taken or 1.0
    pseudo = weight * torch.stack(losses).mean()
    whole = (1 - taken) * own_loss(run, picked) + pseudo
    whole.backward()
    assert float(step.loss) == pytest.approx(float(whole.detach()), rel=1e-5)
    assert step.terms["upscale"] == pytest.approx(float(pseudo.detach()), rel=1e-5)
    assert step.terms["own"] + step.terms["upscale"] == pytest.approx(float(step.loss), rel=1e-5)
    for name, gradient in gradients(run.backbone.table).items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-3, atol=1e-7, msg=name)


def test_bootstrapping_takes_its_share_without_a_colour_network_too(tmp_path: Path) -> None:
    """(1 - lambda_b) L_o + L_b + sum L1 / M: only the upscaling term is added."""
    run = run_at(tmp_path / "run", 44, "backbone=gs3d", "augmenter=[upscale_paper,bootstrap]")
    run.sampler.order = [0]
    step = backward(run)
    zero_grad(run.backbone.table)
    assert step.terms["own"] == pytest.approx(0.85 * float(own_loss(run, 0).detach()), rel=1e-4)


def test_the_published_loss_of_splatsure_weighs_photos_by_0_6(tmp_path: Path) -> None:
    """0.6 L_o + 0.4 mean W |render - target|: W from the weight map, and a mean over all pixels."""
    words = ("backbone=gs3d", "augmenter=upscale")
    published = {"mode": "hybrid", "weights": [0.4, 0.4], "loss": "l1", "gain": 1.0, "scales": [2], "window": "center"}
    run = run_at(tmp_path / "run", 60, *words, weight_map="splatsure", **published)
    run.sampler.order = [0]
    step = backward(run)
    zero_grad(run.backbone.table)
    (view,) = augmenter_of(run).views[0]
    assert view.pixel_weight is not None
    weights = view.pixel_weight.double() / 255
    assert 0.02 < float(weights.mean()) < 0.98
    off = (picture(run, view.camera).detach() - view.target / 255).abs().double()
    assert step.terms["upscale"] == pytest.approx(0.4 * float((off * weights).sum() / off.numel()), rel=1e-4)
    assert step.terms["own"] == pytest.approx(0.6 * float(own_loss(run, 0).detach()), rel=1e-4)


def test_density_control_counts_what_lies_in_the_window(tmp_path: Path) -> None:
    """Of the window's render, not of the whole zoomed canvas that it is cut from."""
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper")
    view = run.scene.train[0].camera.crop(18, 13, 12, 9).zoom(2)
    rendering = rasterize(run.backbone.draw(view, run.step + 1).splats, view, run.raster)
    places, depth = view.project(run.backbone.table["means"].detach())  # type: ignore[attr-defined]
    seen = rendering.screen.ids[rendering.screen.visible]
    radii = rendering.screen.radii[rendering.screen.visible].float()
    far = ((places[seen] < -radii[:, None] - 16) | (places[seen] > radii[:, None] + 16 + torch.tensor([24, 18]))).any(1)
    assert len(seen) > 0
    assert not far.any()
    assert float(depth[seen].min()) > 0


def test_two_augmenters_take_both_their_shares(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "backbone=octree_scaffold", "augmenter=[upscale_paper,bootstrap]")
    run.sampler.order = [0]
    step = backward(run)
    zero_grad(run.backbone.table)
    assert step.terms["own"] == pytest.approx(0.75 * float(own_loss(run, 0).detach()), rel=1e-4)
    assert list(step.terms) == ["own", "upscale", "bootstrap"]


def test_frozen_pseudo_views_leave_the_colour_network_to_the_photographs(tmp_path: Path) -> None:
    """de-MLP: its gradient is that of (1 - lambda) L_o alone, while anchors feel the pseudo views."""
    words = ("backbone=octree_scaffold", "augmenter=bootstrap")
    run = run_at(tmp_path / "run", 40, *words, freeze_shared="active")
    run.sampler.order = [1]
    backward(run)
    found = copied_gradients(run)
    zero_grad(run.backbone.table)
    (0.85 * own_loss(run, 1)).backward()
    alone = copied_gradients(run)
    colour = [name for name in alone if name.startswith("heads.colour")]
    assert colour
    for name in colour:
        torch.testing.assert_close(found[name], alone[name], rtol=1e-4, atol=1e-8)
    assert not torch.allclose(found["features"], alone["features"], rtol=1e-2, atol=1e-9)
    assert not torch.allclose(found["heads.opacity.0.weight"], alone["heads.opacity.0.weight"], rtol=1e-3, atol=1e-9)


def test_freezing_for_half_of_a_window(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper")
    half = by_options(run, freeze_shared="half")
    view = PseudoView(camera=run.scene.train[0].camera, target=torch.zeros(3, 36, 48, dtype=torch.uint8), parent=0)
    half.views = {0: [view]}
    terms = [half.weighted(run, 0, 0.0, place) for place in (0.0, 0.49, 0.5, 1.0)]
    assert [term.shared for term in terms] == [False, False, True, True]


def test_trust_weighs_pixels() -> None:
    target = torch.zeros(3, 2, 2, dtype=torch.uint8)
    pixel_weight = torch.tensor([[255, 0], [51, 0]], dtype=torch.uint8)
    camera = compose_camera()
    view = PseudoView(camera=camera, target=target, parent=0, pixel_weight=pixel_weight)
    assert float(pseudo_loss(torch.full((3, 2, 2), 0.5), view)) == pytest.approx(0.5 * 1.2 / 4)
    assert float(pseudo_loss(torch.full((3, 2, 2), 0.5), replace(view, pixel_weight=None))) == pytest.approx(0.5)


@pytest.mark.parametrize("strength", [[0.1, 0.0], [0.0, 0.1]])
def test_strengths_are_measured_by_the_largest(strength: list[float], tmp_path: Path) -> None:
    """Also where the first is none."""
    run = run_at(tmp_path / "run", 44, "augmenter=upscale")
    augmenter = by_options(run, strength=strength)
    (spec, *_) = augmenter.planner.specs(run, augmenter.events[0], {0})
    request = augmenter.redrawer.request(run, augmenter.events[0], spec)
    assert (request.strength, request.strongest) == (strength[0], 0.1)


@pytest.mark.parametrize("background", ["false", "true"])
def test_squares_of_two_scales(background: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """0.32 / 2 times the mean squares, by hand; the photograph's own scale is drawn once, unless backgrounds differ."""
    words = ("augmenter=upscale", *["training.random_background=true"] * (background == "true"))
    run = run_at(tmp_path / "run", 60, *words, gain=0.32)
    run.sampler.order = [2]
    renders = []
    monkeypatch.setattr("gsx.core.training.render.rasterize", lambda *a, **k: renders.append(a) or rasterize(*a, **k))
    step = backward(run)
    assert len(renders) == (3 if background == "true" else 2)
    found = copied_gradients(run)
    zero_grad(run.backbone.table)
    views = augmenter_of(run).views[2]
    assert [(view.provenance["scale"], view.camera.size) for view in views] == [(1, (48, 36)), (2, (48, 36))]
    assert torch.equal(views[0].target.float() / 255, run.scene.train[2].image())
    pseudo = torch.zeros(())
    for view in views:
        pseudo = pseudo + 0.16 * (picture(run, view.camera) - view.target.float() / 255).square().mean()
    assert step.terms["upscale"] == pytest.approx(float(pseudo.detach()), rel=1e-5)
    if background == "true":
        return
    whole = own_loss(run, 2) + pseudo
    whole.backward()
    assert float(step.loss) == pytest.approx(float(whole.detach()), rel=1e-5)
    for name, gradient in gradients(run.backbone.table).items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-3, atol=1e-7, msg=name)


def test_what_is_known_at_a_lower_resolution_counts_by_squares_too(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 60, "augmenter=upscale")
    augmenter_of(run).term(run, 61, 2)
    views = augmenter_of(run).views[2]
    coarse = replace(views[1], coarse=torch.zeros(3, 18, 24, dtype=torch.uint8), coarse_weight=2.0)
    grey = views[1].target.float() / 255
    low = torch.nn.functional.avg_pool2d(grey, 2)
    assert float(pseudo_loss(grey, coarse, squared=True)) == pytest.approx(2 * float(low.square().mean()), rel=1e-5)


def compose_camera() -> Any:
    from gsx.core.data.camera import look_at

    return look_at([0.0, -4.0, 0.0], [0.0, 0.0, 0.0], fov_x=0.9, width=2, height=2)


def test_pixels_of_small_windows_can_weigh_like_those_of_whole_pictures(tmp_path: Path) -> None:
    """48 x 36 px: windows of 12 x 9 seen at 24 x 18 are a quarter of the pixels."""
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", per_pixel=True)
    term = augmenter_of(run).term(run, 45, 0)
    assert term is not None
    assert [weight for _, weight in term.parts] == pytest.approx([0.25 / 3] * 3)


def test_means_over_cameras_or_over_scales(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", scales=[2, 4])
    term = augmenter_of(run).term(run, 45, 0)
    assert term is not None
    assert [weight for _, weight in term.parts] == pytest.approx([1 / 6] * 6)
    per_scale = by_options(run, reduce="per_scale")
    per_scale.views = {0: [view for view, _ in term.parts]}
    term = per_scale.weighted(run, 0, 0.0, 0.0)
    assert [weight for _, weight in term.parts] == pytest.approx([1 / 2] * 6)


# -- pseudo views ------------------------------------------------------------------------------------------------------


def test_views_of_an_event(tmp_path: Path) -> None:
    """One zoomed copy of every training camera and two moved ones; the copy shows the photograph's own window."""
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper")
    augmenter_of(run).term(run, 45, 0)
    for parent, views in augmenter_of(run).views.items():
        own = run.scene.train[parent].camera
        assert [view.provenance["kind"] for view in views] == ["base", "random", "random"]
        for view in views:
            assert view.camera.size == (24, 18)
            assert view.camera.fx == 2 * own.fx
            assert view.provenance["view"] == run.scene.train[parent].name
        base = views[0]
        assert torch.equal(base.camera.rotation, own.rotation)
        assert (base.camera.cx, base.camera.cy) == (2 * (own.cx - 18), 2 * (own.cy - 13))
        low = run.scene.train[parent].image()[:, 13:22, 18:30]
        average = base.target.float().view(3, 9, 2, 12, 2).mean((2, 4)) / 255
        assert float((average - low).abs().mean()) < 0.03
        assert not torch.equal(views[1].camera.rotation, own.rotation)
        assert torch.equal(views[1].camera.translation, own.translation)
    assert sorted(augmenter_of(run).views) == list(range(6))


def test_only_views_that_a_window_asks_for_are_made_and_they_are_as_if_all_were(tmp_path: Path) -> None:
    """Two steps of six views; the same pictures as in an event that needs all of them."""
    short = ("augmenter.upscale.timing.every=1000", "augmenter.upscale.timing.span=1000")
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", *short)
    coming = [run.sampler.next(), *run.sampler.coming(1)]
    augmenter_of(run).term(run, 45, coming[0])
    few = augmenter_of(run).views
    assert sorted(few) == sorted(set(coming))
    assert run.sampler.next() == coming[1]
    whole = run_at(tmp_path / "whole", 44, "augmenter=upscale_paper")
    augmenter_of(whole).term(whole, 45, 0)
    assert sorted(augmenter_of(whole).views) == list(range(6))
    for parent, views in few.items():
        for one, other in zip(views, augmenter_of(whole).views[parent], strict=True):
            assert torch.equal(one.target, other.target)
            assert torch.equal(one.camera.rotation, other.camera.rotation)


def test_exact_projection_gives_back_the_photograph(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", project="exact")
    augmenter_of(run).term(run, 45, 0)
    for parent, views in augmenter_of(run).views.items():
        sums = views[0].target.long().view(3, 9, 2, 12, 2).sum((2, 4))
        low = (run.scene.train[parent].image()[:, 13:22, 18:30] * 255).round().long()
        assert torch.equal((2 * sums + 4) // 8, low)


def test_everything_is_reduced_as_the_scene_says(tmp_path: Path) -> None:
    """A scene reduced bicubically: projection, share, known pixels and gate go by that filter.

    These thumbnails are too harsh for it: a few of their pixels no picture between black and white reduces to.
    """
    options = {"coarse_weight": 0.5, "gate": 1.0, "project": "exact", "variants": 0}
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", **options)
    bicubic = Reduction(filter="bicubic")
    run.views = replace(run.views, scene=replace(run.scene, reduction=bicubic))
    augmenter = augmenter_of(run)
    augmenter.term(run, 45, 0)
    views = [view for views in augmenter.views.values() for view in views]
    right: list[Tensor] = []
    for view in views:
        photo = run.scene.train[view.parent].image()[:, 13:22, 18:30]
        shown = view.target.float() / 255
        off = 255 * bicubic.inner(bicubic.reduce(shown, 2) - photo).abs()  # the rim takes from beyond the window
        right.append((off <= 0.5).all(0))
        assert view.reduction == bicubic
        assert float(pseudo_loss(shown, view)) < 0.6 * float(pseudo_loss(shown, replace(view, reduction=Reduction())))
    assert float(torch.stack(right).float().mean()) > 0.95
    assert sum(view.provenance["consistent"] for view in views) > 0.95 * len(views)
    assert all(view.pixel_weight is None or float((view.pixel_weight == 255).float().mean()) > 0.9 for view in views)
    (path,) = (run.folder / "pseudo").glob("*.safetensors")
    assert {view.reduction.filter for view in load_views(path)[0]} == {"bicubic"}


def test_restored_views_show_what_the_model_shows(tmp_path: Path) -> None:
    """With the identity as regenerator targets are renders, to 8 bits: nothing to learn."""
    run = run_at(tmp_path / "run", 40, "augmenter=bootstrap")
    augmenter_of(run).term(run, 41, 0)
    views = [view for views in augmenter_of(run).views.values() for view in views]
    assert len(views) == 12
    for view in views:
        assert view.camera.size == (19, 14)
        assert float((render(run, view.camera).image - view.target.float() / 255).abs().max()) <= 0.5001 / 255


def test_the_other_reading_adds_no_zoom(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", zoom="none")
    augmenter_of(run).term(run, 45, 0)
    for views in augmenter_of(run).views.values():
        for view in views:
            assert view.camera.fx == run.scene.train[0].camera.fx
            assert view.camera.size == (24, 18)


@pytest.mark.parametrize("window", ["center", "random", "grid", "error"])
def test_windows_lie_inside_the_raster(window: str, tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", window=window)
    augmenter_of(run).term(run, 45, 0)
    places = set()
    for parent, views in augmenter_of(run).views.items():
        own = run.scene.train[parent].camera
        left, top = own.cx - views[0].camera.cx / 2, own.cy - views[0].camera.cy / 2
        assert 0 <= left <= 48 - 12
        assert 0 <= top <= 36 - 9
        places.add((left, top))
    assert (len(places) == 1) == (window == "center")


def test_only_the_first_cameras(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", first_cameras=2)
    term = augmenter_of(run).term(run, 45, 5)
    assert term is not None
    assert (list(term.parts), len(term.made) > 0) == ([], True)
    assert sorted(augmenter_of(run).views) == [0, 1]


def test_zoomed_cameras_see_finer_levels(tmp_path: Path) -> None:
    """Level of detail counts distances in focal lengths: at twice the focal length a level more is drawn (1.4).

    Anchors of all levels stand together in the middle of a picture, where D / d = 2^1.3 asks for level 1.
    """
    run = run_at(tmp_path / "run", 80, "backbone=octree_gs3d", "backbone.levels.count=6", "augmenter=upscale_paper")
    own, backbone = run.scene.train[0].camera, run.backbone
    table, distance = backbone.table, backbone.grid.levels.farthest / 2**1.3  # type: ignore[attr-defined]
    spot = (own.centre + distance * own.rotation[2]).float()
    table.columns["anchors"] = spot.expand(len(table), 3).clone()
    table.columns["level"] = (torch.arange(len(table)) % 6).to(torch.int16)
    cameras = [own, *(augmenter_of(run).planner.spec(run, Slot(44, 0, scale, 0)).camera for scale in (2, 4))]
    drawn = [table["level"][backbone.visible(camera, 80).rows].unique().tolist() for camera in cameras]  # type: ignore[attr-defined]
    assert drawn == [[0, 1], [0, 1, 2], [0, 1, 2, 3]]


def test_no_pseudo_view_comes_from_a_held_out_view(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=[upscale_paper,bootstrap]")
    held_out = {view.name for view in run.scene.test}
    run.sampler.order = [0]
    backward(run)
    for augmenter in run.augmenters.values():
        assert isinstance(augmenter, PseudoDetails)
        views = [view for views in augmenter.views.values() for view in views]
        assert views
        assert not held_out & {view.provenance["view"] for view in views}
        for view in views:
            for test in run.scene.test:
                assert not torch.allclose(view.camera.centre.double(), test.camera.centre.double(), atol=1e-6)


def test_scales_in_turn(tmp_path: Path) -> None:
    options = {"scales": [2, 4, 8], "progressive": True, "narrow": 1.0}
    augmenter = augmenter_of(run_at(tmp_path / "run", 44, "augmenter=upscale_paper", **options))
    assert [augmenter.planner.scales_of(event) for event in augmenter.events] == [[2]] * 2 + [[4]] * 2 + [[8]]


def test_a_known_lower_resolution_enters_the_loss(tmp_path: Path) -> None:
    """Only where the photograph is known: the zoomed copy of the training camera."""
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", coarse_weight=0.5)
    augmenter_of(run).term(run, 45, 0)
    base, *moved = augmenter_of(run).views[0]
    assert all(view.coarse is None for view in moved)
    assert base.coarse is not None
    assert torch.equal(base.coarse, (run.scene.train[0].image()[:, 13:22, 18:30] * 255).round().to(torch.uint8))
    grey = torch.full((3, 18, 24), 0.25)
    fine = (grey - base.target.float() / 255).abs().mean()
    low = (grey[:, :9, :12] - base.coarse.float() / 255).abs().mean()
    assert float(pseudo_loss(grey, base)) == pytest.approx(float(fine + 0.5 * low))


def test_pixels_that_a_photograph_shows_as_finely_can_be_left_out(tmp_path: Path) -> None:
    """At the training cameras' own density nothing is finer; zoomed in twice almost everything is."""
    shares = []
    for scale in (1, 2):
        run = run_at(tmp_path / f"run{scale}", 44, "augmenter=upscale_paper", weight_map="finer", scales=[scale])
        augmenter_of(run).term(run, 45, 0)
        views = [view for views in augmenter_of(run).views.values() for view in views]
        pixel_weight = [
            1.0 if view.pixel_weight is None else float(view.pixel_weight.float().mean()) / 255 for view in views
        ]
        shares.append(sum(pixel_weight) / len(pixel_weight))
    assert shares[0] < 0.5 < shares[1]


def test_windows_that_show_little_are_drawn_again(tmp_path: Path) -> None:
    """Of a scene of which nothing is left but what the left of each picture shows."""
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", variants=0, window="random", scales=[4])
    least = {}
    for wanted in (0.0, 0.8):
        alphas = []
        for parent, view in enumerate(run.scene.train):
            table = run.backbone.table  # type: ignore[attr-defined]
            places, _ = view.camera.project(table["means"].detach())
            kept = table["opacity_logits"].detach().clone()
            table["opacity_logits"].data.copy_(torch.where(places[:, :1] > 16, -30.0, 0.0).view_as(kept))
            augmenter = by_options(run, least_alpha=wanted)
            spec = augmenter.planner.spec(run, Slot(44, parent, 4, 0))
            alphas.append(float(render(run, spec.inside.of(spec.source)).alpha.mean()))
            table["opacity_logits"].data.copy_(kept)
        least[wanted] = min(alphas)
    assert least[0.0] < 0.5
    assert least[0.8] >= 0.8


@pytest.mark.parametrize(("project", "least"), [("exact", 1.0), ("none", 0.0)])
def test_the_share_of_consistent_pixels_is_told(
    project: str, least: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Lanczos' filter does not give the photograph back when it is averaged; its exact projection does."""
    caplog.set_level("INFO")
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", project=project)
    augmenter_of(run).term(run, 45, 0)
    share = load_views(augmenter_of(run).store.path(run, 44))[1]["consistent"]
    assert share == 1.0 if least else 0.0 < share < 0.9
    line = "step 44, upscale: enlarged photos, reduced again, equal the photo in"
    assert f"{line} {100 * share:.1f} % of its pixels" in caplog.text


# -- regenerators that fail --------------------------------------------------------------------------------------------


class Spoiling:
    """Enlarges well, but for every n-th picture."""

    def __init__(self, every: int, spoil: Any) -> None:
        self.every, self.spoil, self.calls = every, spoil, 0

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        return {}

    def regenerate(self, requests: Any) -> list[Tensor]:
        from gsx.regenerators.classical import enlarged

        out = []
        for request in requests:
            self.calls += 1
            image = enlarged(request)
            out.append(self.spoil(image) if self.calls % self.every == 0 else image)
        return out


SPOILT = {
    "not finite": lambda image: image * torch.nan,
    "should be": lambda image: image[:, 1:],
    "from its input": lambda image: image.flip(2),
}


def with_regenerator(run: Run, regenerator: Any) -> PseudoDetails:
    old = augmenter_of(run)
    return PseudoDetails(old.options, replace(old.context, regenerator=of_role(regenerator)))


@pytest.mark.parametrize("reason", SPOILT)
def test_pictures_that_cannot_be_used_are_dropped_and_counted(
    reason: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper")
    augmenter = with_regenerator(run, Spoiling(3, SPOILT[reason]))
    augmenter.term(run, 45, 0)
    assert sum(map(len, augmenter.views.values())) == 12
    assert "6 of 18 x2 pictures dropped" in caplog.text
    assert reason in caplog.text


def test_an_event_that_loses_most_pictures_is_an_error(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper")
    with pytest.raises(TrainingError, match=r"lost 18 of 18 pictures at x2, step 44.*regenerator/upscale"):
        with_regenerator(run, Spoiling(1, SPOILT["not finite"])).term(run, 45, 0)


def test_results_can_be_averaged(tmp_path: Path) -> None:
    class Noisy(Spoiling):
        def regenerate(self, requests: Any) -> list[Tensor]:
            return [
                image + 0.02 * torch.randn(image.shape, generator=torch.Generator().manual_seed(request.seed))
                for image, request in zip(super().regenerate(requests), requests, strict=True)
            ]

    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", first_cameras=1)
    plain = with_regenerator(run, Spoiling(10**9, None))
    plain.term(run, 45, 0)
    errors = []
    for samples in (1, 16):
        old = augmenter_of(run)
        options = replace(old.options, samples=samples, seeds="per_view")
        noisy = PseudoDetails(options, replace(old.context, regenerator=of_role(Noisy(10**9, None))))
        noisy.term(run, 45, 0)
        pairs = [(a.target.float(), b.target.float()) for a, b in zip(plain.views[0], noisy.views[0], strict=True)]
        errors.append(float(torch.stack([(a - b).square().mean() for a, b in pairs]).mean()))
    assert errors[1] < errors[0] / 8


# -- runs --------------------------------------------------------------------------------------------------------------

RUN = (
    "iterations=20",
    *PLAIN,
    "augmenter=[upscale_paper,bootstrap]",
    "augmenter.upscale.timing.every=8000",
    "augmenter.bootstrap.timing.every=8000",
    "augmenter.upscale.timing.span=4000",  # two steps: a run can be stopped inside a window
    "augmenter.bootstrap.timing.span=4000",
    "training.checkpoint_every=100",
    "scene.points=150",
    "eval.zoom=[1]",
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    tiny_run(folder, RUN)
    return folder


def test_every_window_is_active_and_logged(finished: Path) -> None:
    plan = json.loads((finished / "environment.json").read_text())["plan"]
    assert plan["upscale"]["events"] == [11, 15, 19]
    assert plan["bootstrap"]["events"] == [10, 14, 18]
    pictures = [path.name for path in (finished / "pseudo").glob("*.png")]
    for name in ("upscale", "bootstrap"):
        assert {int(p.split("_")[1]) for p in pictures if p.startswith(name)} == set(plan[name]["events"])


def test_the_report_shows_pseudo_views_and_what_became_of_them(finished: Path) -> None:
    entries = json.loads((finished / "pseudo" / "index.json").read_text())["views"]
    assert {entry["augmenter"] for entry in entries} == {"upscale", "bootstrap"}
    assert {entry["event"] for entry in entries} == {18, 19}
    for entry in entries:
        made, after = (read_image(finished / "pseudo" / entry[kind]) for kind in ("made", "after"))
        assert made.shape[1:] == (after.shape[1], 3 * after.shape[2])
    page = (finished / "report.html").read_text()
    assert page.count("after training</figcaption>") == len(entries) > 3


def test_resume_inside_a_window_equals_never_having_stopped(finished: Path, tmp_path: Path) -> None:
    stopped_at(tmp_path / "run", RUN, 11, 16)
    same_ending(finished, tmp_path / "run")


def test_a_run_killed_after_the_next_event_goes_on_from_a_checkpoint_inside_a_window(
    finished: Path, tmp_path: Path
) -> None:
    """The checkpoint of step 11 needs the views of 10, though those of 11, 14 and 15 have been made since."""
    folder = tmp_path / "run"
    tiny_run(folder, (*RUN, "training.checkpoint_every=11"), stop_after=17)
    for path in (folder / "checkpoints").glob("step_0000017*"):
        path.unlink()
    run, settings = open_run(folder, plugins(), (), training=True)
    assert run.step == 11
    execute(run, settings, plugins())
    whole, parts = final_tensors(finished), final_tensors(folder)
    assert all(torch.equal(whole[name], parts[name]) for name in whole)


def test_files_of_events_that_no_checkpoint_needs_are_removed(finished: Path) -> None:
    kept = sorted(path.name for path in (finished / "pseudo").glob("*.safetensors"))
    assert kept == ["bootstrap_0000018.safetensors", "upscale_0000019.safetensors"]


def test_a_longer_run_waits_for_its_next_event(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of 20 steps the last event is at 17; of 30 those around 20 are at 19, which was never made, and 22."""
    caplog.set_level("INFO")
    words = tuple(word for word in RUN if not word.startswith("augmenter"))
    timing = [f"augmenter.bootstrap.timing.{word}" for word in ("start=21400", "stop=36000", "every=4000", "span=3000")]
    first = tiny_run(tmp_path / "run", (*words, "augmenter=bootstrap", "augmenter.bootstrap.first_cameras=1", *timing))
    assert augmenter_of(first).events == [11, 13, 15, 17]
    run, settings = open_run(tmp_path / "run", plugins(), ["iterations=30"], training=True)
    assert augmenter_of(run).events == [16, 19, 22, 25]
    execute(run, settings, plugins())
    assert run.complete
    assert "the run became longer, no pseudo views until the next event" in caplog.text


def test_before_the_first_window_a_run_is_that_of_the_control(tmp_path: Path) -> None:
    tiny_run(tmp_path / "augmented", RUN, stop_after=10)
    control = tuple(word for word in RUN if not word.startswith("augmenter"))
    tiny_run(tmp_path / "control", control, stop_after=10)
    a, b = final_tensors(tmp_path / "augmented"), final_tensors(tmp_path / "control")
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_a_lost_file_of_pseudo_views_is_named(tmp_path: Path) -> None:
    tiny_run(tmp_path / "run", RUN, stop_after=11)
    path = tmp_path / "run" / "pseudo" / "bootstrap_0000010.safetensors"
    path.unlink()
    run, settings = open_run(tmp_path / "run", plugins(), (), training=True)
    with pytest.raises(InputError, match=r"bootstrap_0000010.safetensors cannot be read.*step 10.*train anew"):
        execute(run, settings, plugins())


def test_another_file_in_the_place_of_pseudo_views_is_refused(tmp_path: Path) -> None:
    save_file({"weights": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="no pseudo views"):
        load_views(tmp_path / "other.safetensors")


def test_files_hold_everything(tmp_path: Path) -> None:
    camera = compose_camera().crop(1, 0, 1, 2)
    view = PseudoView(
        camera=camera,
        target=torch.arange(6, dtype=torch.uint8).view(3, 2, 1),
        parent=4,
        pixel_weight=torch.tensor([[7], [255]], dtype=torch.uint8),
        provenance={"seed": 22},
        coarse=torch.ones(3, 1, 1, dtype=torch.uint8),
        coarse_weight=0.25,
        reduction=Reduction(filter="lanczos", light="linear"),
    )
    save_views(tmp_path / "views", [view, replace(view, pixel_weight=None)], {"event": 3})
    (first, second), facts = load_views(tmp_path / "views")
    assert facts == {"event": 3}
    assert torch.equal(first.target, view.target)
    assert torch.equal(first.pixel_weight, view.pixel_weight)
    assert second.pixel_weight is None
    assert first.coarse is not None
    assert torch.equal(first.coarse, torch.ones(3, 1, 1, dtype=torch.uint8))
    assert (first.coarse_weight, first.reduction) == (0.25, view.reduction)
    assert (first.parent, first.provenance) == (4, {"seed": 22})
    for name in ("fx", "fy", "cx", "cy", "width", "height", "near", "cut_from"):
        assert getattr(first.camera, name) == getattr(camera, name)
    assert torch.equal(first.camera.rotation, camera.rotation)
    assert torch.equal(first.camera.translation, camera.translation)


# -- options -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("word", "complaint"), [
    ("augmenter.upscale.window=middle", "choose from center, random, grid, error"),
    ("augmenter.upscale.scales=[]", "give factors of 1 or more"),
    ("augmenter.upscale.narrow=0", "give a fraction above 0"),
    ("augmenter.upscale.weights=[0.1]", "give two values"),
    ("augmenter.upscale.weights=[0.1,2]", "from 0 to 1"),
    ("augmenter.upscale.base=false augmenter.upscale.variants=0", "no pseudo view"),
    ("augmenter.upscale.timing.span=2001", "windows would overlap"),
    ("augmenter.upscale.narow=0.5", "Did you mean"),
    ("augmenter.upscale.samples=0", "give a number from 1"),
    ("augmenter.upscale.least_alpha=2", "give a number from 0 to 1"),
])  # fmt: skip
def test_options_are_checked(word: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        compose(["augmenter=upscale_paper", *word.split()], plugins())


def test_unknown_augmenters_get_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match=r"Unknown augmenter 'upscal'.*Did you mean 'upscale'"):
        compose(["augmenter=[upscal]"], plugins())


def test_regenerators_are_chosen_by_role() -> None:
    found = compose(["regenerator/upscale=lanczos", "regenerator/restore=identity"], plugins())
    assert {role: chosen.component.name for role, chosen in found.regenerators.items()} == {
        "upscale": "lanczos",
        "restore": "identity",
    }
    assert found.augmenters == {}


def term_of(run: Run) -> Term | None:
    return augmenter_of(run).term(run, run.step + 1, 0)


def test_the_oracle_gives_the_true_pixels(tmp_path: Path) -> None:
    """The built-in scene has truth at any density; of cameras moved at random the untrained model shows another one."""
    run = run_at(tmp_path / "run", 44, "augmenter=upscale_paper", "regenerator/upscale=oracle", "scene.samples=16",
                 variants=0, first_cameras=1)  # fmt: skip
    assert term_of(run) is not None
    view = augmenter_of(run).views[0][0]
    finer = run.scene.train[0].source.image(view.camera)
    assert torch.equal(view.target, finer)


def test_what_cannot_work_is_refused_before_training(tmp_path: Path) -> None:
    up, boot = "augmenter=upscale_paper", "augmenter=bootstrap"
    for words, complaint in {
        (up, "augmenter.upscale.scales=[3]", "regenerator/upscale=scene_sr"): "x2, x4, x8, not x3",
        (boot, "augmenter.bootstrap.scales=[2]"): "identity cannot enlarge x2",
        (up, "augmenter.upscale.role=upscal"): "no regenerator is chosen for 'upscal'",
        (up, "augmenter.upscale.scales=[16]"): "are 2 x 1 px; 4 px are the least",
        (up, "augmenter.upscale.mode=hybrid", "augmenter.upscale.weights=[0.6,1.0]"): "replace the whole loss",
    }.items():
        with pytest.raises(ConfigError, match=complaint):
            start(tiny_settings(tmp_path / "run", *PLAIN, *words), plugins())
        assert not (tmp_path / "run").exists()


def test_oracle_knows_photographs_only_where_they_were_taken() -> None:
    from gsx.core.data.scene import View
    from gsx.regenerators.classical import Oracle, PlainOptions

    class Photo:
        def image(self, camera: Any) -> Tensor:
            return torch.zeros(3, camera.height, camera.width, dtype=torch.uint8)

        def max_zoom(self, camera: Any) -> float:
            return 2.0

    oracle, views = Oracle(PlainOptions(name="oracle")), [View("a", compose_camera(), Photo())]
    oracle.check(views, [2], False)
    with pytest.raises(ConfigError, match="variants=0"):
        oracle.check(views, [2], True)
    with pytest.raises(ConfigError, match=r"not 4 times finer.*scene.downscale=4"):
        oracle.check(views, [4], False)
