"""Several views in one step: gradients, losses and statistics by hand from single views; order, failures, resuming."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tiny import same_ending, stopped_at, tiny_run, tiny_settings
from torch import Tensor

from gsx.augmenters.pseudo_details import PseudoDetails
from gsx.backbones.density import mean_gradient
from gsx.builtin import plugins
from gsx.core.data.resize import to_uint8
from gsx.core.errors import ConfigError, TrainingError
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import Rendering, rasterize
from gsx.core.training.parameter_table import (
    gradients,
    named_parameters,
    restore_table,
    table_tensors,
    zero_grad,
)
from gsx.core.training.pseudo_views import PseudoView, Term, pseudo_loss
from gsx.core.training.run import Run
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import backward, train_step
from gsx.experiments.runs.build import build
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run

PLAIN = ("iterations=40", "rasterizer=eager")


def fresh(folder: Path, *words: str) -> Run:
    """A run at step 0 whose next views are 4, 1, 5."""
    folder.mkdir()
    settings = tiny_settings(folder, *PLAIN, *words)
    run = build(settings, load_scene(settings), folder, training=True)
    run.sampler.order = [0, 5, 1, 4]
    return run


def alone(run: Run, view: int, background: Tensor | None = None) -> tuple[Tensor, Rendering]:
    """(loss, render) of one view by itself, after its backward pass."""
    camera, truth = run.scene.train[view].camera, run.scene.train[view].image()
    colour = run.background if background is None else background
    drawn = run.backbone.draw(camera, 1)
    rendering = rasterize(drawn.splats, camera, run.raster, background=colour)
    loss, extra = photometric(rendering.image, truth, 0.2), run.backbone.regulariser(drawn)
    loss = loss if extra is None else loss + extra
    loss.backward()
    return loss.detach(), rendering


def cleared_gradients(run: Run) -> dict[str, Tensor]:
    """Copies of the gradients there are, which are cleared."""
    found = {name: gradient.clone() for name, gradient in gradients(run.backbone.table).items()}
    zero_grad(run.backbone.table)
    return found


def assert_same(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert torch.equal(found[name], value), name


# -- gradients and losses ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backbone", ["gs3d", "octree_scaffold"])
def test_gradients_are_the_mean_of_those_of_single_views(backbone: str, tmp_path: Path) -> None:
    """Exactly, of two views; of one view they are its own."""
    for batch in (1, 2):
        run = fresh(tmp_path / str(batch), f"backbone={backbone}", f"training.batch={batch}")
        single = []
        for view in (4, 1)[:batch]:
            loss, _ = alone(run, view)
            single.append((loss, cleared_gradients(run)))
        step = backward(run)
        wanted = {name: sum(found[name] for _, found in single) / batch for name in single[0][1]}
        assert_same(cleared_gradients(run), wanted)  # type: ignore[arg-type]
        assert float(step.loss) == pytest.approx(sum(float(loss) for loss, _ in single) / batch, rel=1e-6)
        assert step.view is run.scene.train[4]
        assert [other.view for other in step.others] == [run.scene.train[1]][: batch - 1]


def test_the_psnr_of_a_batch_is_the_mean_over_its_views(tmp_path: Path) -> None:
    step = backward(fresh(tmp_path / "run", "training.batch=2"))
    pictures = [(s.rendering.image.clamp(0, 1), s.target) for s in (step, *step.others)]
    decibel = [float(-10 * (image - target).square().mean().log10()) for image, target in pictures]
    assert step.psnr() == pytest.approx(sum(decibel) / 2, rel=1e-5)


def test_every_view_has_its_own_background_drawn_in_order(tmp_path: Path) -> None:
    run = fresh(tmp_path / "run", "training.batch=3", "training.random_background=true")
    ahead = torch.Generator()
    ahead.set_state(run.generator.get_state())
    sums: dict[str, Tensor] = {}
    for view in (4, 1, 5):
        alone(run, view, torch.rand(3, generator=ahead))
        found = cleared_gradients(run)
        sums = {name: sums[name] + value if sums else value for name, value in found.items()}
    backward(run)
    assert_same(cleared_gradients(run), {name: value / 3 for name, value in sums.items()})
    assert torch.equal(run.generator.get_state(), ahead.get_state())


class Still:
    """An augmenter: for some views a pseudo view that must leave shared parameters alone."""

    def __init__(self, views: tuple[int, ...]) -> None:
        self.views = views

    def view_of(self, run: Run, number: int) -> PseudoView:
        camera = run.scene.train[number].camera.narrow(0.5)
        return PseudoView(camera=camera, target=to_uint8(torch.full((3, *camera.size[::-1]), 0.25)), parent=number)

    def term(self, run: Run, step: int, view: int) -> Term | None:
        if view not in self.views:
            return None
        return Term(name="still", parts=[(self.view_of(run, view), 0.5)], replaces=0.1, observed=True, shared=False)

    def begins(self) -> int:
        return 0

    def plan(self) -> dict[str, Any]:
        return {}


def test_what_a_term_makes_shared_parameters_forget_is_its_own_only(tmp_path: Path) -> None:
    """The second view's pseudo view leaves the colour network what it has gathered from the first."""
    run = fresh(tmp_path / "run", "backbone=octree_scaffold", "training.batch=2")
    colour = {name for name, _ in named_parameters(run.backbone.table) if name.startswith("heads.colour")}
    first, one = alone(run, 4)[0], cleared_gradients(run)
    second, two = alone(run, 1)[0], cleared_gradients(run)
    augmenter = Still((1,))
    pseudo = augmenter.view_of(run, 1)
    splats = run.backbone.draw(pseudo.camera, 1).splats
    image = rasterize(splats, pseudo.camera, run.raster, background=run.background).image
    value = 0.5 * pseudo_loss(image, pseudo)
    value.backward()
    added = cleared_gradients(run)
    run.augmenters = {"still": augmenter}
    step = backward(run)
    found = cleared_gradients(run)
    assert colour
    for name, value_found in found.items():
        wanted = (one[name] + 0.9 * two[name] + (0 if name in colour else added[name])) / 2
        torch.testing.assert_close(value_found, wanted, rtol=1e-4, atol=1e-9, msg=name)
    assert step.terms == pytest.approx(
        {"own": (float(first) + 0.9 * float(second)) / 2, "still": float(value.detach()) / 2}, rel=1e-5
    )
    assert float(step.loss) == pytest.approx(sum(step.terms.values()), rel=1e-5)
    assert len(step.observations) == 3  # the first photograph, the pseudo view, the second photograph


# -- density control ---------------------------------------------------------------------------------------------------


def test_statistics_are_those_of_single_views_and_not_diluted(tmp_path: Path) -> None:
    run = fresh(tmp_path / "run", "training.batch=2", "backbone.density.gradient=1e9")
    count = len(run.backbone.table)
    sums, seen = torch.zeros(count), torch.zeros(count)
    for view in (4, 1):
        screen = alone(run, view)[1].screen
        assert screen.means2d_offset.grad is not None
        norms = (screen.means2d_offset.grad * torch.tensor([48, 36]) / 2).norm(dim=1)
        sums[screen.ids[screen.radii > 0]] += norms[screen.radii > 0]
        seen[screen.ids[screen.radii > 0]] += 1
        cleared_gradients(run)
    train_step(run, plugins())
    statistics = run.backbone.table.statistics
    assert torch.equal(statistics["count"], seen / 2)
    torch.testing.assert_close(mean_gradient(run.backbone.table), sums / seen.clamp_min(1), rtol=1e-6, atol=0)
    assert float(sums.max()) > 0


class Judge:
    """A run in the middle of density control, asked again and again from the same state what it learns from steps."""

    def __init__(self, folder: Path, backbone: str) -> None:
        absolute = ("backbone.density.absolute=true",) if backbone == "mip_splatting" else ()
        self.run = fresh(folder, f"backbone={backbone}", *absolute)
        self.run.step = 8
        self.start = {name: value.clone() for name, value in table_tensors(self.run.backbone.table).items()}

    def learnt(self, *augmenters: Any, batch: int = 1, steps: int = 1, ssim_weight: float = 0.2) -> dict[str, Tensor]:
        """Statistics after so many steps over views 4, 1, 5, 0 that move nothing."""
        run = self.run
        run.backbone.table = restore_table(
            run.backbone.table, {name: value.clone() for name, value in self.start.items()}
        )
        run.training = replace(run.training, batch=batch, ssim_weight=ssim_weight)
        run.sampler.order, run.sampler.batch = [0, 5, 1, 4], batch
        run.augmenters = dict(enumerate(augmenters))
        for _ in range(steps):
            for seen in backward(run).observations:
                run.backbone.accumulate(seen)
            zero_grad(run.backbone.table)
        return {name: value.clone() for name, value in run.backbone.table.statistics.items()}


@pytest.fixture(scope="module", params=["gs3d", "mip_splatting", "scaffold", "octree_gs3d"])
def judge(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Judge:
    return Judge(tmp_path_factory.mktemp("judge") / "run", request.param)


def test_a_batch_counts_as_one_step_and_judges_as_its_views_one_by_one(judge: Judge) -> None:
    """Sums of a batch of n are those of n steps over n, so that visits are steps; mean gradients are the same."""
    for views in (1, 2, 4):
        wanted, found = judge.learnt(steps=views), judge.learnt(batch=views)
        assert found.keys() == wanted.keys()
        assert len(wanted) >= 2
        for name, value in wanted.items():
            assert value.any(), name
            torch.testing.assert_close(found[name], value / views, rtol=2e-6, atol=0, msg=f"{views} {name}")
        steps = found["visits"] if "visits" in found else found["count"]
        assert float(steps.max()) == 1.0


class Again:
    """An augmenter: every training view once more with its own photograph as truth, at a weight."""

    def __init__(self, weight: float, replaces: float = 0.0, *, observed: bool = True, shared: bool = True) -> None:
        self.weight, self.replaces, self.observed, self.shared = weight, replaces, observed, shared

    def term(self, run: Run, step: int, view: int) -> Term | None:
        seen = run.scene.train[view]
        pseudo = PseudoView(camera=seen.camera, target=to_uint8(seen.image()), parent=view)
        kind = {"observed": self.observed, "shared": self.shared}
        return Term(name="again", parts=[(pseudo, self.weight)], replaces=self.replaces, **kind)

    def begins(self) -> int:
        return 0

    def plan(self) -> dict[str, Any]:
        return {}


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("shared", [True, False])
def test_a_pseudo_view_counts_by_its_weight(judge: Judge, shared: bool, batch: int) -> None:
    """One that equals its photograph adds no more evidence than its weight: means stay, drawn together or apart.

    0.9 of the photograph and 0.25 of the pseudo view are 1.15 of a step.
    """
    wanted = judge.learnt(batch=batch, ssim_weight=0.0)
    found = judge.learnt(Again(0.25, 0.1, shared=shared), batch=batch, ssim_weight=0.0)
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], 1.15 * value, rtol=1e-4, atol=1e-9, msg=name)


def test_what_is_not_observed_leaves_no_trace_in_density_control(judge: Judge) -> None:
    """Also where the pseudo view sees just what the photograph does: bit for bit the control's statistics."""
    wanted = judge.learnt()
    assert_same(judge.learnt(Again(0.5, observed=False)), wanted)
    assert_same(judge.learnt(Again(0.0)), wanted)


def test_photographs_that_are_left_no_weight_do_not_count(judge: Judge) -> None:
    assert not any(value.any() for value in judge.learnt(Again(0.5, 1.0, observed=False)).values())


def test_a_primitive_that_any_view_left_out_is_healed_and_the_step_skipped(tmp_path: Path) -> None:
    run = fresh(tmp_path / "run", "training.batch=2")
    with torch.no_grad():
        run.backbone.table["log_scales"][1] = torch.nan  # type: ignore[attr-defined]
    count = len(run.backbone.table)
    step = train_step(run, plugins())
    assert step.skipped == "removed 1 primitives"
    assert len(run.backbone.table) == count - 1
    assert not run.backbone.table.statistics["count"].any()  # type: ignore[attr-defined]
    assert not train_step(run, plugins()).skipped


# -- the order of views ------------------------------------------------------------------------------------------------


def test_steps_take_views_in_the_order_of_single_ones() -> None:
    single, double = Sampler(5, 3), Sampler(5, 3, batch=2)
    assert [view for _ in range(7) for view in double.take()] == [single.next() for _ in range(14)]
    assert Sampler(5, 3).take() == [Sampler(5, 3).next()]


@pytest.mark.parametrize("before", [0, 1, 2, 3])
def test_views_put_back_come_again(before: int) -> None:
    """Across the end of an order too."""
    sampler = Sampler(5, 3, batch=3)
    for _ in range(before):
        sampler.take()
    first = list(sampler.take())
    sampler.put_back()
    assert sampler.take() == first
    following = sampler.take()
    straight = Sampler(5, 3, batch=3)
    assert [straight.take() for _ in range(before + 2)][-1] == following


def test_views_to_come_are_counted_in_steps() -> None:
    sampler, other = Sampler(7, 0, batch=2), Sampler(7, 0, batch=2)
    assert sampler.take() == other.take()
    assert sampler.coming(2) == {view for _ in range(2) for view in other.take()}
    assert sampler.coming(0) == set()


def test_pseudo_views_are_made_for_all_views_of_a_window(tmp_path: Path) -> None:
    """A window of two steps of two views: the batch under way and the next one."""
    long = [f"augmenter.upscale.timing.{key}=1000" for key in ("every", "span")]
    words = ("iterations=80", "augmenter=upscale_paper", "regenerator/upscale=lanczos", "training.batch=2", *long)
    run = fresh(tmp_path / "run", *words)
    run.step, run.sampler.order = 44, [0, 5, 1, 4, 2]
    step = backward(run)
    augmenter = run.augmenters["upscale"]
    assert isinstance(augmenter, PseudoDetails)
    assert sorted(augmenter.views) == [1, 2, 4, 5]
    assert step.terms["upscale"] > 0
    zero_grad(run.backbone.table)
    run.step = 45
    backward(run)
    assert run.sampler.order == [0]


# -- failures ----------------------------------------------------------------------------------------------------------


class Failing(Still):
    """Fails for one view."""

    def term(self, run: Run, step: int, view: int) -> Term | None:
        if view in self.views:
            raise TrainingError("it lost its pictures")
        return None


def test_a_step_that_fails_has_not_been_taken(tmp_path: Path) -> None:
    run = fresh(tmp_path / "run", "training.batch=2", "training.random_background=true")
    run.augmenters, state = {"still": Failing((1,))}, run.generator.get_state()
    with pytest.raises(TrainingError, match="lost its pictures"):
        train_step(run, plugins())
    assert run.sampler.order == [0, 5, 1, 4]
    assert torch.equal(run.generator.get_state(), state)


@pytest.mark.parametrize("batch", [0, -2])
def test_a_batch_without_views_is_refused(batch: int, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"training.batch is {batch}; give a number from 1"):
        tiny_settings(tmp_path / "run", f"training.batch={batch}")


# -- whole runs --------------------------------------------------------------------------------------------------------

DENSE = (
    *(*PLAIN, "iterations=14", "training.batch=2", "scene.points=100", "eval.zoom=[1]"),
    *("backbone.density.every=400", "backbone.density.stop=28000", "backbone.density.gradient=0.002"),
)


def test_a_resumed_run_of_batches_equals_one_that_never_stopped(tmp_path: Path) -> None:
    whole = tiny_run(tmp_path / "whole", DENSE, evaluated=False)
    grown = [line["step"] for line in whole.progress.curves if "cloned" in line]
    assert grown == [6, 12], "the test needs density events before and after the stop"
    stopped_at(tmp_path / "run", DENSE, 8)
    same_ending(tmp_path / "run", tmp_path / "whole")


def test_runs_older_than_the_option_go_on_with_single_views(tmp_path: Path) -> None:
    tiny_run(tmp_path / "run", (*PLAIN, "iterations=4"), stop_after=2)
    path = tmp_path / "run" / "config.yaml"
    config = OmegaConf.load(path)
    del config.training["batch"]
    OmegaConf.save(config, path)
    run, _ = open_run(tmp_path / "run", plugins(), training=True)
    assert (run.training.batch, run.sampler.batch) == (1, 1)
