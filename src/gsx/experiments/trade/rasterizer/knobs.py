"""What each knob of the rasterizer costs and gives: the sweep's choices, errors, front, recommendation and table.

Nothing here looks at a clock; `bench.py` does.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import torch
from torch import Tensor

from gsx.core.errors import ConfigError, nearest
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.settings import CHOICES
from gsx.core.shapes import Float
from gsx.experiments.reports.charts import pareto_front

VALUES: dict[str, tuple[Any, ...]] = {
    "schedule": ("chunks", "segments"),
    "tile_size": (4, 8, 16, 32),
    "chunk": (8, 16, 32),
    "cull": CHOICES["cull"],
    "alpha_min": (0.001, 1 / 255, 0.008, 0.016),
    "transmittance_stop": (0.0, 1e-4, 1e-3, 1e-2),
    "evaluation": CHOICES["evaluation"],
    "accumulation": CHOICES["accumulation"],
    "exponent": CHOICES["exponent"],
    "tile_cap": (0, 128, 512, 2048),
}
"""Values tried for each setting; the published ones are among them."""
KNOBS = ("path", *VALUES)
"""Everything that can be swept."""
OUTLIERS = 1e-4
"""Share of the pixels that may jump: where rounding decides whether a splat reaches a cut-off, a pixel changes by up to
that cut-off, so over a whole picture the largest error of float32 is that of a few such pixels."""
NOISE = 0.03
"""Times that differ by less than this fraction are taken as equal."""
WORTHWHILE = 0.1
"""A change that saves less than this fraction of the time or of the error is not combined with others."""
ROUND = 1e-3
"""Gradients of orientations count against at least this fraction of those of log-scales: round splats have none."""
COSTS = {"step_ms": "forward and backward", "forward_ms": "forward only"}
"""Times of a row, by what they measure."""
SPREADS = {"step_ms": "step_spread", "forward_ms": "forward_spread"}


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Settings to try."""

    knob: str
    """The knob turned, `base` for none, `combination` for several."""
    changes: dict[str, Any]
    """What differs from the base settings."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A trial and what came of it. Errors are against the float64 truth by the rules of the base settings."""

    knob: str
    changes: dict[str, Any]
    failure: str = ""
    """Why there are no figures; empty: there are."""
    fell_back: bool = False
    """Drawn by the eager path although the compiled one was asked for."""
    ratio: float = math.nan
    """Time of forward and backward over that of the base settings: median over rounds of the ratio within a round."""
    step_ms: float = math.nan
    """Forward and backward, ms a picture: the base settings' median over the rounds, times the ratio."""
    forward_ms: float = math.nan
    """Forward alone, without gradients, by the same rule."""
    step_spread: float = 0.0
    """Half the range of the ratio over the rounds, as a fraction of it."""
    forward_spread: float = 0.0
    max_error: float = math.nan
    """Largest difference of a pixel's channel, display units."""
    most_error: float = math.nan
    """The same without the worst pixels, a share of OUTLIERS."""
    psnr: float = math.nan
    """Against the truth, dB."""
    ideal_psnr: float = math.nan
    """Against the picture without any cut-off, dB."""
    gradient_error: float = math.nan
    """Norm of the difference over norm of the truth, of the worst field of the splats."""
    gradient_field: str = ""
    pairs: float = math.nan
    """Splat-tile pairs a picture."""
    memory_mb: float | None = None
    """Peak of the working memory, MB; None where the machine does not tell."""

    @property
    def settings(self) -> str:
        """The changes in words."""
        return (spelled(self.changes) or "base settings") + (" (by the eager path)" if self.fell_back else "")


def spelled(changes: Mapping[str, Any]) -> str:
    """Changes as `tile_size=16 alpha_min=0.008`."""
    return " ".join(f"{name}={f'{v:.4g}' if isinstance(v, float) else v}" for name, v in changes.items())


def overrides(changes: Mapping[str, Any]) -> str:
    """Changes as they are typed on the command line."""
    return " ".join(f"rasterizer.{name}={value}" for name, value in changes.items())


def check_knobs(word: str | None) -> tuple[str, ...]:
    """Knobs from `a,b`; None: all.

    Raises:
        ConfigError: there is no such knob; the nearest is named.
    """
    knobs = KNOBS if word is None else tuple(name.strip() for name in word.split(","))
    for name in knobs:
        if name not in KNOBS:
            raise ConfigError(
                f"--knobs: '{name}' cannot be swept.{nearest(name, KNOBS)} Choose from {', '.join(KNOBS)}"
            )
    return knobs


def same(a: Any, b: Any) -> bool:
    """Equal values, floats but for rounding."""
    return math.isclose(a, b) if isinstance(a, float) else a == b


def differences(settings: RasterSettings, base: RasterSettings) -> dict[str, Any]:
    """Values of `settings` that are not those of `base`."""
    return {name: value for name, value in vars(settings).items() if not same(value, getattr(base, name))}


def path_changes(base: RasterSettings, presets: Sequence[RasterSettings]) -> list[dict[str, Any]]:
    """Paths other than the base's, each with the work sizes that its preset brings along.

    `presets` are the shipped settings of the paths that can run here.
    """
    brought = dict.fromkeys(["path", *(name for preset in presets for name in differences(preset, presets[0]))])
    paths = [{name: getattr(preset, name) for name in brought} for preset in presets]
    others = [path for path in paths if path["path"] != base.path]
    return [{name: v for name, v in path.items() if not same(v, getattr(base, name))} for path in others]


def suits(knob: str, value: Any, base: RasterSettings, cuda: bool) -> bool:
    """Whether a value means something beside the base settings on this device."""
    if (knob, value) == ("tile_size", 32):
        return base.cull == "tight"
    return cuda or (knob, value) != ("evaluation", "tf32")


def single_changes(
    base: RasterSettings, presets: Sequence[RasterSettings], *, cuda: bool, knobs: Collection[str]
) -> list[Trial]:
    """The base settings, then one knob at a time. Schedules are of the compiled path and bring it along."""
    trials = [Trial(knob="base", changes={})]
    paths = path_changes(base, presets)
    compiled = {} if base.path == "compiled" else next((p for p in paths if p["path"] == "compiled"), None)
    for knob in KNOBS:
        if knob not in knobs:
            continue
        values = [v for v in VALUES.get(knob, ()) if not same(v, getattr(base, knob)) and suits(knob, v, base, cuda)]
        changes: list[dict[str, Any]] = paths if knob == "path" else [{knob: value} for value in values]
        if knob == "schedule":
            # `auto` is one of the two
            usual = "segments" if cuda else "chunks"
            told = [] if compiled is None else [v for v in values if base.schedule != "auto" or v != usual]
            changes = [(compiled or {}) | {knob: value} for value in told]
        trials += [Trial(knob=knob, changes=change) for change in changes]
    return trials


@dataclass(frozen=True, kw_only=True)
class Guess:
    """What a combination might bring if knobs acted independently: times multiply, errors add."""

    changes: dict[str, Any]
    knobs: int
    ratio: float
    error: float


def combined(a: Guess, b: Guess) -> Guess:
    """Both changes at once."""
    return Guess(
        changes=a.changes | b.changes, knobs=a.knobs + b.knobs, ratio=a.ratio * b.ratio, error=a.error + b.error
    )


def best_guesses(guesses: Sequence[Guess]) -> list[Guess]:
    """Those that no other beats in both time and error, fastest first."""
    return [guesses[i] for i in pareto_front([g.ratio for g in guesses], [-g.error for g in guesses])]


def combinations(rows: Sequence[Row], most: int, max_error: float) -> list[Trial]:
    """Up to `most` combinations of single changes worth trying, from the measured single changes.

    A change enters if it is worthwhile alone. Of the products of such changes over the knobs those are kept whose
    guessed time and error no other product beats (pruning knob by knob loses none of them: both guesses are monotone);
    of these, evenly along the front, up to half within the budget and then others.
    """
    base, *singles = [row for row in rows if not row.failure]
    useful = [
        row
        for row in singles
        if row.ratio < 1 - max(WORTHWHILE, row.step_spread) or row.most_error < (1 - WORTHWHILE) * base.most_error
    ]
    front = [Guess(changes={}, knobs=0, ratio=1.0, error=base.most_error)]
    for _, members in groupby(useful, lambda row: "path" if "path" in row.changes else row.knob):
        steps = [Guess(changes={}, knobs=0, ratio=1.0, error=0.0)]
        steps += [
            Guess(changes=r.changes, knobs=1, ratio=r.ratio, error=r.most_error - base.most_error) for r in members
        ]
        front = best_guesses([combined(guess, step) for guess in front for step in steps])
    several = [guess for guess in front if guess.knobs > 1]
    within, beyond = ([g for g in several if (g.error <= max_error) is fits] for fits in (True, False))
    chosen = [within[i] for i in evenly(len(within), max((most + 1) // 2, most - len(beyond)))]
    chosen += [beyond[i] for i in evenly(len(beyond), most - len(chosen))]
    return [Trial(knob="combination", changes=guess.changes) for guess in chosen]


def evenly(total: int, count: int) -> list[int]:
    """`count` of the numbers below `total`, the first and the last among them; all where there are no more."""
    count = min(total, count)
    return [round(i * (total - 1) / max(1, count - 1)) for i in range(count)]


def image_errors(
    images: Sequence[Float[Tensor, "C H W"]], truths: Sequence[Float[Tensor, "C H W"]]
) -> tuple[float, float]:
    """Largest error of a pixel over all pictures, and the largest without the worst share of OUTLIERS."""
    pairs = zip(images, truths, strict=True)
    worst = torch.cat([(image.double() - truth).abs().amax(0).flatten() for image, truth in pairs])
    left_out = int(OUTLIERS * len(worst))
    largest = worst.topk(left_out + 1).values
    return float(largest[0]), float(largest[-1])


def pooled_psnr(images: Sequence[Float[Tensor, "C H W"]], truths: Sequence[Float[Tensor, "C H W"]]) -> float:
    """-10 log10 of the mean squared error over all pictures of one size, dB; inf for equal ones."""
    squares = [float((image.double() - truth).square().mean()) for image, truth in zip(images, truths, strict=True)]
    error = math.fsum(squares) / len(squares)
    return -10 * math.log10(error) if error > 0 else math.inf


def gradient_error(
    gradients: Sequence[Mapping[str, Tensor]],
    truths: Sequence[Mapping[str, Tensor]],
    scales: Sequence[Float[Tensor, "N 3"]],
) -> tuple[float, str]:
    """Norm of the difference over norm of the truth, over all pictures, of the worst field; and that field's name.

    `scales` of the splats turn gradients of scales into those of log-scales, against which orientations count.
    """

    def norm(parts: Iterable[Tensor]) -> float:
        return math.sqrt(math.fsum(float(part.double().square().sum()) for part in parts))

    log_scales = norm(truth["scales"] * s for truth, s in zip(truths, scales, strict=True))
    errors = {}
    for name in truths[0]:
        difference = norm(g[name].double() - t[name] for g, t in zip(gradients, truths, strict=True))
        size = max(norm(t[name] for t in truths), ROUND * log_scales if name == "quats" else 0.0)
        errors[name] = difference / size if size else (math.inf if difference else 0.0)
    worst = max(errors, key=lambda name: errors[name])
    return errors[worst], worst


def ordered(rows: Sequence[Row]) -> list[Row]:
    """Fastest first; those that failed last."""
    return sorted(rows, key=lambda row: (bool(row.failure), row.step_ms if not row.failure else 0.0))
