"""Exposures of photographs: found where they are, absent where they are not, learnt, kept and resumed."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny import final_tensors, stopped_at, tiny_run
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.errors import ConfigError
from gsx.core.training.distributed import Ranks
from gsx.core.training.run import TrainingOptions
from gsx.experiments.runs.build import refuse_shared
from gsx.experiments.runs.open import open_run
from gsx.modules.captures import judge_photographs
from gsx.modules.exposure import (
    ExposureOptions,
    Exposures,
    best_matrix,
    centred_on_identity,
    log_gains,
    saturated,
    shared_spread,
    transformed,
)
from gsx.modules.poses import PoseOptions

CPU = torch.device("cpu")


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Numbers in [0, 1]."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_gains_are_told_by_pixels_that_are_neither_dark_nor_saturated() -> None:
    image = 0.2 + 0.3 * noise(3, 20, 30)
    gains = torch.tensor([1.5, 1.0, 0.7])
    photograph = image * gains[:, None, None]
    photograph[:, :2], photograph[:, 2:4] = 1.0, 0.0  # saturated; a black border
    torch.testing.assert_close(log_gains(image, photograph), gains.log())
    covered = torch.ones(20, 30, dtype=torch.bool)
    covered[:15] = False
    photograph[:, :15] = image[:, :15]  # masked out: they say nothing
    torch.testing.assert_close(log_gains(image, photograph, covered), gains.log())
    assert log_gains(image[:, :2], photograph[:, :2] * 0).isnan().all()


def test_the_spread_is_that_which_halves_share() -> None:
    true = 0.1 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(1))
    left, right = (true + 0.3 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(s)) for s in (2, 3))
    assert shared_spread(left + 5, right - 5) == pytest.approx(0.1, abs=0.02)  # 0.3 of noise, and offsets, do not count
    left[7] = math.nan
    assert shared_spread(left, right) == pytest.approx(0.1, abs=0.02)
    assert shared_spread(left[:2], right[:2]) == 0


def photographs_at(gains: Tensor) -> tuple[Tensor, list[tuple[Tensor, Tensor, None]]]:
    """(what the model shows, (that, photograph at its gain, no mask) of every view)."""
    image = 0.2 + 0.3 * noise(3, 16, 24)
    return image, [(image, image * gain, None) for gain in gains]


def options(**changes: object) -> ExposureOptions:
    """Those of conf, and changes."""
    return replace(ExposureOptions(when="auto"), **changes)


def test_they_begin_where_photographs_differ_and_with_the_mean_at_the_identity() -> None:
    names, gains = list("abcd"), torch.tensor([0.8, 1.3, 1.0, 0.9])
    image, pairs = photographs_at(gains)
    found = Exposures(options(), names, 1000, CPU)
    assert found.due(201)
    assert not found.due(200)
    spread, inside = found.judge(pairs.__getitem__, 201)
    assert spread == pytest.approx(float(gains.log().std()), rel=1e-4)
    assert math.isnan(inside)
    assert found.grids is None
    assert [number for number in range(1, 1001) if found.due(number)] == [275, 375, 513, 701]  # not 201, taken anew
    gains = gains / gains.log().mean().exp()
    for name, gain in zip(names, gains - gains.mean() + 1, strict=True):
        torch.testing.assert_close(found.applied(image, name).detach(), image * gain)


def test_equal_photographs_have_none_unless_asked_for() -> None:
    image, pairs = photographs_at(torch.tensor([1.01, 1.0, 0.99, 1.0]))
    found = Exposures(options(), list("abcd"), 1000, CPU)
    assert found.judge(pairs.__getitem__, 201)[0] < found.options.spread
    assert found.matrices is None
    assert found.tensors() == {}
    assert found.applied(image, "a") is image
    asked = Exposures(options(when="always"), list("abcd"), 1000, CPU)
    asked.judge(pairs.__getitem__, 201)
    assert asked.matrices is not None
    assert not any(found.due(number) for number in range(1, 1001) if number != 201)
    assert not Exposures(options(when="never"), list("abcd"), 1000, CPU).due(201)


def test_they_are_told_again_from_what_a_better_model_shows() -> None:
    names, true = list("abcd"), torch.tensor([0.8, 1.3, 1.0, 0.9])
    image, pairs = photographs_at(true)
    early = [(other / gain, other, None) for (_, other, _), gain in zip(pairs, true.sqrt(), strict=True)]
    found = Exposures(options(), names, 1000, CPU)
    found.judge(early.__getitem__, 201)  # the model has half of every exposure still
    found.visits += 3
    off = found.tell(lambda index: (found.applied(image, names[index]).detach(), pairs[index][1], None), 275)
    assert off == pytest.approx(float((true.log() / 2).std(unbiased=False)), rel=0.05)  # of the other half
    for name, gain in zip(names, true, strict=True):
        shown = found.applied(image, name).detach() / image
        torch.testing.assert_close(shown, torch.full_like(shown, float(gain)), atol=0.02, rtol=0)
    assert found.visits.sum() == 0
    assert found.moments.abs().max() == 0
    assert not found.due(275)
    assert found.due(375)


def test_what_is_learnt_stays_where_nothing_more_is_told() -> None:
    truth = torch.eye(3, 4).repeat(2, 1, 1)
    truth[0, 0, 1], truth[1, 0, 1] = 0.05, -0.05  # no gain: a channel that takes from another
    image, found = 0.2 + 0.3 * noise(3, 16, 24), Exposures(options(), ["a", "b"], 1000, CPU)
    found.begin(truth.clone())
    dark = torch.zeros_like(image)
    shown = [(found.applied(image, "a").detach(),) * 2, (found.applied(image, "b").detach(), dark)]
    assert found.tell(lambda index: (*shown[index], None), 275) == 0
    assert found.matrices is not None
    torch.testing.assert_close(found.matrices.detach(), truth)


def test_what_all_photographs_are_off_by_is_the_models_and_moves_none() -> None:
    names, truth = ["a", "b", "c"], torch.tensor([0.7, 1.0, 1.3])[:, None, None] * torch.eye(3, 4)
    image, found = 0.2 + 0.3 * noise(3, 16, 24), Exposures(options(), names, 1000, CPU)
    found.begin(truth.clone())
    shown = [found.applied(image, name).detach() for name in names]
    pairs = [(shown[0], 1.15 * shown[0], None), (shown[1], 1.15 * shown[1], None), (shown[2], 0 * shown[2], None)]
    assert found.tell(pairs.__getitem__, 275) < 1e-6  # of the third nothing is told
    assert found.matrices is not None
    torch.testing.assert_close(found.matrices.detach(), truth)


def test_some_photographs_are_judged_by_and_the_others_looked_at_where_all_have_exposures() -> None:
    _, pairs = photographs_at(torch.linspace(0.7, 1.3, 9))
    names, seen = [str(number) for number in range(9)], list[int]()

    def look(number: int) -> tuple[Tensor, Tensor, None]:
        seen.append(number)
        return pairs[number]

    few = Exposures(options(views=4, spread=1.0), names, 1000, CPU)
    few.judge(look, 201)
    assert len(set(seen)) == len(seen) == 4
    asked = seen.copy()
    found = Exposures(options(views=4), names, 1000, CPU)
    spread, _ = found.judge(look, 201)
    assert seen[4:8] == asked
    assert sorted(seen[4:]) == list(range(9))
    assert spread == pytest.approx(float(torch.linspace(0.7, 1.3, 9)[asked].log().std()), rel=1e-4)
    everyone = Exposures(options(views=9), names, 1000, CPU)
    everyone.judge(pairs.__getitem__, 201)
    assert torch.equal(found.matrices.detach(), everyone.matrices.detach())


def test_looking_at_a_photograph_teaches_nothing() -> None:
    image, found = 0.2 + 0.3 * noise(3, 16, 24), Exposures(options(), ["a", "b"], 100, CPU)
    found.begin(torch.eye(3, 4).repeat(2, 1, 1))
    assert found.applied(image, "a", learning=True).requires_grad
    assert not found.applied(image, "b").requires_grad
    assert found.shown == {0}


def test_they_are_learnt_and_go_on_from_what_was_kept() -> None:
    image, truth = 0.2 + 0.3 * noise(3, 16, 24), torch.eye(3, 4).repeat(2, 1, 1)
    truth[0, 0, 3], truth[1, 0, 3] = 0.1, -0.1
    found = Exposures(options(rate_final=0.01), ["a", "b"], 100, CPU)
    found.begin(torch.eye(3, 4).repeat(2, 1, 1))

    def go_on(exposures: Exposures, first: int, last: int) -> None:
        for number in range(first, last):
            name = "ab"[number % 2]
            wanted = transformed(image, truth["ab".index(name)])
            (exposures.applied(image, name, learning=True) - wanted).square().mean().backward()
            exposures.update(number)

    go_on(found, 21, 60)
    other = Exposures(options(rate_final=0.01), ["a", "b"], 100, CPU)
    other.restore({name: value.clone() for name, value in found.tensors().items()})
    go_on(found, 60, 400)
    go_on(other, 60, 400)
    assert found.matrices is not None
    assert other.matrices is not None
    assert torch.equal(found.matrices, other.matrices)
    torch.testing.assert_close(
        transformed(image, found.matrices[0].detach()), transformed(image, truth[0]), atol=5e-3, rtol=0
    )
    torch.testing.assert_close(found.matrices.detach().mean(0), torch.eye(3, 4), atol=1e-6, rtol=0)


def test_each_photograph_takes_steps_of_its_own_by_a_rate_that_falls() -> None:
    found = Exposures(options(), ["a", "b", "c", "d"], 1000, CPU)
    assert [found.rate(number) for number in (200, 600, 1000)] == pytest.approx([0.01, math.sqrt(1e-5), 0.001])
    found.begin(torch.eye(3, 4).repeat(4, 1, 1))
    image, still = 0.2 + 0.3 * noise(3, 16, 24), torch.eye(3, 4)
    found.applied(image, "a", learning=True).sum().backward()
    found.update(200)  # Adam's first step is one rate: down, and up by a quarter of it for the mean's sake
    assert found.matrices is not None
    torch.testing.assert_close(found.matrices[0].detach(), still - 0.01 * 3 / 4, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.matrices[1].detach(), still + 0.01 / 4, atol=1e-6, rtol=0)
    before = found.matrices.detach().clone()
    found.applied(image, "b", learning=True).sum().backward()
    found.update(200)  # what was shown before does not go on moving
    torch.testing.assert_close((found.matrices - before)[0].detach(), torch.full((3, 4), 0.01 / 4), atol=1e-6, rtol=0)


def test_more_than_a_saturated_value_is_no_error() -> None:
    found, image = Exposures(options(), ["a"], 1000, CPU), torch.tensor([0.4, 1.3, 1.3]).view(3, 1, 1).requires_grad_()
    photograph = torch.tensor([1.0, 1.0, 0.9]).view(3, 1, 1)
    assert saturated(image, photograph, found) is image
    found.begin(torch.eye(3, 4)[None])
    (saturated(image, photograph, found) - photograph).abs().sum().backward()
    assert image.grad is not None
    assert image.grad.flatten().tolist() == [-1, 0, 1]


def test_the_matrix_fits_what_counts() -> None:
    image, matrix = noise(3, 10, 12), torch.tensor([[0.9, 0.1, 0, 0.02], [0, 1.1, 0, 0], [0.05, 0, 0.8, 0.1]])
    truth, left = transformed(image, matrix), torch.zeros(10, 12, dtype=torch.bool)
    left[:, :6] = True
    truth[..., 6:] = 0
    torch.testing.assert_close(best_matrix(image, truth, left), matrix, atol=1e-5, rtol=0)
    grey = torch.full((3, 10, 12), 0.5)  # of one colour: the least matrix of many
    torch.testing.assert_close(transformed(grey, best_matrix(grey, 0.5 * grey, left)), 0.5 * grey)
    assert torch.equal(centred_on_identity(matrix[None]), torch.eye(3, 4)[None])


def test_several_processes_are_refused() -> None:
    training = TrainingOptions(ssim_weight=0.2, random_background=False, log_every=1, checkpoint_every=1,
                               checkpoints_kept=1, test_points=0, exposure=options())  # fmt: skip
    refuse_shared(training, Ranks())
    with pytest.raises(ConfigError, match=r"training\.exposure\.when is 'auto'.* set it to never"):
        refuse_shared(training, Ranks(size=2))
    wrong = replace(training, exposure=options(when="never"), poses=PoseOptions(when="always"))
    refuse_shared(wrong, Ranks())
    with pytest.raises(ConfigError, match=r"training\.poses\.when is 'always'"):
        refuse_shared(wrong, Ranks(size=2))


DISTURBED = (
    *("scene.disturb.exposure=0.3", "training.exposure.when=auto", "iterations=30"),
    *("backbone.capacity=adaptive", "backbone.sh_judged=0.8"),
)
"""Growth looks at photographs at steps 6 and 12, bands at step 24; exposures are told before 7, 9, 12, 16 and 22."""


def test_a_run_with_exposures_resumes_as_if_never_stopped(tmp_path: Path) -> None:
    whole = tiny_run(tmp_path / "whole", DISTURBED)
    assert whole.exposures.matrices is not None
    stopped_at(tmp_path / "stopped", DISTURBED, 12)
    a, b = final_tensors(tmp_path / "whole"), final_tensors(tmp_path / "stopped")
    assert a.keys() == b.keys()
    assert "exposure.matrices" in a
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert a["exposure.told_last"] == 22
    assert a["exposure.visits"].sum() == 9, "the steps after they were told last, and no look at a photograph beside"
    longer, _ = open_run(tmp_path / "whole", plugins(), ["iterations=300"], training=True)
    longer.step = 60
    assert longer.exposures.due(61)
    told = judge_photographs(longer)  # told again, not judged anew
    assert "exposure_spread" not in told
    assert told["exposure_motion"] < 0.2


def test_without_need_training_is_bit_for_bit_that_without_exposures(tmp_path: Path) -> None:
    plain = tiny_run(tmp_path / "plain", ["iterations=12"])
    judged = tiny_run(
        tmp_path / "judged", ["iterations=12", "training.exposure.when=auto", "training.exposure.spread=1"]
    )
    assert plain.exposures.matrices is None
    assert judged.exposures.matrices is None
    a, b = final_tensors(tmp_path / "plain"), final_tensors(tmp_path / "judged")
    assert a.keys() == b.keys()
    assert all(torch.equal(a[name], b[name]) for name in a)
