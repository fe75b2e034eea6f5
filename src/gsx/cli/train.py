"""gsx OVERRIDES, multiruns, tables, and gsx resume."""

import logging
import sys
from contextlib import nullcontext, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from gsx.builtin import plugins
from gsx.cli.arguments import RESUME_FLAGS, run_arguments
from gsx.cli.exit_codes import explained
from gsx.core.errors import ConfigError, GsxError, InputError, nearest
from gsx.engine.collector import loading
from gsx.engine.processes import say, speaks
from gsx.experiments.runs.job import INTERRUPTED, carry_out, train
from gsx.experiments.runs.logs import set_up_logging

logger = logging.getLogger("gsx.cli")

HYDRA_FLAGS = (
    *("-m", "--multirun", "-sc", "--shell-completion", "--info", "--hydra-help"),
    *("--cfg", "-c", "-p", "--package", "--resolve"),
)
"""Flags that are handed to Hydra as they are."""


def verb_train(arguments: list[str]) -> int:
    """gsx OVERRIDES..."""
    set_up_logging()
    flags = [word for word in arguments if word.startswith("-")]
    for flag in flags:
        if flag.split("=")[0] not in HYDRA_FLAGS:
            raise ConfigError(f"'{flag}' is no option of gsx.{nearest(flag, HYDRA_FLAGS)} See gsx --help")
    if flags:
        return hand_to_hydra(arguments)
    with loading():
        from gsx.experiments.runs.compose import compose
        from gsx.experiments.tables.sweep import is_table

    if is_table(arguments):
        return fill_table(arguments)
    folders: list[Path] = []
    code = train(compose(arguments, loaded := plugins()), loaded, folders)
    return print_report(code, folders[0])


def print_report(code: int, *folders: Path) -> int:
    """Prints the report of a run that has come to its end; returns the exit code."""
    for folder in folders if code == 0 else ():
        say(f"{folder / 'report.html'}\n")
    return code


def fill_table(arguments: list[str]) -> int:
    """gsx +experiment=TABLE ..."""
    from gsx.experiments.tables.sweep import run_table

    try:
        text, code = run_table(arguments, plugins(), sweep_job)
    except KeyboardInterrupt:
        say("\ngsx: interrupted; the same command goes on with what is missing\n", as_error=True)
        return INTERRUPTED
    sys.stdout.write(text)
    return code


def hand_to_hydra(arguments: list[str]) -> int:
    """Runs multiruns, completion and information flags by Hydra's command line; a multirun ends with one report."""
    with loading():
        from gsx.experiments.runs.launched import waiting_for_all
        from gsx.experiments.runs.multirun import check_overrides, hydra_main, launch
        from gsx.experiments.runs.open import stamped_folder
        from gsx.experiments.runs.overrides import quoted, with_quoted_paths
        from gsx.experiments.tables.sweep import is_table

    if is_table(arguments) and {"-m", "--multirun"} & set(arguments):
        raise ConfigError("a table is many runs already: leave out -m, launchers work without it")
    loaded = plugins()
    if not {"-m", "--multirun"} & set(arguments):
        arguments = with_quoted_paths(arguments)
        try:
            with redirect_stdout(StringIO()) as text:  # Hydra shows a traceback where it cannot write
                hydra_main(arguments, loaded, sweep_job)
        finally:  # it may end the program
            sys.stdout.write(text.getvalue())
        return 0
    overrides = with_quoted_paths([word for word in arguments if not word.startswith("-")])
    refuse_for_sweeps(arguments)
    output, of_launcher = check_overrides(overrides, loaded)
    sweep, code = stamped_folder(output / "sweeps"), 0
    try:
        with waiting_for_all(sweep):
            launch(["-m", *overrides, *of_launcher, f"hydra.sweep.dir={quoted(str(sweep))}"], loaded, sweep_job)
    except KeyboardInterrupt:
        say("\ngsx: interrupted; runs that were begun say above how to go on\n", as_error=True)
        code = INTERRUPTED
    finally:
        code = max(code, close_sweep(sweep))
    return code


def refuse_for_sweeps(arguments: list[str]) -> None:
    """Raises ConfigError for flags that train nothing, and for the place of a multirun's record."""
    for word in arguments:
        if word.startswith("-") and word not in ("-m", "--multirun"):
            raise ConfigError(f"-m trains several runs, and {word} trains none: leave one of them out")
        if word.lstrip("+").startswith("hydra.sweep.dir="):
            raise ConfigError(f"'{word}': a multirun's record goes below output/sweeps; give output=FOLDER")


def close_sweep(sweep: Path) -> int:
    """Reports on the runs that a multirun has made; returns the worst exit code of its jobs."""
    from gsx.core.files import read_json
    from gsx.experiments.reports.overview import write_overview

    records = [read_json(path) for path in sorted((sweep / "jobs").glob("*.json"))]
    folders = [folder for record in records if record["folder"] and (folder := Path(record["folder"])).is_dir()]
    if folders:
        sys.stdout.write(f"{write_overview(sweep, folders)}\n")
    return max((record["code"] for record in records), default=0)


def sweep_job(config: Any) -> int:
    """Runs one job of a multirun or a table, here or in a launcher's process; its record stays with the sweep.

    An error is shown and does not end the other jobs; Ctrl-C does, where a launcher's processes are in the end of all.
    """
    from gsx.core.files import write_json
    from gsx.experiments.runs.launched import ended_from_without, is_launched
    from gsx.experiments.runs.multirun import job_place
    from gsx.experiments.runs.settings import settings_from

    set_up_logging()
    folders: list[Path] = []
    place = job_place()
    try:
        with ended_from_without(place[0]) if place else nullcontext():
            code = train(settings_from(config, loaded := plugins()), loaded, folders)
    except KeyboardInterrupt:
        if not is_launched():
            raise
        code = INTERRUPTED
    except (GsxError, OSError) as error:
        code = explained(error)
    except Exception:  # a defect, perhaps a plugin's: the other jobs are worth no less
        logger.exception("this job failed")
        code = 1
    if place is not None:
        (place[0] / "jobs").mkdir(parents=True, exist_ok=True)
        record = {"folder": str(folders[0].resolve()) if folders else "", "code": code}
        write_json(place[0] / "jobs" / f"{place[1]:05d}.json", record)
    if code == INTERRUPTED and not is_launched():
        raise KeyboardInterrupt
    return print_report(code, *folders)


def verb_resume(arguments: list[str]) -> int:
    """gsx resume RUN [KEY=VALUE ...] [--trust] [--changed]"""
    description = (
        "Go on where a run stopped, bit for bit; iterations=N lengthens it. --trust: also with code that RUN names. "
        "--changed: also where cameras or config.yaml are no longer what it began with."
    )
    words = [word for word in arguments if word not in RESUME_FLAGS]
    folder, overrides = run_arguments("resume", words, description, "".join(f" [{flag}]" for flag in RESUME_FLAGS))
    with loading():
        from gsx.engine.cache import in_use
        from gsx.experiments.run_folder.claims import claimed
        from gsx.experiments.run_folder.files import read_run, reported, state_of
        from gsx.experiments.runs.history import go_on
        from gsx.experiments.runs.open import open_run, refuse_other
        from gsx.experiments.runs.saved_settings import write_config

    loaded = plugins()
    refuse_other(folder)
    with in_use(), claimed(folder) if speaks() else nullcontext():
        run, settings = open_run(folder, loaded, overrides, training=True, trusted="--trust" in arguments)
        if run.step > run.iterations:
            less = f"iterations={run.iterations} is less: give iterations=N with N above {run.step}"
            raise InputError(f"{folder} has come to step {run.step}, and {less}")
        if run.complete and reported(folder) and state_of(read_run(folder))[0] == "ok":
            remedy = "give iterations=N with N above that to lengthen it"
            raise InputError(f"{folder} is complete at step {run.step}: {remedy}")
        if run.ranks.first:
            go_on(run, settings, loaded, changed="--changed" in arguments)
            write_config(folder / "config.yaml", settings.resolved)
        logger.info("resuming %s at step %d", folder, run.step)
        return print_report(carry_out(run, settings, loaded), folder)
