"""Several runs by Hydra's launchers: `gsx -m`, and the jobs of a table."""

import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsx.core.errors import ConfigError, GsxError, first_line
from gsx.core.plugins import Plugins
from gsx.experiments.runs import config_files
from gsx.experiments.runs.compose import MODULE, compose_raw, hydra_session, known_groups, version_base
from gsx.experiments.runs.launched import waiting_for_all
from gsx.experiments.runs.overrides import parse_overrides, quoted, refuse_absent_slurm, with_quoted_paths
from gsx.experiments.runs.settings import settings_from

FULL_ERROR = "HYDRA_FULL_ERROR"
MOST_COUNTED = 1000
"""Values of a sweep that are counted."""
Job = Callable[[DictConfig], Any]


def launch_jobs(overrides: Sequence[str], folder: Path, jobs: Sequence[Sequence[str]], job: Job) -> None:
    """Run jobs (lists of overrides) by the launcher of `overrides`, inside a session; its output goes to `folder`."""
    from hydra import compose as hydra_compose
    from hydra._internal.callbacks import Callbacks
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.plugins import Plugins as HydraPlugins
    from hydra.types import HydraContext

    place = f"hydra.sweep.dir={quoted(str(folder))}"
    config = hydra_compose("config", overrides=[*overrides, place], return_hydra_config=True)
    if "n_jobs" in config.hydra.launcher:
        config.hydra.launcher.n_jobs = processes_for(len(jobs), config.hydra.launcher.n_jobs)
    context = HydraContext(config_loader=GlobalHydra.instance().config_loader(), callbacks=Callbacks(config))
    launcher = HydraPlugins.instance().instantiate_launcher(hydra_context=context, task_function=job, config=config)
    with waiting_for_all(folder):
        for result in launcher.launch([list(words) for words in jobs], initial_job_idx=0):
            _ = result.return_value  # raises the error of a job


def processes_for(jobs: int, limit: int) -> int:
    """Return the number of processes of joblib's launcher, at most one per job.

    All of them share the cores, and a signal to one without a job would end the others.
    """
    from joblib import effective_n_jobs

    return int(min(jobs, effective_n_jobs(limit)))


def check_overrides(overrides: Sequence[str], plugins: Plugins) -> tuple[Path, list[str]]:
    """Refuse wrong groups, keys and values of a multirun before Hydra starts it.

    Composes each choice of a swept group with the first value of every other sweep. Returns (output folder of the
    runs, overrides of the launcher for as many runs).
    """
    refuse_absent_slurm(overrides)
    with hydra_session(plugins):
        groups, parsed = known_groups(), [one for one in parse_overrides(overrides) if one.input_line]
        refuse_one_folder(parsed)
        words = [words_of(one, one.key_or_group in groups) for one in parsed]
        first = [values[0] for values in words]
        output = Path(settings_from(compose_raw(first, plugins.registry), plugins).general.output)
        for place, values in enumerate(words):
            for other in values[1:]:
                compose_raw([*first[:place], other, *first[place + 1 :]], plugins.registry)
        sweeps = [one.sweep_string_iterator() for one in parsed if one.is_sweep_override()]
        return output, launcher_for(math.prod(len(list(islice(one, MOST_COUNTED))) for one in sweeps), first)


def launcher_for(jobs: int, overrides: Sequence[str]) -> list[str]:
    """Return overrides of the launcher for so many jobs."""
    from hydra import compose as hydra_compose

    launcher = hydra_compose("config", overrides=list(overrides), return_hydra_config=True).hydra.launcher
    return [f"hydra.launcher.n_jobs={processes_for(jobs, launcher.n_jobs)}"] if "n_jobs" in launcher else []


def refuse_one_folder(overrides: Sequence[Any]) -> None:
    """Raise ConfigError for a sweep whose runs would all go to one folder."""
    sweeps = any(one.is_sweep_override() for one in overrides)
    for one in overrides:
        if sweeps and one.key_or_group == "folder" and not one.is_sweep_override() and "${" not in one.input_line:
            remedy = "give output=FOLDER, or a name with their difference, 'folder=FOLDER/${seed}'"
            raise ConfigError(f"{one.input_line} is for one run, and these are several: {remedy}")


def words_of(override: Any, every: bool) -> list[str]:
    """Return an override with each value of its sweep, or with the first; itself if it does not sweep."""
    from hydra.errors import HydraException

    if not override.is_sweep_override():
        return [str(override.input_line)]
    try:
        values = list(islice(override.sweep_string_iterator(), None if every else 1))
    except HydraException as error:
        glob = "glob chooses among files of the configuration: name them" if "glob(" in override.input_line else ""
        raise ConfigError(f"{override.input_line} cannot be swept: {glob or first_line(error)}") from error
    if not values:
        raise ConfigError(f"{override.input_line} sweeps no value: give at least one")
    return [f"{override.get_key_element()}={value}" for value in values]


def hydra_main(arguments: Sequence[str], plugins: Plugins, job: Job) -> None:
    """Run Hydra's command line on our configuration; launchers that start processes import `job`."""
    import hydra

    config_files.register(plugins.config_paths)
    sys.argv = ["gsx", *arguments]
    hydra.main(**version_base(), config_path=f"pkg://{MODULE}", config_name="config")(job)()


def launch(arguments: Sequence[str], plugins: Plugins, job: Job) -> None:
    """Run the jobs of a multirun by Hydra's launcher.

    Raises:
        ConfigError: the launcher failed. Errors of gsx and of the file system stay as they are.
    """
    try:
        with full_errors():
            hydra_main(arguments, plugins, job)
    except (GsxError, OSError):
        raise
    except Exception as error:
        remedy = "correct its settings, or run one after the other here with hydra/launcher=basic"
        raise ConfigError(f"the launcher failed ({type(error).__name__}: {first_line(error)}): {remedy}") from error


def print_instead(flags: Sequence[str], overrides: Sequence[str], plugins: Plugins, job: Job) -> None:
    """Let Hydra print what the flags name.

    Raises:
        ConfigError: the overrides cannot be composed.
    """
    from hydra.errors import HydraException

    try:
        with full_errors():
            hydra_main([*flags, *with_quoted_paths(overrides)], plugins, job)
    except (HydraException, OmegaConfBaseException) as error:
        with hydra_session(plugins):
            compose_raw(overrides, plugins.registry)  # its errors name remedies
        raise ConfigError(f"Hydra failed ({first_line(error)}): correct the words after gsx") from error


@contextmanager
def full_errors() -> Iterator[None]:
    """Make Hydra raise its errors: otherwise it prints a traceback and ends the program."""
    before = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"
    try:
        yield
    finally:
        os.environ.pop(FULL_ERROR, None)
        os.environ |= {} if before is None else {FULL_ERROR: before}


def job_place() -> tuple[Path, int] | None:
    """Return (folder of the multirun, number in it) of the job that runs in this process; None outside of one."""
    from hydra.core.hydra_config import HydraConfig

    if not HydraConfig.initialized() or OmegaConf.is_missing(HydraConfig.get().job, "num"):
        return None
    return Path(HydraConfig.get().sweep.dir), int(HydraConfig.get().job.num)


def job_overrides() -> list[str]:
    """Return the overrides of the job that runs in this process; empty outside of a multirun."""
    from hydra.core.hydra_config import HydraConfig

    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []
