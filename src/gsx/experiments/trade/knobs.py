"""What each knob of the rasterizer costs and gives: the sweep's choices, errors, front, recommendation and table.

Nothing here looks at a clock; `trade_measure.py` does.
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


# -- what to try ---------------------------------------------------------------------------------------------------


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


# -- errors --------------------------------------------------------------------------------------------------------


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


# -- what to make of it --------------------------------------------------------------------------------------------


def ordered(rows: Sequence[Row]) -> list[Row]:
    """Fastest first; those that failed last."""
    return sorted(rows, key=lambda row: (bool(row.failure), row.step_ms if not row.failure else 0.0))


def shown(error: float) -> float:
    """An error as the tables show it: the digits beyond are chance."""
    return float(f"{error:.1e}")


def front_of(rows: Sequence[Row], cost: str = "step_ms", error: str = "max_error") -> list[int]:
    """Indices, fastest first, of rows that no other beats: no slower, no less exact (as shown), and better in one."""
    known = [i for i, row in enumerate(rows) if not row.failure]
    costs = [getattr(rows[i], cost) for i in known]
    return [known[i] for i in pareto_front(costs, [-shown(getattr(rows[i], error)) for i in known])]


def recommended(rows: Sequence[Row], budget: float, cost: str = "step_ms", error: str = "max_error") -> Row | None:
    """The fastest row within the budget; None: there is none.

    Of rows as fast as it, but for noise and for what its own time varied from round to round, the one that changes
    least.
    """
    within = [row for row in rows if not row.failure and getattr(row, error) <= budget]
    if not within:
        return None
    fastest = min(within, key=lambda row: getattr(row, cost))
    slowest = getattr(fastest, cost) * (1 + max(NOISE, getattr(fastest, SPREADS[cost])))
    return min(
        (row for row in within if getattr(row, cost) <= slowest), key=lambda row: (len(row.changes), getattr(row, cost))
    )


def most_exact(rows: Sequence[Row]) -> Row:
    """The row of the smallest error as shown; among equals the one that changes least, then the fastest."""
    known = (row for row in rows if not row.failure)
    return min(known, key=lambda row: (shown(row.max_error), len(row.changes), row.step_ms))


def advice(rows: Sequence[Row], budget: float) -> list[dict[str, Any]]:
    """For training and for rendering: the row to use, once for every pixel, once for all but a few."""
    base = next(row for row in rows if row.knob == "base")
    return [
        {
            "purpose": purpose,
            "cost": cost,
            "error": error,
            "row": row,
            "gain": getattr(base, cost) / getattr(row, cost) if row else math.nan,
        }
        for purpose, cost in (("training", "step_ms"), ("rendering", "forward_ms"))
        for error in ("max_error", "most_error")
        for row in [recommended(rows, budget, cost, error)]
    ]


def advice_lines(rows: Sequence[Row], budget: float) -> list[str]:
    """The recommendation in words."""
    told = advice(rows, budget)
    every, most = ([entry for entry in told if entry["error"] == error] for error in ("max_error", "most_error"))
    lines = advised(every, f"every pixel within {budget:g}")
    if any(entry["row"] is None for entry in every):
        exact = most_exact(rows)
        lines = [
            f"no settings keep every pixel within {budget:g}: the most exact are {exact.settings} "
            f"(max error {exact.max_error:.2g}); allow more with --max-error {rounded_up(exact.max_error)}"
        ]
        if all(entry["row"] is not None for entry in most):
            lines += advised(most, f"all but {OUTLIERS:.2%} of the pixels within {budget:g}")
    return lines


def advised(entries: Sequence[dict[str, Any]], promise: str) -> list[str]:
    """One line for each purpose, or one for both where they agree."""
    rows = [entry["row"] for entry in entries]
    if any(row is None for row in rows):
        return []
    if all(row is rows[0] for row in rows):
        entries = [entries[0] | {"purpose": "training and rendering"}]
    return [
        f"{entry['purpose']}, {promise}: {overrides(entry['row'].changes) or 'keep the settings as they are'}"
        + (f" ({entry['gain']:.2f} x as fast)" if entry["row"].changes else "")
        for entry in entries
    ]


def rounded_up(value: float) -> str:
    """A round number that is no smaller, two digits."""
    power = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return f"{math.ceil(value / power * (1 - 1e-12)) * power:.2g}"


NONE = "n/a"
HEADINGS = (
    "", "#", "f+b ms", "x base", "+-", "fwd ms", "max error", "99.99 %", "PSNR", "gradient", "ideal", "pairs", "MB",
)  # fmt: skip
"""Of the table in the terminal; the settings follow."""


def table(rows: Sequence[Row]) -> list[str]:
    """The rows, already in order, as aligned lines; a star marks the Pareto front of time and max error."""
    front = set(front_of(rows))
    known = [(i, row) for i, row in enumerate(rows) if not row.failure]
    cells = [list(HEADINGS)] + [row_cells(row, i, i in front) for i, row in known]
    columns = [column for column in zip(*cells, strict=True) if any(cell != NONE for cell in column[1:])]
    widths = [max(map(len, column)) for column in columns]
    figures = ["  ".join(map(str.rjust, line, widths)) for line in zip(*columns, strict=True)]
    told = ["settings"] + [row.settings for _, row in known]
    aligned = [f"{line}  {words}" for line, words in zip(figures, told, strict=True)]
    return aligned + [f"failed: {row.settings}: {row.failure}" for row in rows if row.failure]


def row_cells(row: Row, index: int, on_front: bool) -> list[str]:
    """The figures of a row as text."""
    return [
        "*" if on_front else "",
        str(index + 1),
        f"{row.step_ms:.1f}",
        f"{row.ratio:.2f}",
        f"{row.step_spread:.0%}",
        f"{row.forward_ms:.1f}",
        f"{row.max_error:.1e}",
        f"{row.most_error:.1e}",
        f"{row.psnr:.1f}",
        f"{row.gradient_error:.1e}",
        NONE if math.isnan(row.ideal_psnr) else f"{row.ideal_psnr:.1f}",
        f"{row.pairs:,.0f}",
        NONE if row.memory_mb is None else f"{row.memory_mb:,.0f}",
    ]
