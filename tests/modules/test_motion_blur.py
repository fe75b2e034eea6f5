"""Movements of cameras, told from pairs of pictures of which one was moved by a known one."""

import math

import pytest
import torch
from torch import Tensor, fft
from torch.nn.functional import avg_pool2d

from gsx.modules.motion_blur import (
    LONGEST,
    error_after,
    kernel_spectrum,
    line_kernel,
    motion_blurred,
    movement_between,
    spectra_of,
)


def picture(seed: int = 0) -> Tensor:
    """Of coarse and fine detail, in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    fine = avg_pool2d(torch.rand(3, 122, 162, generator=generator), 3, 1)
    coarse = torch.nn.functional.interpolate(torch.rand(1, 3, 8, 10, generator=generator), (120, 160), mode="bilinear")
    return (fine + coarse[0]) / 2


def softened(image: Tensor) -> Tensor:
    """As by a model that is blurred in all directions: means over 3 x 3 px."""
    return avg_pool2d(image[None], 3, 1, 1, count_include_pad=False)[0]


def noise(size: float) -> Tensor:
    return size * torch.randn(3, 120, 160, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize(
    ("movement", "least"), [((5.0, 2.0), 0.95), ((-3.0, 7.5), 0.95), ((2.0, 0.0), 0.95), ((0.0, 12.0), 0.9)]
)
def test_a_known_movement_is_found(movement: tuple[float, float], least: float) -> None:
    """The longest is a tenth of the picture, whose edges explain nothing."""
    found = movement_between(picture(), motion_blurred(picture(), *movement))
    sign = math.copysign(1, found.across * movement[0] + found.down * movement[1])
    assert sign * found.across == pytest.approx(movement[0], abs=0.5)
    assert sign * found.down == pytest.approx(movement[1], abs=0.5)
    assert found.explained > least


@pytest.mark.parametrize("movement", [(2.0, 0.0), (3.0, 1.0), (-2.0, 6.0)])
def test_it_is_not_found_too_short_where_the_model_is_blurred_itself(movement: tuple[float, float]) -> None:
    """The difference of the pictures is least after a shorter movement, or none at all."""
    found = movement_between(softened(picture()), motion_blurred(picture(), *movement))
    sign = math.copysign(1, found.across * movement[0] + found.down * movement[1])
    assert sign * found.across == pytest.approx(movement[0], abs=0.3)
    assert sign * found.down == pytest.approx(movement[1], abs=0.3)


def test_none_is_found_where_the_photograph_is_as_sharp_or_sharper() -> None:
    """Noise is no movement."""
    for sharp, photograph in (
        (picture(), picture() + noise(0.03)),
        (softened(picture()), picture()),
        (picture(),) * 2,
    ):
        found = movement_between(sharp, photograph)
        assert (found.length, found.explained) == (0, 0)


@pytest.mark.parametrize("turned", [False, True])
def test_what_moved_in_a_half_of_the_picture_was_not_the_camera(turned: bool) -> None:
    """Somebody ran past; or the model, there, is blurred along a line."""
    sharp, moved = picture(), motion_blurred(picture(), 6.0, 0.0)
    photograph = torch.cat([sharp[..., :80] + noise(0.03)[..., :80], moved[..., 80:]], 2)
    pair = (sharp, photograph) if not turned else (sharp.mT, photograph.mT)
    assert movement_between(*pair).explained == 0
    assert movement_between(sharp, moved).explained > 0.9
    # a half of which little counts does not judge the other
    counted = torch.ones(120, 160, dtype=torch.bool)
    counted[:, :70] = False
    found = movement_between(sharp, photograph, counted)
    assert abs(found.across) == pytest.approx(6, abs=0.5)
    assert found.explained > 0.5


@pytest.mark.parametrize("grain", [0.0, 0.004])
@pytest.mark.parametrize("sky", [1.0, 0.7, None])
def test_where_a_movement_cannot_be_seen_nothing_speaks_against_it(sky: float | None, grain: float) -> None:
    """A half is saturated, plain, or gets darker evenly; on upright pictures and others."""
    sharp = octaves()
    sharp[..., :80] = torch.linspace(0.9, 0.6, 80) if sky is None else sky
    photograph = (motion_blurred(sharp, 6.0, 2.0) + noise(grain)).clamp(0, 1)
    for pair in ((sharp, photograph), (sharp.mT, photograph.mT)):
        found = movement_between(*pair)
        assert found.length == pytest.approx(math.hypot(6, 2), abs=0.5)
        assert found.explained > 0.5


def octaves() -> Tensor:
    """Detail of all sizes, in [0, 1]: no noise, so that edges of masks weigh."""
    generator, out = torch.Generator().manual_seed(0), torch.zeros(3, 120, 160)
    for octave in range(5):
        grid = torch.rand(1, 3, 6 * 2**octave, 8 * 2**octave, generator=generator)
        out += torch.nn.functional.interpolate(grid, (120, 160), mode="bicubic")[0] / 2**octave
    return (out / 2).clamp(0, 1)


def left_out(what: str) -> Tensor:
    """Masks: True counts."""
    counted = torch.full((120, 160), what != "all but an object")
    if what == "a half":
        counted[:, 80:] = False
    elif what == "a hole":
        counted[40:70, 30:120] = False
    elif what == "blocks":
        out = torch.rand(30, 40, generator=torch.Generator().manual_seed(3)) < 0.2
        counted = ~out.repeat_interleave(4, 0).repeat_interleave(4, 1)
    else:
        counted[30:90, 50:110] = True
    return counted


@pytest.mark.parametrize(
    ("what", "least"), [("a half", 0.3), ("a hole", 0.3), ("blocks", 0.3), ("all but an object", 0.15)]
)
def test_what_does_not_count_says_nothing(what: str, least: float) -> None:
    """Of an object little is left in either half, inside the margin."""
    counted, photograph = left_out(what), motion_blurred(octaves(), 6.0, 0.0)
    photograph[:, ~counted] = motion_blurred(octaves(), 0.0, 10.0)[:, ~counted]
    found = movement_between(octaves(), photograph, counted)
    assert abs(found.across) == pytest.approx(6, abs=0.7)
    assert abs(found.down) < 0.5
    assert found.explained > least


def test_where_nothing_counts_or_pictures_are_small_there_is_no_movement() -> None:
    sharp, photograph = octaves(), motion_blurred(octaves(), 6.0, 0.0)
    none = movement_between(sharp, photograph, torch.zeros(120, 160, dtype=torch.bool))
    small = movement_between(sharp[:, :31], photograph[:, :31])
    for found in (none, small, movement_between(sharp[:, :, :1], photograph[:, :, :1])):
        assert (found.length, found.explained) == (0, 0)


def test_a_model_that_is_blurred_along_a_line_makes_photographs_look_moved_across_it() -> None:
    """What is known to be told wrongly."""
    found = movement_between(motion_blurred(picture(), 4.0, 0.0), picture())
    assert abs(found.across) < 0.5 < abs(found.down)
    assert found.explained < 0.1


def test_no_movement_is_longer_than_the_longest() -> None:
    found = movement_between(picture(), motion_blurred(picture(), 60.0, 0.0))
    assert 12 < abs(found.across) <= LONGEST


@pytest.mark.parametrize("movement", [(2.0, 0.0), (-6.0, 3.0), (0.5, 9.0), (0.0, 0.0)])
def test_what_a_movement_leaves_is_the_spectrum_of_its_kernel(movement: tuple[float, float]) -> None:
    kernel, around = line_kernel(*movement), torch.zeros(120, 160, dtype=torch.float64)
    around[: len(kernel), : len(kernel)] = kernel
    truth = fft.rfft2(around.roll((-(len(kernel) // 2),) * 2, (0, 1)))
    found = kernel_spectrum(movement, spectra_of(picture()[0], picture()[0], None))
    torch.testing.assert_close(found, truth.real, atol=1e-12, rtol=0)
    assert truth.imag.abs().max() < 1e-12


def test_the_gain_of_a_ring_is_free_and_that_of_a_direction_is_not() -> None:
    """By least squares, ring by ring."""
    sharp, photograph = (one.mean(0) for one in (picture(), motion_blurred(picture(1), 3.0, 0.0)))
    spectra, left = spectra_of(sharp, photograph, None), 0.0
    assert int(spectra.ring[spectra.sharp > 0].max()) == 32, "half a cycle per px"
    for ring in range(33):
        here = spectra.ring == ring
        after = kernel_spectrum((3.0, 1.0), spectra)[here]
        gain = max(0.0, float((spectra.shared[here] * after).sum() / (spectra.sharp[here] * after**2).sum()))
        left += float((gain**2 * spectra.sharp[here] * after**2 - 2 * gain * spectra.shared[here] * after).sum())
    assert error_after((3.0, 1.0), spectra) == pytest.approx(spectra.photo + left, rel=1e-9)
    assert error_after((0.0, 0.0), spectra_of(sharp, 2 * sharp, None)) == pytest.approx(0, abs=1e-9 * spectra.photo)
