"""Settings trained on a scene, several seeds each: what comes out and what it costs."""

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from gsx.core.errors import ConfigError, InputError, TrainingError, first_line
from gsx.core.files import read_json
from gsx.core.plugins import Plugins
from gsx.experiments.evaluation.remarks import NOT_MEASURED, measures_nothing
from gsx.experiments.reports.page import duration
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.overrides import quoted
from gsx.experiments.trade.training.settings import GIVEN, Setting, together

logger = logging.getLogger(__name__)

ZOOMS = "[1,2,4]"
"""Zooms that are looked at unless the composition says otherwise."""
RUNS = "runs"
"""Folder of the runs, beside the page."""
COSTS = {"seconds": "training s", "megabytes": "MB"}
"""What is paid, and its unit: MB of the standard splat file, 10^6 bytes."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One run."""

    folder: str
    """Beside the page."""
    psnr: dict[str, float]
    """On held-out views, dB, by zoom."""
    primitives: int
    megabytes: float
    seconds: float
    """Of training."""
    evaluate_seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Row:
    """A setting and its runs, one for each seed."""

    setting: Setting
    overrides: Sequence[str]
    """What it adds to the composition as given."""
    outcomes: Sequence[Outcome] = ()
    failure: str = ""
    """Why there are none."""

    def quality(self, zoom: str) -> float:
        """Mean PSNR over the seeds, dB."""
        return mean(outcome.psnr[zoom] for outcome in self.outcomes)

    def cost(self, name: str) -> float:
        """Mean over the seeds."""
        return mean(getattr(outcome, name) for outcome in self.outcomes)

    def worst_cost(self, name: str) -> float:
        """Of the seeds."""
        return max(getattr(outcome, name) for outcome in self.outcomes)

    def zooms(self) -> list[str]:
        """At which there are figures of all seeds."""
        return [zoom for zoom in self.outcomes[0].psnr if all(zoom in other.psnr for other in self.outcomes)]

    def drop(self, given: "Row") -> float:
        """The most that a seed loses at any zoom beside the composition as given, dB; negative where all gain."""
        pairs = zip(self.outcomes, given.outcomes, strict=True)
        both = [(after.psnr, before.psnr) for after, before in pairs]
        losses = [before[zoom] - after[zoom] for after, before in both for zoom in before.keys() & after.keys()]
        return max(losses, default=0.0)


def refuse_unmeasured(evaluation: Mapping[str, Any]) -> None:
    """Raise InputError for a run without test views, which nothing can be compared by."""
    if measures_nothing(evaluation):
        raise InputError(f"{NOT_MEASURED}: gsx trade compares held-out figures, choose another scene.split")


def outcome_of(folder: Path, beside: Path) -> Outcome:
    """Of a finished run; beside: the page's folder."""
    found = read_json(folder / "evaluation.json")
    refuse_unmeasured(found)
    zooms = {zoom: entry["psnr"] for zoom, entry in found["zoom"].items() if entry.get("psnr") is not None}
    return Outcome(
        folder=Path(os.path.relpath(folder, beside)).as_posix(),
        psnr=zooms or {"1": found["psnr"]},
        primitives=found["primitives"],
        megabytes=found["megabytes"],
        seconds=found["train_seconds"],
        evaluate_seconds=found["evaluate_seconds"],
    )


Job = Callable[[Any], Path]
"""Trains what was composed, in the folder that its composition names; returns that."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """What settings are tried on."""

    given: Sequence[str]
    """The composition as given."""
    seeds: Sequence[int]
    folder: Path
    """Of the page; runs go below it."""
    job: Job
    plugins: Plugins

    def words(self, row: Sequence[str], seed: int) -> list[str]:
        """All of a run."""
        named = any(word.lstrip("+").startswith("eval.zoom=") for word in self.given)
        zooms = [] if named else [f"eval.zoom={ZOOMS}"]
        return [*zooms, *self.given, *row, f"seed={seed}", f"output={quoted(str(self.folder / RUNS))}", "reuse=true"]

    def composed(self, row: Sequence[str], seed: int) -> Any:
        """Its settings, checked."""
        return compose(self.words(row, seed), self.plugins)

    def tried(self, setting: Setting, iterations: int) -> Row:
        """A setting, trained with each seed unless that has been done; what cannot be composed or trained says why."""
        overrides = setting.overrides(iterations)
        try:
            runs = [self.composed(overrides, seed) for seed in self.seeds]
            outcomes = [outcome_of(self.job(run), self.folder) for run in runs]
        except (ConfigError, TrainingError) as error:
            if setting == GIVEN:
                raise
            logger.info("%s: not to be had (%s)", setting.name, first_line(error))
            return Row(setting=setting, overrides=overrides, failure=first_line(error))
        row = Row(setting=setting, overrides=overrides, outcomes=outcomes)
        zoom = row.zooms()[0]
        told = f"{row.quality(zoom):.2f} dB at x{zoom}, {row.cost('megabytes'):.3g} MB, {row.cost('seconds'):.3g} s"
        logger.info("%s: %s", setting.name, told)
        return row


def measured(trial: Trial, listed: Sequence[Setting], most_together: int) -> list[Row]:
    """The composition as given, each setting alone, and what is best in several trades together."""
    settings = trial.composed([], trial.seeds[0])
    if getattr(settings.scene.options, "split", "") == "none":  # before anything is trained
        refuse_unmeasured({"views": []})
    iterations = settings.general.iterations
    given = trial.tried(GIVEN, iterations)
    logger.info("%d settings, %d seed(s): about %s", len(listed), len(trial.seeds), duration(expected(given, listed)))
    rows = [given, *(trial.tried(setting, iterations) for setting in listed)]
    rows = different(rows)
    return different(rows + [trial.tried(one, iterations) for one in combinations(rows, most_together)])


def expected(given: Row, listed: Sequence[Setting]) -> float:
    """Seconds that settings will take, to train and to evaluate, if they are as fast as what was given."""
    steps, seeds = sum(setting.steps for setting in listed), len(given.outcomes)
    return seeds * (steps * given.cost("seconds") + len(listed) * given.cost("evaluate_seconds"))


def known(rows: Sequence[Row]) -> list[Row]:
    """Those that were trained; the composition as given comes first."""
    return [row for row in rows if row.outcomes]


def different(rows: Sequence[Row]) -> list[Row]:
    """Without settings that are the composition as given, or another one: they would be named twice."""
    seen, kept = set[str](), list[Row]()
    for row in rows:
        folder = row.outcomes[0].folder if row.outcomes else ""
        if not folder or folder not in seen:
            kept.append(row)
        seen.add(folder)
    return kept


CHEAP_DROP = 0.1
"""dB that a setting may lose to count as cheaper and as good."""


def combinations(rows: Sequence[Row], most: int) -> Iterator[Setting]:
    """What is tried together, `most` at most: of several trades what brings the most at the finest zoom, two, three and
    so on; and what takes less time without losing."""
    given, *others = known(rows)
    zoom = given.zooms()[-1]
    better = [row for row in others if row.quality(zoom) > given.quality(zoom)]
    best = one_of_each(better, lambda row: -row.quality(zoom))
    cheap = [row for row in others if row.cost("seconds") < given.cost("seconds") and row.drop(given) <= CHEAP_DROP]
    fast = one_of_each(cheap, lambda row: row.cost("seconds"))
    counted = [best[:count] for count in range(2, min(most + 1, len(best)) + 1)] + ([fast] if len(fast) > 1 else [])
    joined = [together([row.setting for row in chosen]) for chosen in counted]
    yield from list({one.name: one for one in joined}.values())[:most]


def one_of_each(rows: Sequence[Row], key: Callable[[Row], float]) -> list[Row]:
    """The row of least key of each trade, by rising key."""
    found = dict[str, Row]()
    for row in sorted(rows, key=key):
        found.setdefault(row.setting.trades[0], row)
    return list(found.values())
