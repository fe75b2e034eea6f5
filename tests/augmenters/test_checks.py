"""Checks of redrawn pictures: what each regenerator is held to, and what is lost is told scale by scale."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from regenerating import Made, noisy, of_role
from test_pseudo_details import augmenter_of, run_at
from tiny import tiny_settings
from torch import Tensor

from gsx.augmenters.pseudo_details import PseudoDetails
from gsx.builtin import plugins
from gsx.core.data.reduction import as_blocks
from gsx.core.errors import ConfigError, TrainingError
from gsx.core.training.regenerator import Request
from gsx.core.training.run import Run
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.open import start

LATENT = ("regenerator/upscale=sd_x2_latent", "regenerator/restore=sdxl_turbo")


def by_hand(run: Run, enlarge: Callable[[Request], Tensor], **changes: Any) -> PseudoDetails:
    """The run's first augmenter with a regenerator made of a function."""
    old = augmenter_of(run)
    options = replace(old.options, **changes)
    return PseudoDetails(options, replace(old.context, regenerator=of_role(Made(enlarge))))


# -- every regenerator by what it can do -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run whose windows are wide enough for x8."""
    words = ("scene.width=112", "scene.height=84", "rasterizer=eager")
    return start(tiny_settings(tmp_path_factory.mktemp("runs") / "wide", *words), plugins())


def test_models_that_see_through_an_autoencoder_pass_as_they_are(wide: Run) -> None:
    """kl-f8 reconstructs to 23.4 +- 3.8 dB: with 20 dB nothing is dropped, and what strays is counted."""
    settings = compose(["augmenter=[upscale_paper,bootstrap]", *LATENT], plugins())
    for name, chosen in settings.augmenters.items():
        augmenter = noisy(chosen.options, name, wide)
        wide.step = augmenter.event = augmenter.events[0]
        _, facts = augmenter.made(wide, augmenter.event, {0, 1})
        assert facts["dropped"] == {}
        assert sum(facts["warned"]["displacement"].values()) > 0


def test_the_same_pictures_do_not_pass_for_consistent_ones(wide: Run) -> None:
    settings = compose(["augmenter=upscale_paper", "regenerator/upscale=lanczos"], plugins())
    augmenter = noisy(settings.augmenters["upscale"].options, "upscale", wide)
    wide.step = augmenter.event = augmenter.events[0]
    with pytest.raises(TrainingError, match=r"lost 6 of 6 pictures at x2.*dB from its input"):
        augmenter.made(wide, augmenter.event, {0, 1})


@pytest.mark.parametrize(("words", "actions"), [
    (("augmenter=upscale",), {"drop"}),
    (("augmenter=upscale", "regenerator/upscale=lanczos"), {"drop"}),
    (("augmenter=bootstrap",), {"drop"}),
    (("augmenter=upscale_paper", "regenerator/upscale=sd_x2_latent"), {"warn"}),
    (("augmenter=bootstrap", "regenerator/restore=sdxl_turbo"), {"warn"}),
    (("augmenter=upscale", "regenerator/upscale=callable"), {"warn"}),
    (("variant=octree_ub", "budget=quick", "dataset=demo"), {"drop"}),
    (("augmenter=upscale", "augmenter.upscale.checks.colour.action=off"), {"off", "drop"}),
])  # fmt: skip
def test_those_that_promise_consistency_are_held_to_it(words: tuple[str, ...], actions: set[str]) -> None:
    augmenters = compose(list(words), plugins()).augmenters.values()
    for chosen in augmenters:
        checks = chosen.options.checks
        assert {check.action for check in (checks.colour, checks.agreement, checks.displacement)} == actions


def test_an_unknown_action_is_named() -> None:
    with pytest.raises(ConfigError, match="'loud'; choose drop, warn or off"):
        compose(["augmenter=upscale", "augmenter.upscale.checks.agreement.action=loud"], plugins())
    with pytest.raises(ConfigError, match=r"checks\.upscale\.agrement"):
        compose(["augmenter=upscale", "+checks.upscale.agrement.action=warn"], plugins())


# -- what is lost ------------------------------------------------------------------------------------------------------


def good(request: Request) -> Tensor:
    """The input in blocks: its box average is the input."""
    return as_blocks(request.image, request.scale)


def test_losing_a_whole_scale_is_an_error_though_it_is_half_of_the_pictures(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 60, "augmenter=upscale")
    spoilt = by_hand(run, lambda request: good(request) * (torch.nan if request.scale == 2 else 1.0))
    with pytest.raises(TrainingError, match="lost 6 of 6 pictures at x2, step 60"):
        spoilt.term(run, 61, 2)


@pytest.mark.parametrize(("mode", "reduce"), [("direct", "all"), ("hybrid", "all"), ("direct", "per_scale")])
def test_what_is_left_weighs_as_if_nothing_were_lost(mode: str, reduce: str, tmp_path: Path) -> None:
    """The x2 picture of view 2 is lost: its x1 keeps half of the weight, and the photograph the other half."""
    run = run_at(tmp_path / "run", 60, "augmenter=upscale")

    def enlarge(request: Request) -> Tensor:
        return good(request) * (torch.nan if request.scale == 2 and request.number == 2 else 1.0)

    augmenter = by_hand(run, enlarge, mode=mode, reduce=reduce, gain=1.0, weights=[0.3, 0.3])
    whole, lost = (augmenter.term(run, 61, view) for view in (0, 2))
    assert whole is not None
    assert lost is not None
    each = 0.5 * (1.0 if mode == "direct" else 0.3)
    assert [weight for _, weight in whole.parts] == pytest.approx([each, each])
    assert [weight for _, weight in lost.parts] == pytest.approx([each])
    assert lost.parts[0][0].provenance["scale"] == 1
    assert (whole.replaces, lost.replaces) == pytest.approx((0.0, 0.0) if mode == "direct" else (0.3, 0.15))


def test_an_augmenter_tells_what_became_of_its_pictures_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = run_at(tmp_path / "run", 60, "augmenter=upscale", "augmenter.upscale.checks.displacement.action=off")

    def enlarge(request: Request) -> Tensor:
        spoilt = request.scale == 2 and request.number in (1, 4)
        return good(request) * (torch.nan if spoilt else 1.0) + (0.3 if request.number == 3 else 0.0)

    checks = augmenter_of(run).options.checks
    lenient = replace(checks, colour=replace(checks.colour, limit=0.0, action="warn"))
    augmenter = by_hand(run, enlarge, checks=lenient)
    augmenter.term(run, 61, 0)
    told = augmenter.regenerator.tally.account_at(61)
    assert told["event"] == 60
    assert told["asked"] == {"1": 6, "2": 6}
    assert told["dropped"] == {"2": 2}
    assert "2 of 6 x2 pictures dropped: " in caplog.text
    assert sum(told["warned"].get("colour", {}).values()) > 0
    assert augmenter.regenerator.tally.account_at(62) == {}
    again = by_hand(run, enlarge, checks=lenient)
    run.step = 61
    again.term(run, 62, 0)  # from the file
    assert again.views.keys() == augmenter.views.keys()
    assert again.regenerator.tally.account_at(62) == {}


def test_nothing_else_is_dropped(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run", 60, "augmenter=upscale")
    augmenter = by_hand(run, good)
    augmenter.term(run, 61, 0)
    assert augmenter.regenerator.tally.account_at(61)["dropped"] == {}
    assert augmenter.regenerator.tally.account_at(61)["warned"] == {}
