"""Appearance of each photo: a small code, decoded to exposure, white balance and light across the photo.

NeRF in the Wild (Martin-Brualla et al. 2021) learns a code per photo and a network that decodes it. Ours: codes are
principal components of measured responses, so few numbers hold what differs among these photos; codes and decoder then
learn with the model, by Adam. A response is light across the photo, then a colour matrix: 14 numbers, all 0 for the
identity, in display values. A falloff towards the corners and a tone, as in PPISP (Deutsch et al. 2026), recovered no
more of demo with gains and slopes. The mean code stays 0, the neutral one, which novel views have.
The code of a held-out view is fitted to a part of its photo, for figures next to those of the neutral one.
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.quality.colour_matrix import transform_colours
from gsx.core.ranges import Range
from gsx.core.shapes import Bool, Float
from gsx.core.training.run import Run
from gsx.modules.bilateral_grid import WHOLE, Edges, centres
from gsx.modules.corrections import Times, ViewCount, log_test, percent, sample
from gsx.modules.exposure import (
    EQUAL,
    LearnedCorrection,
    LearnedOptions,
    light_of,
    photo_pair,
    spreads_of,
    within_range,
)
from gsx.modules.photo_pairs import Pair, usable_pixels

NUMBERS, MATRIX = 14, 12
"""Numbers of a response; the first of them are the matrix less the identity, the others slopes of the log light."""
FIT_PIXELS = 1 << 14
"""Most pixels of a fit, evenly spread over those that count."""
FIT_STEPS = 5
INDEPENDENT = 250
"""Pixels that count as one measurement: a model's errors are alike in neighbours (as in `alignment`)."""
LEAST_ERROR = 1 / 255
"""Least standard deviation of a fit's residuals, display values."""
logger = logging.getLogger(__name__)
PRIOR = 0.3
"""Standard deviation of the numbers of a photo before it is measured."""
LEAST_SPREAD = 1e-4
"""Least standard deviation of codes in the prior of a held-out view's code."""


def light_fields(image: Float[Tensor, "3 H W"], edges: Edges = WHOLE) -> Float[Tensor, "2 H W"]:
    """Returns x and y of each pixel, [-1, 1] over the photo: the fields of the log light."""
    left, top, right, bottom = edges
    height, width = image.shape[1:]
    x = centres(left, right, width, image).expand(height, -1)
    return torch.stack([x, centres(top, bottom, height, image)[:, None].expand(-1, width)])


def respond(
    image: Float[Tensor, "3 H W"], fields: Float[Tensor, "2 H W"], numbers: Float[Tensor, "14"]
) -> Float[Tensor, "3 H W"]:
    """Returns the photo of a render by these numbers. Differentiable in both."""
    return transform_colours(image * torch.einsum("k,khw->hw", numbers[MATRIX:], fields).exp(), matrix_of(numbers))


def matrix_of(numbers: Float[Tensor, "14"]) -> Float[Tensor, "3 4"]:
    """Returns the colour matrix."""
    return torch.eye(3, 4, dtype=numbers.dtype, device=numbers.device) + numbers[:MATRIX].view(3, 4)


def response_slopes(
    image: Float[Tensor, "3 N"], fields: Float[Tensor, "2 N"], numbers: Float[Tensor, "14"]
) -> Float[Tensor, "3 N 14"]:
    """Returns the derivatives of `respond` by its numbers."""
    lit = image * (numbers[MATRIX:] @ fields).exp()
    entries = torch.cat([lit, torch.ones_like(lit[:1])]).T
    by_matrix = torch.eye(3).to(lit)[:, None, :, None] * entries[:, None]
    by_light = (matrix_of(numbers)[:, :3] @ lit)[..., None] * fields.T
    return torch.cat([by_matrix.flatten(2), by_light], 2)


def fit_code(
    image: Float[Tensor, "3 H W"],
    photo: Float[Tensor, "3 H W"],
    counted: Bool[Tensor, "H W"],
    decoder: Float[Tensor, "14 C"],
    precisions: Float[Tensor, "C"],
) -> Float[Tensor, "C"]:
    """Fits a code, whose numbers are `decoder @ code`, to the pixels of a photo that count.

    precisions: inverse variances of the prior, which is centred on 0: the answer where no pixel counts.
    """
    places = counted.flatten().cpu().nonzero()[:, 0]
    places = places[:: max(1, -(-len(places) // FIT_PIXELS))].to(image.device)
    pixels, target, fields = (
        part.flatten(1)[:, None, places].double() for part in (image, photo.to(image.device), light_fields(image))
    )
    decoder, prior = decoder.double(), torch.diag(precisions.double())
    code = decoder.new_zeros(decoder.shape[1])
    for _ in range(FIT_STEPS if len(places) else 0):
        error = (target - respond(pixels, fields, decoder @ code)).flatten()
        slope = (response_slopes(pixels[:, 0], fields[:, 0], decoder @ code) @ decoder).flatten(0, 1)
        weight = 1 / (INDEPENDENT * float(error.square().mean().clamp(min=LEAST_ERROR**2)))
        code = code + torch.linalg.solve(weight * slope.T @ slope + prior, weight * slope.T @ error - prior @ code)
    return code.to(image.dtype)


def principal_codes(numbers: Float[Tensor, "N 14"], size: int) -> tuple[Float[Tensor, "N C"], Float[Tensor, "14 C"]]:
    """Returns (codes, decoder) that come closest to the numbers less their mean: their principal components."""
    left, scales, right = torch.linalg.svd(numbers - numbers.mean(0), full_matrices=False)
    return (left[:, :size] * scales[:size]).contiguous(), right[:size].T.contiguous()


@dataclass(frozen=True, kw_only=True)
class AppearanceOptions(LearnedOptions):
    """Options; values in conf/module/appearance.yaml."""

    key: ClassVar[str] = "appearance"
    times: Times = 1
    """Number of estimates; each restarts learning."""
    size: Annotated[int, Range(1, NUMBERS)] = 8
    """Numbers in a code; fewer where photos are fewer."""
    spread: Annotated[float, Range(0, 1)] = 0.06
    """`auto`: standard deviation of log gains above which photos get codes."""
    light_spread: Annotated[float, Range(0, 1)] = 0.08
    """`auto`: the same of slopes of log gains, from the middle of a photo to its sides."""
    views: ViewCount = 24
    """Most photos that the test uses."""


class Appearance(LearnedCorrection):
    """Appearance of each photo: a code of a few numbers, and a linear decoder that all photos share."""

    options: AppearanceOptions
    seconds_key = "appearance_seconds"
    figures_key = "appearance"
    count_key = "appearances"
    thresholds = ("spread", "light_spread")

    moment_names: ClassVar[Mapping[str, str]] = {"codes": "adam.codes", "decoder": "adam.decoder"}

    # -- estimates -----------------------------------------------------------------------------------------------------

    def estimate(self, run: Run, step: int) -> dict[str, float]:
        """Tests if photos differ, or measures the codes again with the better model."""
        views, bare = run.train_views, run.views.without(self)

        def measure(index: int) -> Pair:
            return photo_pair(run, views[index], bare)

        return self.measure_all(measure, step) if self.active else self.test(measure, step)

    def test(self, measure: Callable[[int], Pair], step: int) -> dict[str, float]:
        """Measures the light of some photos, and the codes of all if they differ."""
        options, count = self.options, len(self.visits)
        lights = [light_of(measure(index), slopes=True) for index in sample(range(count), options.views, self.name)]
        spread, within = spreads_of(lights)
        differ = options.when == "always" or spread > options.spread or within > options.light_spread
        action = "learning a code per photo" if differ else EQUAL
        log_test(step, "exposure spread", spread, options.spread, percent, action)
        log_test(step, "light spread within photos", within, options.light_spread, percent, action)
        spreads = {"appearance_spread": spread, "appearance_light": within}
        return spreads | (self.measure_all(measure, step) if differ else {self.count_key: 0})

    def measure_all(self, measure: Callable[[int], Pair], step: int) -> dict[str, float]:
        """Restarts learning from the measured responses of all photos."""
        count = len(self.visits)
        numbers = torch.stack([response_of(measure(index)) for index in range(count)])
        codes, decoder = principal_codes(numbers, self.options.size)
        self.start(codes=codes, decoder=decoder)
        self.last_estimate = step
        size = self.learned["codes"].shape[1]
        logger.info("step %d: appearance of %d photos measured, %d numbers each", step, count, size)
        return {self.count_key: count, "appearance_numbers": size}

    # -- learning ------------------------------------------------------------------------------------------------------

    def transform_render(
        self, image: Tensor, view: View, photo: Tensor | None, window: Window | None, learning: bool
    ) -> Tensor:
        """Returns the render with the appearance of its photo; where the photo is saturated, more is no error."""
        if not self.learned:
            return image
        index, edges = self.indices[view.name], WHOLE if window is None else window.shares(*view.camera.size)
        if learning:
            self.rendered.add(index)
        codes, decoder = (value if learning else value.detach() for value in self.learned.values())
        image = image.to(self.context.device)
        return within_range(respond(image, light_fields(image, edges), decoder @ codes[index]), photo)

    @torch.no_grad()
    def optimizer_step(self, step: int) -> None:
        """Takes a step of Adam for the decoder and the codes of rendered photos; keeps the mean code 0."""
        if not self.has_gradients():
            return
        for index in sorted(self.rendered):
            self.visits[index] += 1
            self.take_adam_step("codes", index, float(self.visits[index]), step)
        self.take_adam_step("decoder", ..., float(self.visits.sum()), step)
        self.learned["codes"] -= self.learned["codes"].mean(0)
        self.zero_grad()

    @torch.no_grad()
    def fit_render(
        self, image: Float[Tensor, "3 H W"], photo: Float[Tensor, "3 H W"], fitted: Bool[Tensor, "H W"]
    ) -> Float[Tensor, "3 H W"] | None:
        """Returns the render of a held-out view by the code that fits these pixels of its photo; None: no codes."""
        if not self.learned:
            return None
        codes, decoder = (value.detach() for value in self.learned.values())
        spread = codes.std(0, unbiased=False).clamp(min=LEAST_SPREAD)
        image = image.to(decoder.device)
        code = fit_code(image, photo, fitted, decoder, spread**-2)
        return respond(image, light_fields(image), decoder @ code)

    @classmethod
    def figures(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the step of the test, its spreads, and how many photos have codes of how many numbers."""
        first = lines[0]
        figures = {"step": first["step"], "spread": first.get("appearance_spread"), "photos": first[cls.count_key]}
        return figures | {"within": first.get("appearance_light"), "numbers": first.get("appearance_numbers", 0)}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Reports that photos have codes, and the figures of test views with codes of their own."""
        figures = evaluation.get("appearance") or {}
        if figures.get("photos"):
            yield (
                f"each photo has an appearance code of {figures['numbers']} numbers from step {figures['step']:,} on: "
                "the model has that of the mean photo"
            )
        if fitted := (evaluation.get("fitted") or {}).get("appearance"):
            yield (
                f"test views with codes fitted on their left halves: {fitted['psnr']:.2f} dB on the right halves, "
                f"{fitted['psnr_rendered']:.2f} dB without codes"
            )


def response_of(pair: Pair) -> Float[Tensor, "14"]:
    """Measures the numbers of a photo's response."""
    image, photo, _ = pair
    return fit_code(image, photo, usable_pixels(*pair), torch.eye(NUMBERS), torch.full((NUMBERS,), PRIOR**-2))
