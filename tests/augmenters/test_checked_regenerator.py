"""Checks that every regenerator's pictures pass: size, colour, agreement, displacement."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import pytest
import torch
from regenerating import Made, request, strict_checks
from torch import Tensor

from gsx.augmenters.checked_regenerator import CheckedRegenerator, Redrawing, Tally
from gsx.augmenters.checks import LARGEST_DRIFT, Check, defect, displacement, match_colour, violations
from gsx.core.data.reduction import Reduction, as_blocks, box_average
from gsx.core.data.resize import resize, to_uint8
from gsx.core.errors import TrainingError
from gsx.core.training.augmenter import recall_accounts
from gsx.core.training.minibatch import merge_accounts
from gsx.core.training.regenerator import Request

STRICT = strict_checks()
BICUBIC = Reduction(filter="bicubic")


def complaint(asked: Request, result: Tensor) -> str:
    """Everything that is wrong with a result by the strict checks."""
    return defect(asked, result) or "; ".join(violations(asked, result, STRICT).values())


def texture(height: int = 40, width: int = 50, shift: float = 0.0) -> Tensor:
    """A smooth pattern, displaced to the right by so many px."""
    row, column = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5 - shift, indexing="ij")
    waves = [
        torch.sin(column / 3 + row / 5),
        torch.cos(column / 4 - row / 3),
        torch.sin(row / 2) * torch.cos(column / 5),
    ]
    return 0.5 + 0.3 * torch.stack(waves)


@pytest.mark.parametrize("shift", [0.0, 0.1, 0.25, 0.5, -0.4])
def test_displacement_is_measured(shift: float) -> None:
    assert displacement(texture(shift=shift), texture()) == pytest.approx(abs(shift), abs=0.03)


def test_flat_pictures_show_no_displacement() -> None:
    assert displacement(torch.full((3, 9, 9), 0.4), torch.full((3, 9, 9), 0.5)) == 0.0
    assert displacement(torch.rand(3, 2, 2), torch.rand(3, 2, 2)) == 0.0


def fine(shift: float = 0.0) -> Tensor:
    """The texture at twice the density."""
    row, column = torch.meshgrid((torch.arange(80) + 0.5) / 2, (torch.arange(100) + 0.5) / 2 - shift, indexing="ij")
    waves = [
        torch.sin(column / 3 + row / 5),
        torch.cos(column / 4 - row / 3),
        torch.sin(row / 2) * torch.cos(column / 5),
    ]
    return 0.5 + 0.3 * torch.stack(waves)


def test_sound_pictures_pass() -> None:
    assert complaint(request(texture()), fine()) == ""


def test_pictures_are_reduced_as_the_scene_reduces_them() -> None:
    """Bars as a photograph has them, beside their bicubic half: by box averages they would be 15 dB further apart."""
    bars = (torch.sin(torch.arange(120.0)[:, None] / 2.3 + torch.arange(160.0) / 3.1) > 0).float()
    photo = to_uint8(0.3 + 0.4 * bars.expand(3, -1, -1))
    given = request(resize(photo, 80, 60).float() / 255)
    strict = replace(STRICT, agreement=Check(limit=50.0, action="drop"))
    assert violations(replace(given, reduction=BICUBIC), photo.float() / 255, strict) == {}
    assert "agreement" in violations(given, photo.float() / 255, strict)


def test_a_window_is_not_held_to_what_lay_beyond_it() -> None:
    """Its rim was reduced together with pixels that nobody sees any more."""
    bars = (torch.sin(torch.arange(120.0)[:, None] / 2.3 + torch.arange(160.0) / 3.1) > 0).float().expand(3, -1, -1)
    low = BICUBIC.reduce(bars, 2)[:, 10:30, 20:44]
    result = bars[:, 20:60, 40:88]
    strict = replace(STRICT, agreement=Check(limit=90.0, action="drop"))
    assert violations(replace(request(low), reduction=BICUBIC), result, strict) == {}
    off = low.clone()
    off[:, 5, 5] += 0.01
    assert "agreement" in violations(replace(request(off), reduction=BICUBIC), result, strict)


def test_half_a_pixel_of_the_finer_raster_is_the_limit() -> None:
    """An enlargement with aligned corners or integer centres is displaced by half a fine pixel: a quarter of a px."""
    assert complaint(request(texture()), fine(0.2)) == ""
    assert "displaced by 0.3" in complaint(request(texture()), fine(0.3))
    weak = 0.5 + 0.1 * (texture() - 0.5)
    assert "displaced by 0.3" in complaint(request(weak), 0.5 + 0.1 * (fine(0.3) - 0.5))


@pytest.mark.parametrize(("spoil", "reason"), [
    (lambda image: image[:, :, 1:], "should be (3, 80, 100)"),
    (lambda image: image / 0, "not finite"),
    (lambda image: (255 * image).byte(), "its values are uint8 and should be display values in"),
    (lambda image: image + 0.05, "levels off"),
    (lambda image: image.flip(2), "dB from its input"),
])  # fmt: skip
def test_others_do_not(spoil, reason: str) -> None:
    assert reason in complaint(request(texture()), spoil(fine()))


def test_limits_are_options() -> None:
    """PSNR by hand: an error of 0.05 in every value is 26.02 dB, 12.75 levels."""
    asked, result = request(torch.full((3, 20, 20), 0.5)), torch.full((3, 40, 40), 0.55)

    def found(agreement: float, colour: float) -> list[str]:
        limits = {"agreement": Check(limit=agreement, action="warn"), "colour": Check(limit=colour, action="drop")}
        return list(violations(asked, result, replace(STRICT, **limits)))

    assert found(26.03, 12.8) == ["agreement"]
    assert found(26.01, 12.7) == ["colour"]
    assert found(26.01, 12.8) == []
    off = Check(limit=0.0, action="off")
    assert violations(asked, result, replace(STRICT, agreement=off, colour=off)) == {}
    with pytest.raises(ValueError, match="'loud'; choose drop, warn or off"):
        Check(limit=1.0, action="loud")


def test_colours_are_put_right_where_they_drift() -> None:
    given = request(texture())
    assert torch.equal(match_colour(given, fine() + 1 / 255), fine() + 1 / 255)
    matched = match_colour(given, fine() + torch.tensor([0.1, 0.0, -0.05])[:, None, None])
    torch.testing.assert_close(matched.mean((1, 2)), texture().mean((1, 2)))


def test_a_picture_that_reduces_to_its_input_in_light_keeps_its_colour() -> None:
    """Stripes of 0 and 1 are 0.735 as their mean light is shown, not 0.5."""
    stripes, light = (torch.arange(24) % 2).float().expand(3, 24, 24).contiguous(), Reduction(light="linear")
    given = replace(request(light.reduce(stripes, 2)), reduction=light)
    assert float(given.image.mean() - stripes.mean()) > 0.2
    assert torch.equal(match_colour(given, stripes), stripes)
    for factor in (0.9, 0.8):
        matched = match_colour(given, factor * stripes)
        assert float((light.reduce(matched, 2) - given.image).mean().abs()) <= LARGEST_DRIFT


def test_box_averages() -> None:
    image = torch.arange(16.0).view(1, 4, 4)
    assert box_average(image, 2).tolist() == [[[2.5, 4.5], [10.5, 12.5]]]
    assert torch.equal(box_average(image, 1), image)


# -- the whole: put right, checked, counted ----------------------------------------------------------------------------


def checked(enlarge: Callable[[Request], Tensor]) -> CheckedRegenerator:
    tally = Tally(name="mine", remedies=["choose another regenerator/upscale", "loosen checks.upscale"])
    return CheckedRegenerator(inner=Made(enlarge), checks=STRICT, tally=tally)


def spoilt_where(spoilt: Collection[int]) -> Callable[[Request], Tensor]:
    """The input in blocks; not finite for those numbers."""
    return lambda asked: as_blocks(asked.image, asked.scale) * (torch.nan if asked.number in spoilt else 1.0)


def test_whoever_asks_gets_checked_pictures_and_their_tally(caplog: pytest.LogCaptureFixture) -> None:
    """One of three is lost: it has no picture and a reason; told once, at the step that asked for it."""
    regenerator = checked(spoilt_where({1}))
    drawn = regenerator.redraw([replace(request(texture()), number=number) for number in range(3)])
    assert [one.image is None for one in drawn] == [False, True, False]
    assert drawn[1].problem == "a: it holds values that are not finite"
    told = {"event": 6, "asked": {"2": 3}, "dropped": {"2": 1}, "warned": {}}
    assert regenerator.tally.account_at(7) == told
    assert "mine: 1 of 3 x2 pictures dropped: a: it holds values that are not finite" in caplog.text
    assert regenerator.tally.account_at(8) == {}


def test_losing_most_pictures_is_an_error_that_names_remedies() -> None:
    regenerator = checked(spoilt_where({0, 1}))
    regenerator.redraw([replace(request(texture()), number=number) for number in range(3)])
    with pytest.raises(TrainingError, match=r"lost 2 of 3 pictures at x2, step 6: .*, or loosen checks\.upscale"):
        regenerator.tally.account(6)


def test_one_bad_picture_among_those_asked_for_now_and_then_ends_nothing() -> None:
    """The first 4 of 8 are lost, which is half; then the ninth is lost too."""
    regenerator = checked(spoilt_where({0, 1, 2, 3, 8}))
    for number in range(8):
        regenerator.redraw([replace(request(texture()), number=number)])
        assert regenerator.tally.account_at(number + 1)["dropped"] == ({"2": 1} if number < 4 else {})
    regenerator.redraw([replace(request(texture()), number=8)])
    with pytest.raises(TrainingError, match="lost 5 of 9 pictures at x2, step 8"):
        regenerator.tally.account_at(9)


class Mine(Redrawing):
    """An augmenter that redraws pictures and nothing else."""

    def __init__(self) -> None:
        self.regenerator = checked(lambda asked: asked.image)

    def term(self, run: Any, step: int, view: int) -> None:
        return None

    def begins(self) -> int:
        return 0

    def plan(self) -> dict[str, Any]:
        return {}


def test_accounts_of_processes_add_up_and_outlive_an_interruption() -> None:
    first = {"mine": {"event": 3, "asked": {"1": 2, "2": 2}, "dropped": {"2": 1}, "warned": {"colour": {"1": 1}}}}
    second = {"mine": {"event": 3, "asked": {"2": 6}, "dropped": {"2": 2}, "warned": {"colour": {"2": 3}}}}
    total = merge_accounts([first, second, {}])
    assert total == {
        "mine": {"event": 3, "asked": {"1": 2, "2": 8}, "dropped": {"2": 3}, "warned": {"colour": {"1": 1, "2": 3}}}
    }
    lines = [{"step": 4, "pseudo": total}, {"step": 5}, {"step": 6, "pseudo": {"other": {}}}]
    augmenter = Mine()
    recall_accounts({"mine": augmenter}, lines)
    tally = augmenter.regenerator.tally
    assert (tally.requested, tally.dropped) == ({"1": 2, "2": 8}, {"2": 3})


def test_the_mean_of_samples_counts_and_is_projected_where_that_is_asked_for() -> None:
    """Samples of 0.6 and 0 off have a mean of 0.3 in half of each block: 16 dB, which no shift of the colour mends."""

    def uneven(asked: Request) -> Tensor:
        out = as_blocks(asked.image, asked.scale).clone()
        off = 0.6 if asked.seed % 2 else 0.0
        out[:, ::4] -= off
        out[:, 2::4] += off
        return out

    asked = request(torch.full((3, 8, 8), 0.5))
    (plain,) = checked(uneven).redraw([asked], samples=2)
    assert plain.image is None
    assert plain.problem.startswith("a: reduced it is 16.5 dB from its input")
    (moved,) = checked(uneven).redraw([asked], samples=2, project=True)
    assert moved.image is not None
    torch.testing.assert_close(box_average(moved.image, 2), asked.image)


def test_what_a_regenerator_does_to_its_picture_stays_its_own() -> None:
    """A function that works in place, for example."""
    asked = request(torch.full((3, 8, 8), 0.25), scale=1)
    found = checked(lambda own: own.image.add_(0.125)).redraw([asked], samples=2)[0]
    assert asked.image.unique().tolist() == [0.25]
    assert found.image is not None
    assert found.image.unique().tolist() == [0.25]  # put right by its own mean


def test_samples_of_other_sizes_are_dropped_as_one_of_that_size_is() -> None:
    def growing(asked: Request) -> Tensor:
        return torch.rand(3, 16, 16 + asked.seed % 2)

    (found,) = checked(growing).redraw([request(torch.full((3, 8, 8), 0.5))], samples=2)
    assert found.problem == "a: it is (3, 16, 17) and should be (3, 16, 16)"


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (lambda asked: [one.image for one in asked][1:], "got 2 requests and returned 1: return a tensor"),
        (lambda asked: None, "returned NoneType: return a tensor"),
        (lambda asked: [one.image.numpy() for one in asked], "returned ndarray among them: return a tensor"),
    ],
)
def test_what_is_no_picture_for_each_request_is_told_with_the_regenerator(
    returned: Callable[[list[Request]], object], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = checked(lambda asked: asked.image)
    monkeypatch.setattr(made.inner, "regenerate", returned)
    with pytest.raises(TrainingError, match=rf"^Made\.regenerate .*{told}"):
        made.redraw([request(texture(), 1)] * 2)
