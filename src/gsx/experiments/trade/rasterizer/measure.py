"""The sweep itself: the float64 truth and its check, errors of every trial, and times taken round-robin."""

import logging
import statistics
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import torch

from gsx.core.errors import InputError
from gsx.core.plugins import Plugins
from gsx.core.rasterizer import RasterSettings
from gsx.engine.compiling import available, complaint
from gsx.engine.threads import relieve_oversubscription
from gsx.experiments.runs.compose import compose
from gsx.experiments.trade.rasterizer.bench import EXACT, Bench, Check, Times, check_truth, reason
from gsx.experiments.trade.rasterizer.knobs import Row, Trial, combinations, ordered, single_changes
from gsx.experiments.trade.rasterizer.subject import Subject

logger = logging.getLogger(__name__)

STEADY = 0.1
"""Times of a machine with nothing else to do vary by less than this fraction."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trade:
    """Everything that was measured."""

    subject: Subject
    base: RasterSettings
    check: Check
    ideal: dict[str, float] | None
    """Of the truth against the ideal picture: `max_error`, `most_error`, `psnr`; None: too many pairs to draw it."""
    repeats: int
    rows: list[Row]
    """Fastest first; those that failed last."""
    notes: list[str]


def usable_paths(plugins: Plugins, device: torch.device) -> tuple[list[RasterSettings], list[str]]:
    """The shipped settings of every path that works here, and a note on one that does not."""
    presets = {name: compose([f"rasterizer={name}"], plugins).raster for name in ("eager", "compiled")}
    if available(device.type):
        return list(presets.values()), []
    return [presets["eager"]], [f"only eager settings are tried: nothing compiles here ({complaint(device.type)})"]


def resolved(base: RasterSettings) -> tuple[RasterSettings, list[str]]:
    """The base settings with path=auto decided, and a note on that: eager, or every single change would be compiled."""
    if base.path != "auto":
        return base, []
    remedy = "begin with rasterizer.path=compiled to turn the other knobs there, each to be compiled once"
    return replace(base, path="eager"), [
        f"rasterizer.path=auto begins eager here, compiled is one of the knobs: {remedy}"
    ]


@relieve_oversubscription()
def sweep(
    subject: Subject,
    presets: Sequence[RasterSettings],
    *,
    knobs: Collection[str],
    repeats: int,
    max_error: float,
    most_combinations: int,
    notes: Sequence[str] = (),
) -> Trade:
    """Measure the base settings, single changes and combinations of the best of them.

    `presets` are the shipped settings of the paths that can run here; `repeats` the rounds of timing.

    Raises:
        InputError: the base settings themselves cannot be drawn.
    """
    base, decided = resolved(subject.raster)
    for note in decided:
        logger.info("%s", note)
    logger.info("drawing the float64 truth")
    bench = Bench(subject, base)
    trials = single_changes(base, presets, cuda=subject.device.type == "cuda", knobs=knobs)
    rows = measured_singles(bench, trials, repeats)
    rows += measured_combinations(bench, rows, combinations(rows, most_combinations, max_error), repeats)
    doubts = unsteady(rows)
    for doubt in doubts:
        logger.warning("%s", doubt)
    return Trade(
        subject=subject,
        base=base,
        check=check_truth(subject.shots[0], replace(base, **EXACT)),
        ideal=bench.ideal_errors(),
        repeats=repeats,
        rows=ordered(rows),
        notes=[*notes, *decided, *doubts],
    )


def measured_singles(bench: Bench, trials: Sequence[Trial], repeats: int) -> list[Row]:
    """Rows of the base settings and of single changes."""
    compiling = any(replace(bench.base, **trial.changes).path == "compiled" for trial in trials)
    wait = "; each new compiled one takes a while" if compiling else ""
    logger.info("measuring the errors of %d settings%s", len(trials), wait)
    rows = [bench.measured(trial) for trial in trials]
    refuse_failed_base(rows[0].failure)
    announce(rows, repeats)
    return timed(bench, rows, repeats)


def measured_combinations(bench: Bench, rows: Sequence[Row], trials: Sequence[Trial], repeats: int) -> list[Row]:
    """Rows of combinations; `rows` begin with that of the base settings, beside which they are timed again."""
    if not trials:
        return []
    more = [bench.measured(trial) for trial in trials]
    announce(more, repeats)
    again, *more = timed(bench, [rows[0], *more], repeats)
    return [at_pace(row, rows[0], again) for row in more]


def unsteady(rows: Sequence[Row]) -> list[str]:
    """A warning if times varied much from round to round."""
    spread = statistics.median(row.step_spread for row in rows if not row.failure)
    if spread <= STEADY:
        return []
    remedy = "leave the machine alone or ask for more rounds with --repeats"
    return [f"times varied by {spread:.0%} from round to round, so smaller gains mean nothing: {remedy}"]


def refuse_failed_base(failure: str) -> None:
    """Raise InputError if there is nothing to compare with."""
    if failure:
        raise InputError(f"the base settings cannot be measured ({failure}): change them with rasterizer.KEY=VALUE")


def announce(rows: Sequence[Row], repeats: int) -> None:
    """Say what is timed now."""
    kind = "combinations of the best" if rows[0].knob == "combination" else "settings"
    logger.info("timing %d %s, %d rounds in turn", sum(not row.failure for row in rows), kind, repeats)


def at_pace(row: Row, base: Row, again: Row) -> Row:
    """The row with times by those of `base`, where the base settings took the times of `again` in the row's rounds."""
    forward_ms = row.forward_ms * base.forward_ms / again.forward_ms
    return replace(row, step_ms=row.ratio * base.step_ms, forward_ms=forward_ms)


def timed(bench: Bench, rows: Sequence[Row], rounds: int) -> list[Row]:
    """Rows with times; the first is that of the base settings.

    Every round takes all rows once, so that whatever else the machine does hits all alike; every other round goes
    backwards: a steady drift then favours nobody.

    Raises:
        InputError: the base settings fail; nothing can be compared with them.
    """
    live = [i for i, row in enumerate(rows) if not row.failure]
    times: dict[int, list[Times]] = {i: [] for i in live}
    failures: dict[int, str] = {}
    for number in range(rounds):
        for i in live if number % 2 == 0 else reversed(live):
            try:
                if i not in failures:
                    times[i].append(bench.times(replace(bench.base, **rows[i].changes)))
            except Exception as error:
                failures[i] = reason(error)
    refuse_failed_base(failures.get(0, ""))

    def finished(i: int, row: Row) -> Row:
        if i not in live:
            return row
        return replace(row, failure=failures[i]) if i in failures else with_times(row, times[i], times[0])

    return [finished(i, row) for i, row in enumerate(rows)]


def with_times(row: Row, times: Sequence[Times], base: Sequence[Times]) -> Row:
    """Median ratios to the base settings within a round, and the base's median times by these ratios.

    The ratios forget what slowed the machine down from round to round, and times in their order agree with them.
    """

    def against_base(taken: Callable[[Times], float]) -> tuple[float, float, float]:
        ratios = [taken(mine) / taken(other) for mine, other in zip(times, base, strict=True)]
        ratio, spread = statistics.median(ratios), (max(ratios) - min(ratios)) / 2
        return ratio, spread / ratio, 1e3 * ratio * statistics.median(map(taken, base))

    ratio, step_spread, step_ms = against_base(lambda t: t.step)
    _, forward_spread, forward_ms = against_base(lambda t: t.forward)
    peaks = [t.peak_mb for t in times if t.peak_mb is not None]
    return replace(
        row,
        ratio=ratio,
        step_ms=step_ms,
        step_spread=step_spread,
        forward_ms=forward_ms,
        forward_spread=forward_spread,
        memory_mb=max(peaks) if peaks else None,
    )
