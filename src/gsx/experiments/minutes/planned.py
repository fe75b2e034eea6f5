"""Settings of a run that ends after `minutes=N`: planned, logged with the command that repeats it, and recorded."""

import logging
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from typing import Any

from gsx.core.errors import ConfigError, command
from gsx.core.options import flattened
from gsx.core.plugins import Plugins
from gsx.engine.processes import processes
from gsx.experiments.minutes.cost import PlanOptions, plan_options
from gsx.experiments.minutes.plan import (
    SIZE,
    WIDTH,
    Plan,
    Task,
    capacity_of,
    changes_of,
    chooses_size,
    plan_run,
    schedule_of,
)
from gsx.experiments.minutes.probe import LENGTH, measure
from gsx.experiments.run_folder.general_options import splat_file
from gsx.experiments.runs.build import choose_device
from gsx.experiments.runs.early_compiling import compiling_before
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import refuse_early
from gsx.experiments.runs.settings import Settings, overridden

logger = logging.getLogger(__name__)

MANY = 10**6
"""Primitives of a budget that is not planned yet: its code is compiled and measured."""
TIMES = ("minutes", "seconds")
LENGTHS = ("iterations", "length", "budget", "budget.share", "scene.iterations")
"""Keys that choose the number of steps."""
OWN_LENGTH = ("variant", "dataset", "protocol", "preset", "augmenter", "init", "reuse")
"""Keys of runs without a default time: published settings, what is not measured, and names by settings."""
PUBLISHED = "length=published"
"""Word for the steps of the published run."""


def keys_of(words: Iterable[str]) -> frozenset[str]:
    """Returns the keys that words of the command line set."""
    return frozenset(word.partition("=")[0].lstrip("+~") for word in words)


def with_default_time(words: Sequence[str]) -> list[str]:
    """Returns words that train on photos, with the default minutes on a CPU unless they choose a length."""
    chosen = keys_of(words) & {*TIMES, *LENGTHS, *OWN_LENGTH}
    if chosen or processes() > 1 or not on_cpu(words):
        return list(words)
    return [*words, f"minutes={plan_options().default:g}"]


def untimed_because(words: Sequence[str]) -> str:
    """Returns the words that keep the default minutes from photos on a CPU; empty: none do, or they choose a length."""
    if keys_of(words) & {*TIMES, *LENGTHS} or not on_cpu(words):
        return ""
    several = [word for word in words if word in ("-m", "--multirun")]
    torchrun = ["torchrun"] if processes() > 1 else []
    return " ".join([*several, *(word for word in words if keys_of([word]) & {*OWN_LENGTH}), *torchrun])


def log_untimed(because: str, length: str) -> None:
    """Logs why a run has no default minutes, and its length instead; `because`: empty if it has, or chooses one."""
    if because:
        logger.info("no minutes=%g because of %s: %s", plan_options().default, because, length)


def without_length(words: Sequence[str]) -> list[str]:
    """Returns words without PUBLISHED: nothing else is the length of the published run."""
    return [word for word in words if word.replace("'", "") != PUBLISHED]


def on_cpu(words: Iterable[str]) -> bool:
    """Returns whether words of the command line train on a CPU."""
    chosen = [word.partition("=")[2] for word in words if word.startswith("device=")]
    return choose_device(chosen[-1] if chosen else "auto").type == "cpu"


def planned(settings: Settings, words: Sequence[str], loaded: Plugins, started: float | None = None) -> Settings:
    """Returns settings with a plan that ends after their `minutes` or `seconds`; the same settings if both are 0.

    Args:
        settings: Composed settings.
        words: Words of the command line that they are composed of; the plan keeps the values that these set.
        loaded: Plugins.
        started: Time of `time.monotonic` at which the wall time began; None: now.

    Raises:
        ConfigError: other words choose a length as well, or the time is not enough.
        InputError: the scene cannot be loaded.
    """
    limit = 60 * settings.general.minutes or settings.general.seconds
    if not limit:
        return settings
    started, fixed, options = time.monotonic() if started is None else started, keys_of(words), plan_options()
    refuse(settings, fixed)
    if limit - (used := time.monotonic() - started) <= options.report:
        unit, name = (60, "minutes") if settings.general.minutes else (1, "seconds")
        least = 60 // unit * math.ceil((used + options.report) / 60)
        raise ConfigError(
            f"{name}={limit / unit:g} leaves nothing after start-up ({used:.0f} s here) and report: give at least "
            f"{name}={least}"
        )
    refuse_early(settings)
    changes = schedule_of(settings, fixed, options) | capacity_of(flattened(settings.resolved), fixed, MANY)
    with compiling_before(overridden(settings, changes | {"iterations": LENGTH}, loaded)):
        task = task_of(settings, fixed, changes, limit - (time.monotonic() - started), options, loaded)
    plan = plan_run(task)
    changes = {"minutes": 0.0, "seconds": 0.0, **changes_of(task, plan)}
    again = [word for word in words if word.partition("=")[0] not in (*TIMES, "folder")]
    for key, value in changes.items():
        if key not in TIMES and not key.startswith("training.deadline."):  # which the repeated run does not need
            again.append(f"{key}={value:g}" if isinstance(value, float) else f"{key}={value}")
    announce(task, plan, limit, time.monotonic() - started, again)
    facts = facts_of(task, plan, limit, time.monotonic() - started)
    return replace(overridden(settings, changes, loaded), repeat=tuple(again), time_plan=facts)


def facts_of(task: Task, plan: Plan, limit: float, used: float) -> dict[str, Any]:
    """Returns what environment.json says of a plan; `used`: seconds before it."""
    return {
        "limit_s": limit,
        "before_s": round(used, 1),
        "training_s": round(plan.planned[-1], 1),
        "other_s": round(plan.other, 1),
        "steps": plan.steps,
        "downscale": plan.downscale,
        "measurement": asdict(task.measurement),
    }


def refuse_resumed(words: Iterable[str]) -> None:
    """Raises ConfigError for a wall time of a run that exists: it was planned, or not, when it began."""
    if both := sorted(keys_of(words) & set(TIMES)):
        raise ConfigError(f"gsx resume: {both[0]} plans new runs only; give iterations=N to train longer")


def refuse(settings: Settings, fixed: frozenset[str]) -> None:
    """Raises ConfigError for words that minutes=N cannot be combined with."""
    name = "minutes" if settings.general.minutes else "seconds"
    if both := sorted(fixed & set(LENGTHS)):
        raise ConfigError(f"{name}=N chooses the number of steps, and {both[0]} does, too: leave one of them out")
    if settings.general.reuse:
        raise ConfigError(
            f"{name}=N plans by the speed of this machine, and reuse=true names the folder by the settings: leave one "
            "of them out, or run the command that the plan logs with reuse=true"
        )
    if splat_file(settings.general.init):
        raise ConfigError(f"{name}=N plans models that begin with the scene: give iterations=N with init=FILE")
    if processes() > 1:
        raise ConfigError(f"{name}=N plans for one process: call gsx without torchrun, or give iterations=N")


def task_of(
    settings: Settings,
    fixed: frozenset[str],
    changes: dict[str, Any],
    seconds: float,
    options: PlanOptions,
    loaded: Plugins,
) -> Task:
    """Measures this machine on the scene and returns what is to be planned.

    Args:
        settings: Settings of the run to plan.
        fixed: Keys whose values the plan keeps.
        changes: Values by dotted key that every plan has.
        seconds: Wall time until the report.
        options: Constants of planning.
        loaded: Plugins.
    """
    start = time.monotonic()
    downscale = probe_downscale(settings, fixed, options, loaded)
    logger.info("measuring a few steps to plan %s ...", in_words(seconds))
    sized = changes if downscale is None else changes | {SIZE: downscale}
    measurement, scene = measure(settings, sized, options.probe, loaded)
    return Task(
        settings=settings,
        fixed=fixed,
        views=len(scene.train),
        tests=len(scene.test),
        seconds=seconds - (time.monotonic() - start),
        published=settings.resolved["backbone"].get("published_iterations", LENGTH),
        measurement=measurement,
        options=options,
    )


def probe_downscale(settings: Settings, fixed: frozenset[str], options: PlanOptions, loaded: Plugins) -> int | None:
    """Returns the reduction of photos to measure at, which are small pictures; None: as the settings have it."""
    if not chooses_size(settings, fixed):
        return None
    camera = load_scene(overridden(settings, {SIZE: 1, WIDTH: 0}, loaded)).train[0].camera
    factor = math.sqrt(camera.width * camera.height / options.probe.pixels)
    return 1 << max(0, math.ceil(math.log2(factor)))


def announce(task: Task, plan: Plan, limit: float, used: float, again: Sequence[str]) -> None:
    """Logs the plan, what to choose instead, and the command for the same bits."""
    size = f" at 1/{plan.downscale} size" if plan.downscale > 1 else ""
    grown = f", up to {plan.primitives:,} primitives" if capacity_of(task.values, task.fixed, 1) else ""
    logger.info(
        "about %s: %s steps%s%s; minutes=%g for more, %s for %s steps",
        *(in_words(used + plan.seconds), f"{plan.steps:,}", size, grown),
        *(math.ceil(3 * limit / 60), PUBLISHED, f"{task.settings.general.iterations:,}"),
    )
    logger.info("the same training without a clock: %s", command(*again))


def in_words(seconds: float) -> str:
    """Formats seconds as minutes, short times as seconds."""
    return f"{seconds:.0f} seconds" if seconds < 100 else f"{seconds / 60:.1f} minutes"
