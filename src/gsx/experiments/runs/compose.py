"""From overrides to a composition: the only module that speaks to Hydra, but for the files that Hydra reads."""

import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from inspect import signature
from itertools import islice
from pathlib import Path
from shutil import which
from typing import Any, NoReturn

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsx.core.errors import ConfigError, GsxError, first_line, nearest
from gsx.core.files import at_home
from gsx.core.plugins import Plugins
from gsx.experiments.runs.launched import waiting_for_all
from gsx.experiments.runs.settings import Settings, dotted, right_key, settings_from

NEWER = "replace" in signature(OmegaConf.register_resolver).parameters  # OmegaConf 2.4: an older function of this name
register: Callable[..., None] = OmegaConf.register_resolver if NEWER else OmegaConf.register_new_resolver
register("either", lambda first, second: first or second, replace=True)
register("share_of", lambda whole, share: max(1, round(whole * share)), replace=True)

MODULE = "gsx.conf"
LAUNCHERS = {
    "processes": ("hydra-joblib-launcher", "sweep"),
    "joblib": ("hydra-joblib-launcher", "sweep"),
    "slurm": ("hydra-submitit-launcher", "slurm"),
    "submitit_slurm": ("hydra-submitit-launcher", "slurm"),
    "submitit_local": ("hydra-submitit-launcher", "slurm"),
}
"""Package and extra of each launcher beside Hydra's own."""
FULL_ERROR = "HYDRA_FULL_ERROR"
SLURM = ("slurm", "submitit_slurm")
"""Launchers that submit jobs by Slurm's own programs."""
MOST_KEPT = 16
"""Compositions of a session, a MB each, that are there when they are asked for again."""


@contextmanager
def hydra_session(plugins: Plugins) -> Iterator[None]:
    """Hydra initialised on the packaged configuration and the plugins' search paths, and cleared afterwards."""
    from hydra import initialize_config_module
    from hydra.core.global_hydra import GlobalHydra

    from gsx.experiments.runs import config_files

    config_files.register(plugins.config_paths)
    GlobalHydra.instance().clear()
    with initialize_config_module(MODULE, **version_base()):
        yield


def version_base() -> dict[str, str]:
    """Return the argument that keeps Hydra 1.3 to its own rules: newer ones warn of it, and have no other."""
    import hydra

    return {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}


@dataclass(frozen=True)
class Source:
    """A file of the configuration."""

    name: str
    """As people are told it."""
    file: Path
    package: str
    """Dotted key below which its keys lie; empty: at the top."""


class Compositions:
    """Many compositions in one session of Hydra: `with Compositions(plugins) as compositions`."""

    def __init__(self, plugins: Plugins) -> None:
        self.plugins, self.session = plugins, hydra_session(plugins)
        self.lately = lru_cache(MOST_KEPT)(compose_raw)

    def __enter__(self) -> "Compositions":
        self.session.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.session.__exit__(*error)

    def composed(self, overrides: Sequence[str]) -> DictConfig:
        """What `compose_raw` makes, once of overrides that are asked for several times; it is not to be changed."""
        return self.lately(tuple(overrides))

    def settings(self, overrides: Sequence[str]) -> Settings:
        """One composition, checked; see `compose`."""
        return settings_from(self.composed(overrides), self.plugins)

    def node(self, overrides: Sequence[str], key: str) -> dict[str, Any]:
        """One node of a composition as plain values, unchecked; empty where there is none."""
        found = OmegaConf.select(self.composed(overrides), key)
        return OmegaConf.to_container(found, resolve=True) if isinstance(found, DictConfig) else {}  # type: ignore

    def keys(self, overrides: Sequence[str]) -> list[str]:
        """Dotted keys of a composition."""
        return list(dotted(OmegaConf.to_container(self.composed(overrides), resolve=False)))

    def value(self, overrides: Sequence[str], key: str) -> Any:
        """One value of a composition."""
        return OmegaConf.select(self.composed(overrides), key)

    def choices(self, group: str) -> list[str]:
        """Options of a group."""
        return listed(group)

    def values(self, overrides: Sequence[str]) -> Any:
        """A whole composition as plain values, unchecked."""
        return OmegaConf.to_container(self.composed(overrides), resolve=True)

    def groups(self) -> list[str]:
        """Configuration groups, nested ones included."""
        return known_groups()

    def sources(self, overrides: Sequence[str]) -> list[Source]:
        """Files of gsx and of plugins that a composition is made of, in the order in which they are merged."""
        from hydra.core.global_hydra import GlobalHydra
        from hydra.types import RunMode

        loader = GlobalHydra.instance().config_loader()
        merged = loader.compute_defaults_list("config", list(overrides), RunMode.RUN).defaults
        files = [(str(one.config_path), str(one.package), self.file(str(one.config_path))) for one in merged]
        return [Source(place_of(name, file), file, package) for name, package, file in files if file.is_file()]

    def file(self, name: str) -> Path:
        """The file of an option `GROUP/NAME`, in gsx's configuration or in a plugin's; it may not exist."""
        paths = [path for path in self.plugins.config_paths if path.startswith("pkg://")]
        modules = [MODULE, *(path.removeprefix("pkg://") for path in paths)]
        files = [Path(str(resources.files(module))) / f"{name}.yaml" for module in modules]
        return next((file for file in files if file.is_file()), files[0])

    def launch(
        self,
        overrides: Sequence[str],
        folder: Path,
        jobs: Sequence[Sequence[str]],
        job: Callable[[DictConfig], Any],
    ) -> None:
        """Carry out jobs, each given by its overrides, by the launcher that `overrides` choose (hydra/launcher=...).

        What the launcher writes goes to `folder`.
        """
        from hydra import compose as hydra_compose
        from hydra._internal.callbacks import Callbacks
        from hydra.core.global_hydra import GlobalHydra
        from hydra.core.plugins import Plugins as HydraPlugins
        from hydra.types import HydraContext

        config = hydra_compose(
            "config", overrides=[*overrides, f"hydra.sweep.dir={quoted(str(folder))}"], return_hydra_config=True
        )
        if "n_jobs" in config.hydra.launcher:
            config.hydra.launcher.n_jobs = processes_for(len(jobs), config.hydra.launcher.n_jobs)
        context = HydraContext(config_loader=GlobalHydra.instance().config_loader(), callbacks=Callbacks(config))
        launcher = HydraPlugins.instance().instantiate_launcher(hydra_context=context, task_function=job, config=config)
        with waiting_for_all(folder):
            for result in launcher.launch([list(words) for words in jobs], initial_job_idx=0):
                _ = result.return_value  # raises what a job raised


def place_of(name: str, file: Path) -> str:
    """What people are told a file of the configuration is called: `conf/...` for gsx's own."""
    own = file.is_relative_to(str(resources.files(MODULE)))
    return f"conf/{name}.yaml" if own else str(file)


def key_of(word: str) -> str:
    """The key of an override, without what is below it."""
    return word.lstrip("+~").partition("=")[0].split(".")[0].split("/")[0].split("@")[0]


def quoted(text: str) -> str:
    """A text as the value of an override, whatever characters it has.

    A backslash stands for itself, unless it is before a quote or an interpolation, where each must be doubled (Hydra's
    override grammar, OmegaConf's escapes).
    """
    escaped = re.sub(r"(\\*)('|\$\{)", lambda found: f"{found[1] * 2}\\{found[2]}", text)
    return "'" + re.sub(r"(\\+)\Z", r"\1\1", escaped) + "'"


def word_of(key: str, text: str) -> str:
    """An override with a text for its value, quoted unless it would be read as that text anyway."""
    plain = re.fullmatch(r"[A-Za-z/][\w./:-]*( [\w./:-]+)*", text, re.ASCII)
    bare = plain and text.lower() not in ("null", "true", "false", "nan", "inf")
    return f"{key}={text if bare else quoted(text)}"


ODD = re.compile(r"[^\w./+~ -]", re.ASCII)
"""A character of a value that means something to Hydra."""


def with_quoted_paths(overrides: Sequence[str]) -> list[str]:
    """Return overrides in which a path that exists stands for itself, also one such as `a=b` or `a (1)`."""
    return [_with_quoted_path(word) for word in overrides]


def _with_quoted_path(word: str) -> str:
    key, _, value = word.partition("=")
    return word_of(key, value) if ODD.search(value) and os.path.exists(at_home(value)) else word


def compose(overrides: Sequence[str], plugins: Plugins) -> Settings:
    """Compose and check an experiment.

    Raises:
        ConfigError: a group, option, key or value is wrong; the nearest right one is named.
    """
    with hydra_session(plugins):
        settings = settings_from(compose_raw(overrides), plugins)
    for key in ("output", "folder"):  # which Hydra and the shell take as they are
        given = getattr(settings.general, key)
        if given == "~" or given.startswith("~/"):
            raise ConfigError(f"{key} is '{given}', which would be below this folder: give {key}={at_home(given)}")
    return settings


def compose_raw(overrides: Sequence[str]) -> DictConfig:
    """Hydra's composition inside a `hydra_session`, with its errors turned into ours."""
    from hydra import compose as hydra_compose
    from hydra.errors import HydraException

    overrides = with_quoted_paths(overrides)
    check_groups(overrides)
    try:
        return hydra_compose("config", overrides=overrides)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error, overrides)) from error


def parse_overrides(overrides: Sequence[str]) -> list[Any]:
    """Hydra's Override objects, or ConfigError."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        remedy = "odd characters want quotes within those for the shell, 'KEY=\"VALUE\"'"
        raise ConfigError(f"override cannot be read: {first_line(error)}: {remedy}") from error


def check_groups(overrides: Sequence[str]) -> None:
    """Refuse unknown groups and options with the nearest match before Hydra does so less helpfully."""
    groups = known_groups()
    for override in parse_overrides(overrides):
        if override.key_or_group == "hydra":
            raise ConfigError("'hydra' is a group of Hydra's own settings: give hydra.NAME=VALUE or hydra/GROUP=NAME")
        if override.is_sweep_override():
            refuse_sweep(override, override.key_or_group in groups)
        if override.key_or_group == "hydra.launcher.n_jobs" and override.value() == 0:
            raise ConfigError("hydra.launcher.n_jobs is 0; give how many processes, or -1 for as many as cores")
        if override.key_or_group == "hydra/launcher":
            refuse_absent_launcher(str(override.value()))
        if override.key_or_group in (*groups, "module"):
            check_choices(override.key_or_group, override.value(), groups)


def check_choices(group: str, value: Any, groups: Sequence[str]) -> None:
    """Refuse options that a group does not have, or one that is chosen twice."""
    options = listed(group)
    if not options:
        inner = ", ".join(one for one in groups if one.startswith(f"{group}/"))
        raise ConfigError(f"{group} is chosen by role: {inner}" if inner else f"no installed plugin has a {group}")
    names = [str(name) for name in (value if isinstance(value, list) else [value])]
    for number, name in enumerate(names):
        if name not in options:
            choices = f"choose from {', '.join(options)}.{nearest(name, options)}"
            raise ConfigError(f"{group}={name}: there is no such {group}; {choices}")
        if name in names[:number]:
            raise ConfigError(f"{group}=[{','.join(names)}]: {name} is there twice, and works once: leave one out")


def refuse_sweep(override: Any, group: bool) -> NoReturn:
    """Raise ConfigError for several values where there is to be one; `group`: choices of a group."""
    key, _, values = str(override.input_line).partition("=")
    others = f"; '{key}=\"{values}\"' is one text, '{key}=[{values}]' a list"
    asked = others if override.is_choice_sweep() and not group and not re.search(r"[()'\"]", values) else ""
    raise ConfigError(f"{key}={values} is several values: gsx -m runs one after the other{asked}")


def refuse_absent_launcher(name: str) -> None:
    """Raise ConfigError if a launcher's package is not installed."""
    from importlib.metadata import PackageNotFoundError, distribution

    package, extra = LAUNCHERS.get(name, ("", ""))
    try:
        if package:
            distribution(package)
    except PackageNotFoundError as error:
        raise ConfigError(f"hydra/launcher={name} needs the package {package}: pip install 'gsx[{extra}]'") from error


def refuse_absent_slurm(overrides: Sequence[str]) -> None:
    """Raise ConfigError if jobs go to Slurm and this machine has no program of it."""
    chosen = [str(one.value()) for one in parse_overrides(overrides) if one.key_or_group == "hydra/launcher"]
    if chosen and chosen[-1] in SLURM and which("srun") is None:
        raise ConfigError(
            f"hydra/launcher={chosen[-1]}: this machine has no Slurm, no srun is on the PATH. Submit from a machine of "
            "the cluster, or run here with hydra/launcher=processes"
        )


def known_groups() -> list[str]:
    """Configuration groups, nested ones included: `regenerator/upscale`."""
    outer = [group for group in listed("", groups=True) if not group.startswith("hydra")]
    return outer + [f"{group}/{inner}" for group in outer for inner in listed(group, groups=True)]


def listed(group: str, groups: bool = False) -> list[str]:
    """Options of a group, or the groups in it. Hydra's own list composes its configuration for each answer."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.object_type import ObjectType

    kind = ObjectType.GROUP if groups else ObjectType.CONFIG
    sources = GlobalHydra.instance().config_loader().get_sources()
    return sorted({name for source in sources if source.is_group(group) for name in source.list(group, kind)})


def explain(error: Exception, overrides: Sequence[str]) -> str:
    """One sentence for an error of composition, with the nearest key where a key is unknown."""
    found = re.search(r"Could not override '([^']+)'|Key '([^']+)' is not in struct", str(error))
    if not found:
        return f"the configuration cannot be composed: {first_line(error)}"
    key = (found.group(1) or found.group(2)).lstrip("+~")
    known = known_keys(overrides)
    if key in known:  # a mapping that is open, such as arguments of a function
        return f"'{key}' takes its entries one by one: '+{key}.NAME=VALUE'"
    return f"'{key}' is no configuration key.{right_key(key, known) or ' `gsx --cfg job` lists all keys.'}"


def known_keys(overrides: Sequence[str]) -> list[str]:
    """Dotted keys of the composition made from the group choices alone."""
    from hydra import compose as hydra_compose

    choices = [o for o in overrides if re.match(r"^[a-z_/]+=[\w\[\],']+$", o) and o.split("=")[0] in known_groups()]
    return list(dotted(OmegaConf.to_container(hydra_compose("config", overrides=choices), resolve=False)))


def check_overrides(overrides: Sequence[str], plugins: Plugins) -> tuple[Path, list[str]]:
    """Refuse wrong groups, keys and values of a multirun before Hydra starts it: each choice of a swept group is
    composed with the first of all other values that are swept.

    Returns (the folder that its runs go to, overrides of its launcher for as many runs).
    """
    refuse_absent_slurm(overrides)
    with hydra_session(plugins):
        groups, given = known_groups(), [one for one in parse_overrides(overrides) if one.input_line]
        refuse_one_folder(given)
        words = [words_of(one, one.key_or_group in groups) for one in given]
        first = [values[0] for values in words]
        output = Path(settings_from(compose_raw(first), plugins).general.output)
        for place, values in enumerate(words):
            for other in values[1:]:
                compose_raw([*first[:place], other, *first[place + 1 :]])
        return output, launcher_for(math.prod(size_of_sweep(one) for one in given), first)


def launcher_for(jobs: int, overrides: Sequence[str]) -> list[str]:
    """Overrides of the launcher for so many jobs."""
    from hydra import compose as hydra_compose

    launcher = hydra_compose("config", overrides=list(overrides), return_hydra_config=True).hydra.launcher
    return [f"hydra.launcher.n_jobs={processes_for(jobs, launcher.n_jobs)}"] if "n_jobs" in launcher else []


def processes_for(jobs: int, asked: int) -> int:
    """Processes of joblib's launcher, at most one for each job: the cores are divided among all of them, and one
    without a job could be ended by a signal, which ends the others."""
    from joblib import effective_n_jobs

    return int(min(jobs, effective_n_jobs(asked)))


def size_of_sweep(override: Any) -> int:
    """How many values an override has, up to a thousand."""
    return sum(1 for _ in islice(override.sweep_string_iterator(), 1000)) if override.is_sweep_override() else 1


def refuse_one_folder(overrides: Sequence[Any]) -> None:
    """Raise ConfigError for a sweep whose runs would all go to one folder."""
    sweeps = any(one.is_sweep_override() for one in overrides)
    for one in overrides:
        if sweeps and one.key_or_group == "folder" and not one.is_sweep_override() and "${" not in one.input_line:
            remedy = "give output=FOLDER, or a name with what they differ in, 'folder=FOLDER/${seed}'"
            raise ConfigError(f"{one.input_line} is for one run, and these are several: {remedy}")


def words_of(override: Any, all_of: bool) -> list[str]:
    """An override by each of the values that it sweeps, or by the first of them; itself where it sweeps none.

    Raises:
        ConfigError: it sweeps nothing that can be told.
    """
    from hydra.errors import HydraException

    if not override.is_sweep_override():
        return [str(override.input_line)]
    try:
        values = list(islice(override.sweep_string_iterator(), None if all_of else 1))
    except HydraException as error:
        asked = "glob chooses among files of the configuration: name them" if "glob(" in override.input_line else ""
        raise ConfigError(f"{override.input_line} cannot be swept: {asked or first_line(error)}") from error
    if not values:
        raise ConfigError(f"{override.input_line} sweeps no value: give at least one")
    return [f"{override.get_key_element()}={value}" for value in values]


def hydra_main(arguments: Sequence[str], plugins: Plugins, job: Callable[[DictConfig], Any]) -> None:
    """Hydra's own command line on our configuration; `job` must be importable, for launchers that start processes."""
    import sys

    import hydra

    from gsx.experiments.runs import config_files

    config_files.register(plugins.config_paths)
    sys.argv = ["gsx", *arguments]
    hydra.main(**version_base(), config_path=f"pkg://{MODULE}", config_name="config")(job)()


def launch(arguments: Sequence[str], plugins: Plugins, job: Callable[[DictConfig], Any]) -> None:
    """Run the jobs of a multirun by Hydra's launcher.

    Raises:
        ConfigError: the launcher failed. Errors of gsx and of the file system stay as they are.
    """
    before = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"  # or Hydra prints a traceback and ends the program
    try:
        hydra_main(arguments, plugins, job)
    except (GsxError, OSError):
        raise
    except Exception as error:
        remedy = "mend its settings, or choose hydra/launcher=basic: one run after the other, here"
        raise ConfigError(f"the launcher failed ({type(error).__name__}: {first_line(error)}): {remedy}") from error
    finally:
        os.environ.pop(FULL_ERROR, None)
        os.environ |= {} if before is None else {FULL_ERROR: before}


def job_place() -> tuple[Path, int] | None:
    """(folder of the multirun, number in it) of the job that runs in this process; None outside of one."""
    from hydra.core.hydra_config import HydraConfig

    if not HydraConfig.initialized() or OmegaConf.is_missing(HydraConfig.get().job, "num"):
        return None
    return Path(HydraConfig.get().sweep.dir), int(HydraConfig.get().job.num)
