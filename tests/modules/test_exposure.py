"""Exposures of photos: estimated where they differ, absent where they do not, learnt, saved and resumed."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from module_contexts import build_module
from tiny import same_ending, stopped_at, tiny_run
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.errors import ConfigError
from gsx.core.quality.colour_matrix import fit_colours, transform_colours
from gsx.core.training.distributed import Ranks
from gsx.experiments.runs.build import refuse_shared
from gsx.experiments.runs.open import open_run
from gsx.modules.exposure import Exposure, ExposureOptions, Measure, centred_on_identity, light_of
from gsx.modules.photo_pairs import Pair, log_gains, shared_spread
from gsx.modules.poses import PoseOptions, Poses


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Numbers in [0, 1]."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_gains_come_from_pixels_that_are_neither_dark_nor_saturated() -> None:
    image = 0.2 + 0.3 * noise(3, 20, 30)
    gains = torch.tensor([1.5, 1.0, 0.7])
    photo = image * gains[:, None, None]
    photo[:, :2], photo[:, 2:4] = 1.0, 0.0  # saturated; a black border
    torch.testing.assert_close(log_gains(image, photo), gains.log())
    covered = torch.ones(20, 30, dtype=torch.bool)
    covered[:15] = False
    photo[:, :15] = image[:, :15]  # masked out: they do not count
    torch.testing.assert_close(log_gains(image, photo, covered), gains.log())
    assert log_gains(image[:, :2], photo[:, :2] * 0).isnan().all()


def test_the_spread_is_what_halves_share() -> None:
    true = 0.1 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(1))
    left, right = (true + 0.3 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(s)) for s in (2, 3))
    assert shared_spread(left + 5, right - 5) == pytest.approx(0.1, abs=0.02)  # 0.3 of noise, and offsets, do not count
    left[7] = math.nan
    assert shared_spread(left, right) == pytest.approx(0.1, abs=0.02)
    assert shared_spread(left[:2], right[:2]) == 0


def pairs_at(gains: Tensor) -> tuple[Tensor, list[Pair]]:
    """(render, (render, photo at its gain, no mask) of every view)."""
    image = 0.2 + 0.3 * noise(3, 16, 24)
    return image, [(image, image * gain, None) for gain in gains]


def measure_of(pairs: list[Pair]) -> Measure:
    """Measures light by number of a photo."""
    return lambda index: light_of(pairs[index], slopes=False)


def exposure_of(views: int = 4, iterations: int = 1000, **changes: object) -> Exposure:
    """The module with options of conf, and changes."""
    options = replace(ExposureOptions(when="auto"), **changes)
    return build_module(Exposure, options, iterations=iterations, views=views)


def exposed(module: Exposure, image: Tensor, index: int) -> Tensor:
    """A render at the exposure of a photo, to be looked at."""
    return module.transform_render(image, module.context.scene.train[index], None, None, learning=False).detach()


def test_they_start_where_photos_differ_and_with_the_mean_at_the_identity() -> None:
    gains = torch.tensor([0.8, 1.3, 1.0, 0.9])
    image, pairs = pairs_at(gains)
    module = exposure_of()
    assert module.due(201)
    assert not module.due(200)
    spread, within = module.test(measure_of(pairs), 201)
    assert spread == pytest.approx(float(gains.log().std()), rel=1e-4)
    assert math.isnan(within)
    assert module.grids is None
    assert [step for step in range(1, 1001) if module.due(step)] == [275, 375, 513, 701]  # 201 was estimated
    gains = gains / gains.log().mean().exp()
    for index, gain in enumerate(gains - gains.mean() + 1):
        torch.testing.assert_close(exposed(module, image, index), image * gain)


def test_equal_photos_have_none_unless_always() -> None:
    image, pairs = pairs_at(torch.tensor([1.01, 1.0, 0.99, 1.0]))
    module = exposure_of()
    assert module.test(measure_of(pairs), 201)[0] < module.options.spread
    assert module.matrices is None
    assert module.state_dict() == {}
    assert module.transform_render(image, module.context.scene.train[0], image, None, learning=True) is image
    always = exposure_of(when="always")
    always.test(measure_of(pairs), 201)
    assert always.matrices is not None
    assert not any(module.due(step) for step in range(1, 1001) if step != 201)
    assert not exposure_of(when="never").due(201)


def test_they_are_corrected_by_what_a_better_model_renders() -> None:
    true = torch.tensor([0.8, 1.3, 1.0, 0.9])
    image, pairs = pairs_at(true)
    early = [(photo / gain, photo, None) for (_, photo, _), gain in zip(pairs, true.sqrt(), strict=True)]
    module = exposure_of()
    module.test(measure_of(early), 201)  # the model has half of every exposure still
    module.visits += 3
    change = module.correct(lambda index: light_of((exposed(module, image, index), pairs[index][1], None), False), 275)
    assert change == pytest.approx(float((true.log() / 2).std(unbiased=False)), rel=0.05)  # the other half
    for index, gain in enumerate(true):
        ratio = exposed(module, image, index) / image
        torch.testing.assert_close(ratio, torch.full_like(ratio, float(gain)), atol=0.02, rtol=0)
    assert module.visits.sum() == 0
    assert module.moments["matrices"].abs().max() == 0
    assert not module.due(275)
    assert module.due(375)


def test_what_is_learnt_stays_where_photos_say_nothing_more() -> None:
    truth = torch.eye(3, 4).repeat(2, 1, 1)
    truth[0, 0, 1], truth[1, 0, 1] = 0.05, -0.05  # no gain: a channel that takes from another
    image, module = 0.2 + 0.3 * noise(3, 16, 24), exposure_of(views=2)
    module.start(matrices=truth.clone())
    pairs = [(exposed(module, image, 0),) * 2, (exposed(module, image, 1), torch.zeros_like(image))]
    assert module.correct(lambda index: light_of((*pairs[index], None), False), 275) == 0
    assert module.matrices is not None
    torch.testing.assert_close(module.matrices.detach(), truth)


def test_a_common_gain_is_the_models_and_changes_no_photo() -> None:
    truth = torch.tensor([0.7, 1.0, 1.3])[:, None, None] * torch.eye(3, 4)
    image, module = 0.2 + 0.3 * noise(3, 16, 24), exposure_of(views=3)
    module.start(matrices=truth.clone())
    renders = [exposed(module, image, index) for index in range(3)]
    pairs = [(image, gain * image, None) for image, gain in zip(renders, (1.15, 1.15, 0), strict=True)]
    assert module.correct(measure_of(pairs), 275) < 1e-6  # the third photo is black
    assert module.matrices is not None
    torch.testing.assert_close(module.matrices.detach(), truth)


def test_a_sample_of_photos_is_tested_and_the_others_measured_where_all_get_exposures() -> None:
    _, pairs = pairs_at(torch.linspace(0.7, 1.3, 9))
    measured = list[int]()

    def measure(index: int) -> object:
        measured.append(index)
        return light_of(pairs[index], slopes=False)

    few = build_module(Exposure, ExposureOptions(when="auto", views=4, spread=1.0), views=9)
    few.test(measure, 201)
    assert len(set(measured)) == len(measured) == 4
    sample = measured.copy()
    module = build_module(Exposure, ExposureOptions(when="auto", views=4), views=9)
    spread, _ = module.test(measure, 201)
    assert measured[4:8] == sample
    assert sorted(measured[4:]) == list(range(9))
    assert spread == pytest.approx(float(torch.linspace(0.7, 1.3, 9)[sample].log().std()), rel=1e-4)
    everyone = build_module(Exposure, ExposureOptions(when="auto", views=9), views=9)
    everyone.test(measure_of(pairs), 201)
    assert torch.equal(module.matrices.detach(), everyone.matrices.detach())


def test_a_render_that_is_looked_at_teaches_nothing() -> None:
    image, module = 0.2 + 0.3 * noise(3, 16, 24), exposure_of(views=2, iterations=100)
    module.start(matrices=torch.eye(3, 4).repeat(2, 1, 1))
    assert module.expose(image, 0, learning=True).requires_grad
    assert not module.expose(image, 1).requires_grad
    assert module.rendered == {0}


def test_they_are_learnt_and_go_on_from_a_checkpoint() -> None:
    image, truth = 0.2 + 0.3 * noise(3, 16, 24), torch.eye(3, 4).repeat(2, 1, 1)
    truth[0, 0, 3], truth[1, 0, 3] = 0.1, -0.1
    module, other = (exposure_of(views=2, iterations=100, rate_final=0.01) for _ in range(2))
    module.start(matrices=torch.eye(3, 4).repeat(2, 1, 1))

    def learn(exposure: Exposure, first: int, last: int) -> None:
        for step in range(first, last):
            target = transform_colours(image, truth[step % 2])
            (exposure.expose(image, step % 2, learning=True) - target).square().mean().backward()
            exposure.optimizer_step(step)

    learn(module, 21, 60)
    other.load_state_dict({name: value.clone() for name, value in module.state_dict().items()})
    learn(module, 60, 400)
    learn(other, 60, 400)
    assert module.matrices is not None
    assert other.matrices is not None
    assert torch.equal(module.matrices, other.matrices)
    learnt, wanted = (transform_colours(image, matrices[0].detach()) for matrices in (module.matrices, truth))
    torch.testing.assert_close(learnt, wanted, atol=5e-3, rtol=0)
    torch.testing.assert_close(module.matrices.detach().mean(0), torch.eye(3, 4), atol=1e-6, rtol=0)


def test_adam_steps_each_photo_apart_by_a_rate_that_falls() -> None:
    module = exposure_of()
    assert [module.options.rate_at(step, 1000) for step in (200, 600, 1000)] == pytest.approx(
        [0.01, math.sqrt(1e-5), 0.001]
    )
    module.start(matrices=torch.eye(3, 4).repeat(4, 1, 1))
    image, identity = 0.2 + 0.3 * noise(3, 16, 24), torch.eye(3, 4)
    module.expose(image, 0, learning=True).sum().backward()
    module.optimizer_step(200)  # Adam's first step is one rate: down, and up by a quarter of it to keep the mean
    assert module.matrices is not None
    torch.testing.assert_close(module.matrices[0].detach(), identity - 0.01 * 3 / 4, atol=1e-6, rtol=0)
    torch.testing.assert_close(module.matrices[1].detach(), identity + 0.01 / 4, atol=1e-6, rtol=0)
    before = module.matrices.detach().clone()
    module.expose(image, 1, learning=True).sum().backward()
    module.optimizer_step(200)  # the first photo does not go on moving
    change = (module.matrices - before)[0].detach()
    torch.testing.assert_close(change, torch.full((3, 4), 0.01 / 4), atol=1e-6, rtol=0)


def test_more_than_a_saturated_value_is_no_error() -> None:
    module, image = exposure_of(views=1), torch.tensor([0.4, 1.3, 1.3]).view(3, 1, 1).requires_grad_()
    photo, [view] = torch.tensor([1.0, 1.0, 0.9]).view(3, 1, 1), module.context.scene.train
    assert module.transform_render(image, view, photo, None, learning=True) is image
    module.start(matrices=torch.eye(3, 4)[None])
    (module.transform_render(image, view, photo, None, learning=True) - photo).abs().sum().backward()
    assert image.grad is not None
    assert image.grad.flatten().tolist() == [-1, 0, 1]


def test_the_matrix_fits_the_pixels_that_count() -> None:
    image, matrix = noise(3, 10, 12), torch.tensor([[0.9, 0.1, 0, 0.02], [0, 1.1, 0, 0], [0.05, 0, 0.8, 0.1]])
    truth, left = transform_colours(image, matrix), torch.zeros(10, 12, dtype=torch.bool)
    left[:, :6] = True
    truth[..., 6:] = 0
    torch.testing.assert_close(fit_colours(image, truth, left), matrix, atol=1e-5, rtol=0)
    grey = torch.full((3, 10, 12), 0.5)  # of one colour: the least matrix of many
    torch.testing.assert_close(transform_colours(grey, fit_colours(grey, 0.5 * grey, left)), 0.5 * grey)
    assert torch.equal(centred_on_identity(matrix[None]), torch.eye(3, 4)[None])


def test_several_processes_are_refused() -> None:
    modules = {"exposure": exposure_of(), "poses": build_module(Poses, PoseOptions())}
    refuse_shared(modules, Ranks())
    with pytest.raises(ConfigError, match=r"training\.exposure works in one process.*training\.exposure\.when=never"):
        refuse_shared(modules, Ranks(size=2))
    modules = {"exposure": exposure_of(when="never"), "poses": build_module(Poses, PoseOptions(when="always"))}
    with pytest.raises(ConfigError, match=r"training\.poses works in one process"):
        refuse_shared(modules, Ranks(size=2))


DISTURBED = (
    *("scene.disturb.exposure=0.3", "training.exposure.when=auto", "iterations=30"),
    *("backbone.capacity=adaptive", "backbone.sh_judged=0.8"),
)
"""Growth probes photos at steps 6 and 12, bands at step 24; exposures are estimated before 7, 9, 12, 16 and 22."""


def test_a_run_with_exposures_resumes_as_if_never_stopped(tmp_path: Path) -> None:
    whole = tiny_run(tmp_path / "whole", DISTURBED, evaluated=False)
    assert whole.modules["exposure"].active
    stopped_at(tmp_path / "stopped", DISTURBED, 12)
    a = same_ending(tmp_path / "whole", tmp_path / "stopped")
    assert "exposure.matrices" in a
    assert a["exposure.told_last"] == 22
    assert a["exposure.visits"].sum() == 9, "the steps after the last estimate, and none of the probes"
    longer, _ = open_run(tmp_path / "whole", plugins(), ["iterations=300"], training=True)
    longer.step = 60
    assert longer.modules["exposure"].due(61)
    metrics = longer.modules["exposure"].before_step(longer)  # corrected, not tested again
    assert "exposure_spread" not in metrics
    assert metrics["exposure_motion"] < 0.2


def test_without_need_training_is_bit_for_bit_that_without_exposures(tmp_path: Path) -> None:
    plain = tiny_run(tmp_path / "plain", ["iterations=12"], evaluated=False)
    auto = ["iterations=12", "training.exposure.when=auto", "training.exposure.spread=1"]
    tested = tiny_run(tmp_path / "tested", auto, evaluated=False)
    assert not plain.modules["exposure"].active
    assert not tested.modules["exposure"].active
    same_ending(tmp_path / "plain", tmp_path / "tested")
