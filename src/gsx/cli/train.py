"""gsx OVERRIDES, multiruns, tables, and gsx resume."""

import logging
import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from gsx.builtin import plugins
from gsx.cli.arguments import split_flags
from gsx.cli.exit_codes import report_error
from gsx.core.errors import ConfigError, GsxError, InputError, command
from gsx.core.files import expand_home, read_json, write_json
from gsx.core.plugins import Plugins
from gsx.engine.cache import in_use
from gsx.engine.processes import say, speaks
from gsx.engine.signals import INTERRUPTED
from gsx.experiments.minutes.clock import process_start
from gsx.experiments.minutes.planned import (
    log_untimed,
    planned,
    refuse_resumed,
    untimed_because,
    with_default_time,
    without_length,
)
from gsx.experiments.reports.overview import write_overview
from gsx.experiments.run_folder.claims import claimed
from gsx.experiments.run_folder.files import read_run, reported, state_of
from gsx.experiments.runs import job
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.history import record_changes
from gsx.experiments.runs.inspect import scene_loaders
from gsx.experiments.runs.launched import ended_from_without, is_launched, waiting_for_all
from gsx.experiments.runs.logs import set_up_logging
from gsx.experiments.runs.multirun import check_overrides, job_overrides, job_place, launch, print_instead
from gsx.experiments.runs.open import open_run, refuse_other, stamped_folder
from gsx.experiments.runs.overrides import quoted, with_quoted_paths, word_of
from gsx.experiments.runs.saved_settings import write_config
from gsx.experiments.runs.settings import settings_from
from gsx.experiments.runs.video import is_video, photos_of
from gsx.experiments.tables.sweep import is_table, run_table, with_plus

logger = logging.getLogger("gsx.cli")

MULTIRUN = {"-m", "--multirun"}
"""Flags that train several runs."""


def train(words: list[str], of_folder: bool = False) -> int:
    """Train one run, several (`-m`) or a table, or let Hydra print something, by the words of the command line.

    of_folder: the command names a folder or a video, whose run on a CPU has a default length, as that of photos.
    """
    because = untimed_because(words) if of_folder or of_photos(words) else ""
    several = bool(MULTIRUN & set(words))
    words = with_plus(without_length(with_default_time(words) if of_photos(words) and not several else words))
    if several:
        return train_several(words, because)
    if any(word.startswith("-") for word in words):
        return print_by_hydra(words)
    if is_table(words):
        return fill_table(words)
    folders: list[Path] = []
    with in_use():
        settings = planned(compose(words, loaded := plugins()), words, loaded, process_start())
        log_untimed(because, f"{settings.general.iterations:,} steps")
        code = job.train(settings, loaded, folders)
    if settings.time_plan and code == 0:
        seconds, limit = time.monotonic() - process_start(), settings.time_plan["limit_s"]
        logger.info("took %.1f of %.1f minutes (%+.0f %%)", seconds / 60, limit / 60, 100 * (seconds / limit - 1))
    return print_report(code, folders[0])


def of_photos(words: Sequence[str]) -> bool:
    """Return True for words that train on photos, one run or several."""
    flags = {word for word in words if word.startswith("-")}
    return "scene=photos" in words and flags <= MULTIRUN and not is_table(words)


def print_report(code: int, *folders: Path) -> int:
    """Print the reports of finished runs; return the exit code."""
    for folder in folders if code == 0 else ():
        say(f"{folder / 'report.html'}\n")
    return code


def fill_table(words: list[str]) -> int:
    """Run what is missing of a table (`+experiment=TABLE`) and print it."""
    try:
        text, code = run_table(words, plugins(), sweep_job)
    except KeyboardInterrupt:
        say("\ngsx: interrupted; repeat the command to run what is missing\n", as_error=True)
        return INTERRUPTED
    sys.stdout.write(text)
    return code


def print_by_hydra(words: list[str]) -> int:
    """Print the configuration, completion or Hydra's help by Hydra's command line."""
    try:
        with redirect_stdout(StringIO()) as text:  # Hydra shows a traceback where it cannot write
            print_instead(*split_flags(words), plugins(), sweep_job)
    finally:  # it may end the program
        sys.stdout.write(text.getvalue())
    return 0


def train_several(words: list[str], because: str) -> int:
    """Train one run per combination by Hydra's launcher; print one report over all. Return the worst exit code.

    because: reason for which photos train without the default minutes; empty: there are no photos.
    """
    refuse_for_sweeps(words)
    log_untimed(because, "each run trains all its steps")
    overrides, loaded = with_quoted_paths([word for word in words if not word.startswith("-")]), plugins()
    output, of_launcher = check_overrides(overrides, loaded)
    sweep, code = stamped_folder(output / "sweeps"), 0
    try:
        with waiting_for_all(sweep):
            launch(["-m", *overrides, *of_launcher, f"hydra.sweep.dir={quoted(str(sweep))}"], loaded, sweep_job)
    except KeyboardInterrupt:
        say("\ngsx: interrupted; the lines above show how to continue each run\n", as_error=True)
        code = INTERRUPTED
    finally:
        code = max(code, close_sweep(sweep))
    return code


def refuse_for_sweeps(words: list[str]) -> None:
    """Raise ConfigError for a table, flags that do not train, and a place for the multirun's record."""
    if is_table(words):
        raise ConfigError("a table already trains several runs: leave out -m; launchers work without it")
    for word in words:
        if word.startswith("-") and word not in MULTIRUN:
            raise ConfigError(f"-m trains several runs, {word} trains none: leave one of them out")
        if word.lstrip("+").startswith("hydra.sweep.dir="):
            raise ConfigError(f"'{word}': a multirun's record goes below output/sweeps; give output=FOLDER")


def close_sweep(sweep: Path) -> int:
    """Print the report over the runs of a multirun; return the worst exit code of its jobs."""
    records = [read_json(path) for path in sorted((sweep / "jobs").glob("*.json"))]
    folders = [folder for record in records if record["folder"] and (folder := Path(record["folder"])).is_dir()]
    if folders:
        sys.stdout.write(f"{write_overview(sweep, folders)}\n")
    return max((record["code"] for record in records), default=0)


def sweep_job(config: Any) -> int:
    """Run one job of a multirun or a table, here or in a launcher's process; write its record below the sweep.

    An error is printed and the other jobs continue. Ctrl-C ends them; launcher processes record it first.
    """
    set_up_logging()
    folders: list[Path] = []
    place = job_place()
    try:
        with ended_from_without(place[0]) if place else nullcontext():
            settings = planned(settings_from(config, loaded := plugins()), job_overrides(), loaded)
            code = job.train(settings, loaded, folders)
    except KeyboardInterrupt:
        if not is_launched():
            raise
        code = INTERRUPTED
    except (GsxError, OSError) as error:
        code = report_error(error)
    except Exception:  # a defect, perhaps of a plugin, must not end the other jobs
        logger.exception("this job failed")
        code = 1
    if place is not None:
        (place[0] / "jobs").mkdir(parents=True, exist_ok=True)
        record = {"folder": str(folders[0].resolve()) if folders else "", "code": code}
        write_json(place[0] / "jobs" / f"{place[1]:05d}.json", record)
    if code == INTERRUPTED and not is_launched():
        raise KeyboardInterrupt
    return print_report(code, *folders)


def resume(options: Namespace) -> int:
    """Continue a run and print its report; raise InputError if it is complete or past its iterations."""
    folder, loaded = options.run, plugins()
    refuse_other(folder)
    refuse_resumed(options.overrides)
    with in_use(), claimed(folder) if speaks() else nullcontext():
        run, settings = open_run(folder, loaded, options.overrides, training=True, trusted=options.trust)
        if run.step > run.iterations:
            less = f"iterations={run.iterations} is less: give iterations=N with N above {run.step}"
            raise InputError(f"{folder} is at step {run.step}, {less}")
        if run.complete and reported(folder) and state_of(read_run(folder))[0] == "ok":
            raise InputError(f"{folder} is complete at step {run.step}: give iterations=N with a larger N to train on")
        if run.ranks.first:
            record_changes(run, settings, loaded, changed=options.changed)
            write_config(folder / "config.yaml", settings.resolved)
        logger.info("resuming %s at step %d", folder, run.step)
        return print_report(job.carry_out(run, settings, loaded), folder)


def train_folder(arguments: list[str]) -> int:
    """Train from a folder or a video (first word) with the overrides after it."""
    path, overrides = expand_home(arguments[0]), arguments[1:]
    words = scene_words(path, overrides, plugins())
    scene = words[0].partition("=")[2]
    kind = "a video" if path.is_file() and scene == "photos" else f"read as scene={scene}"
    logger.info("%s is %s", path, kind)
    words = [*words, *overrides]
    words = words if MULTIRUN & set(words) else with_default_time(words)
    logger.info("%s", command(*words))
    return train(words, of_folder=True)


def scene_words(path: Path, overrides: Sequence[str], loaded: Plugins) -> list[str]:
    """Return the overrides that choose the scene of a folder or a video.

    Raises:
        InputError: it is neither; for a splat file the message lists the commands that take it.
    """
    if is_video(path):
        output = next((word.partition("=")[2] for word in overrides if word.startswith("output=")), "outputs")
        return ["scene=photos", word_of("scene.path", str(photos_of(path, Path(output))))]
    loader, its = scene_loaders(path, loaded)[0]
    more = [word_of(f"scene.{key}", value) for key, value in its.overrides(path).items()]
    return [f"scene={loader.name}", word_of("scene.path", str(path)), *more]
