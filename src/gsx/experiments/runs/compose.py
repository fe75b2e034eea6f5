"""Composition of overrides by Hydra; `config_files`, `overrides`, `multirun` and `protocols` use Hydra as well."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import resources
from inspect import signature
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsx.core.errors import ConfigError, first_line, nearest
from gsx.core.files import expand_home
from gsx.core.plugins import Plugins, Registry
from gsx.experiments.run_folder.general_options import GeneralOptions
from gsx.experiments.runs.overrides import parse_overrides, refuse_absent_launcher, refuse_sweep, with_quoted_paths
from gsx.experiments.runs.protocols import NamedProtocol, named_protocol, refuse_other_scene
from gsx.experiments.runs.settings import Settings, settings_from
from gsx.experiments.runs.typed import dotted, schema_keys, unknown_key

NEWER = "replace" in signature(OmegaConf.register_resolver).parameters  # OmegaConf 2.4: an older function of this name
register: Callable[..., None] = OmegaConf.register_resolver if NEWER else OmegaConf.register_new_resolver
register("either", lambda first, second: first or second, replace=True)
register("share_of", lambda whole, share: max(1, round(whole * share)), replace=True)

MODULE = "gsx.conf"
MOST_KEPT = 16
"""Compositions, a MB each, that a session keeps."""


@contextmanager
def hydra_session(plugins: Plugins) -> Iterator[None]:
    """Initialise Hydra on the packaged configuration and the plugins' search paths, and clear it afterwards."""
    from hydra import initialize_config_module
    from hydra.core.global_hydra import GlobalHydra

    from gsx.experiments.runs import config_files

    config_files.register(plugins.config_paths)
    GlobalHydra.instance().clear()
    with initialize_config_module(MODULE, **version_base()):
        yield


def version_base() -> dict[str, str]:
    """Return the argument that makes Hydra 1.3 follow its own rules: newer versions warn of it and have no others."""
    import hydra

    return {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}


@dataclass(frozen=True)
class Source:
    """A file of the configuration."""

    name: str
    """`conf/...` for gsx's own, else its path."""
    file: Path
    package: str
    """Dotted key below which its keys lie; empty: at the top."""


class Compositions:
    """Many compositions in one session of Hydra: `with Compositions(plugins) as compositions`."""

    def __init__(self, plugins: Plugins) -> None:
        self.plugins, self.session = plugins, hydra_session(plugins)
        self.recent = lru_cache(MOST_KEPT)(partial(compose_raw, registry=plugins.registry))

    def __enter__(self) -> "Compositions":
        self.session.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.session.__exit__(*error)

    def composed(self, overrides: Sequence[str]) -> DictConfig:
        """Return the result of `compose_raw`, shared between equal overrides: callers must not change it."""
        return self.recent(tuple(overrides))

    def settings(self, overrides: Sequence[str]) -> Settings:
        """Return checked settings; see `compose`."""
        return settings_from(self.composed(overrides), self.plugins)

    def node(self, overrides: Sequence[str], key: str) -> dict[str, Any]:
        """Return one node as plain values, unchecked; empty if there is none."""
        node = OmegaConf.select(self.composed(overrides), key)
        return OmegaConf.to_container(node, resolve=True) if isinstance(node, DictConfig) else {}  # type: ignore

    def keys(self, overrides: Sequence[str]) -> list[str]:
        """Return the dotted keys of a composition."""
        return list(dotted(OmegaConf.to_container(self.composed(overrides), resolve=False)))

    def value(self, overrides: Sequence[str], key: str) -> Any:
        """Return one value."""
        return OmegaConf.select(self.composed(overrides), key)

    def values(self, overrides: Sequence[str]) -> Any:
        """Return a whole composition as plain values, unchecked."""
        return OmegaConf.to_container(self.composed(overrides), resolve=True)

    def protocol(self, name: str) -> NamedProtocol:
        """Return a protocol by name; raise ConfigError for an unknown one."""
        check_choices("protocol", name, known_groups(), self.plugins.registry)
        return named_protocol(name)

    def sources(self, overrides: Sequence[str]) -> list[Source]:
        """Return the files of a composition in the order of merging."""
        from hydra.core.global_hydra import GlobalHydra
        from hydra.types import RunMode

        loader = GlobalHydra.instance().config_loader()
        merged = loader.compute_defaults_list("config", list(overrides), RunMode.RUN).defaults
        files = [(str(one.config_path), str(one.package), self.file(str(one.config_path))) for one in merged]
        packaged = Path(str(resources.files(MODULE)))
        return [
            Source(f"conf/{name}.yaml" if file.is_relative_to(packaged) else str(file), file, package)
            for name, package, file in files
            if file.is_file()
        ]

    def file(self, name: str) -> Path:
        """Return the file of an option `GROUP/NAME`, of gsx or of a plugin; it may not exist."""
        paths = [path for path in self.plugins.config_paths if path.startswith("pkg://")]
        modules = [MODULE, *(path.removeprefix("pkg://") for path in paths)]
        files = [Path(str(resources.files(module))) / f"{name}.yaml" for module in modules]
        return next((file for file in files if file.is_file()), files[0])


def compose(overrides: Sequence[str], plugins: Plugins) -> Settings:
    """Compose and check an experiment.

    Raises:
        ConfigError: a group, option, key or value is wrong; the nearest right one is named.
    """
    with hydra_session(plugins):
        settings = settings_from(compose_raw(overrides, plugins.registry), plugins)
    for key in ("output", "folder"):  # Hydra and quoted words do not expand ~
        path = getattr(settings.general, key)
        if path == "~" or path.startswith("~/"):
            raise ConfigError(f"{key} is '{path}', which would be below this folder: give {key}={expand_home(path)}")
    return settings


def compose_raw(overrides: Sequence[str], registry: Registry | None = None) -> DictConfig:
    """Return Hydra's composition inside a `hydra_session`; raise its errors as ConfigError.

    registry: components, for errors about those without a file.
    """
    from hydra import compose as hydra_compose
    from hydra.errors import HydraException

    overrides = with_quoted_paths(overrides)
    check_groups(overrides, registry)
    try:
        config = hydra_compose("config", overrides=overrides)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error, overrides)) from error
    refuse_other_scene(overrides, config)
    return config


def check_groups(overrides: Sequence[str], registry: Registry | None = None) -> None:
    """Refuse unknown groups and options with the nearest match, which Hydra does not name."""
    groups = known_groups()
    for override in parse_overrides(overrides):
        key = override.key_or_group
        if key == "hydra":
            raise ConfigError("'hydra' is the group of Hydra's own settings: give hydra.NAME=VALUE or hydra/GROUP=NAME")
        if override.is_sweep_override():
            refuse_sweep(override, key in groups)
        if key == "hydra.launcher.n_jobs" and override.value() == 0:
            raise ConfigError("hydra.launcher.n_jobs is 0; give a number of processes, or -1 for one per core")
        if key == "hydra/launcher":
            refuse_absent_launcher(str(override.value()))
        if key in (*groups, "module"):
            check_choices(key, override.value(), groups, registry)
        elif override.is_add() or override.is_force_add():
            check_added(key, groups, forced=override.is_force_add())


def check_added(key: str, groups: Sequence[str], forced: bool) -> None:
    """Refuse `+KEY=VALUE` at the top for a key that exists, unless forced (`++`), or that no schema has."""
    known = [name for name in schema_keys(GeneralOptions) if "." not in name]
    if key in known and not forced:
        raise ConfigError(f"'+{key}': {key} has a value already, leave out the +")
    if "." not in key and key not in known:
        raise ConfigError(unknown_key(key, [*groups, *known]))


def check_choices(group: str, value: Any, groups: Sequence[str], registry: Registry | None = None) -> None:
    """Refuse options that a group does not have, or one that is chosen twice."""
    options = listed(group)
    refuse_without_file(group, value, options, registry)
    if not options:
        inner = ", ".join(one for one in groups if one.startswith(f"{group}/"))
        raise ConfigError(f"{group} is chosen by role: {inner}" if inner else f"no installed plugin has a {group}")
    names = [str(name) for name in (value if isinstance(value, list) else [value])]
    for index, name in enumerate(names):
        if name not in options:
            raise ConfigError(f"Unknown {group} '{name}'. Choose from {', '.join(options)}.{nearest(name, options)}")
        if name in names[:index]:
            raise ConfigError(f"{group}=[{','.join(names)}] names {name} twice: leave one out")


def refuse_without_file(group: str, value: Any, options: Sequence[str], registry: Registry | None) -> None:
    """Refuse a registered component whose plugin has no file for it in the configuration."""
    components = registry.of(group.partition("/")[0]) if registry else {}
    for name in map(str, value if isinstance(value, list) else [value]):
        if name in components and name not in options:
            raise ConfigError(
                f"plugin {components[name].provider} registers {components[name].kind} '{name}', but no "
                f"{group}/{name}.yaml is installed: add that file to its configuration (gsx_config_paths) and to its "
                "package data"
            )


def known_groups() -> list[str]:
    """Return configuration groups, nested ones included: `regenerator/upscale`."""
    outer = [group for group in listed("", groups=True) if not group.startswith("hydra")]
    return outer + [f"{group}/{inner}" for group in outer for inner in listed(group, groups=True)]


def listed(group: str, groups: bool = False) -> list[str]:
    """Return the options of a group, or the groups in it. Hydra's own list composes its configuration for each call."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.object_type import ObjectType

    kind = ObjectType.GROUP if groups else ObjectType.CONFIG
    sources = GlobalHydra.instance().config_loader().get_sources()
    return sorted({name for source in sources if source.is_group(group) for name in source.list(group, kind)})


def explain(error: Exception, overrides: Sequence[str]) -> str:
    """Return one sentence for an error of composition, with the nearest key for an unknown key."""
    found = re.search(r"Could not override '([^']+)'|Key '([^']+)' is not in struct", str(error))
    if not found:
        return f"the configuration cannot be composed: {first_line(error)}"
    key = (found.group(1) or found.group(2)).lstrip("+~")
    known = [*known_keys(overrides), *known_groups()]
    if key in known:  # an open mapping, such as arguments of a function
        return f"'{key}' takes its entries one by one: '+{key}.NAME=VALUE'"
    return unknown_key(key, known)


def known_keys(overrides: Sequence[str]) -> list[str]:
    """Return the dotted keys of the composition made from the group choices alone."""
    from hydra import compose as hydra_compose

    choices = [o for o in overrides if re.match(r"^[a-z_/]+=[\w\[\],']+$", o) and o.split("=")[0] in known_groups()]
    return list(dotted(OmegaConf.to_container(hydra_compose("config", overrides=choices), resolve=False)))
