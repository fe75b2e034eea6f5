"""From overrides to typed options: Hydra composes, dataclasses check, mistakes get the nearest match.

Everything that touches hydra or omegaconf is in this module.
"""

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsx.core.errors import ConfigError, first_line, nearest
from gsx.core.evaluation.evaluator import EvalOptions
from gsx.core.plugins import Component, Plugins
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.regenerator import Checks
from gsx.core.training.run import TrainingOptions

OmegaConf.register_new_resolver("either", lambda first, second: first or second, replace=True)
OmegaConf.register_new_resolver("share_of", lambda whole, share: max(1, round(whole * share)), replace=True)

MODULE = "gsx.conf"
LAUNCHERS = {
    "processes": ("hydra-joblib-launcher", "sweep"),
    "joblib": ("hydra-joblib-launcher", "sweep"),
    "slurm": ("hydra-submitit-launcher", "slurm"),
    "submitit_slurm": ("hydra-submitit-launcher", "slurm"),
    "submitit_local": ("hydra-submitit-launcher", "slurm"),
}
"""Package and extra of each launcher beside Hydra's own."""
COMPONENT_KINDS = ("scene", "backbone")
"""Groups whose node names a registered component."""


@dataclass(frozen=True, kw_only=True)
class GeneralOptions:
    """Top-level values; conf/config.yaml gives them."""

    iterations: int
    seed: int
    device: str
    output: str
    folder: str
    length: int = 0
    """Iterations of the whole run, of which a budget takes a share: the variant's, the scene's or the backbone's."""
    variant: str = ""
    """Name of the published method that is composed; empty for others."""
    data_root: str = ""
    """Where datasets lie."""
    reuse: bool = False
    """The run's folder is named by its composition; what is finished there is not trained again (`core.identity`)."""
    init: str = "scratch"
    """scratch, or trunk: branch from an earlier run that differs in its augmenters alone (`warm_start`)."""
    trunk_at: list[int] = field(default_factory=list)
    """Steps at which states are kept for other runs; none given: where the paper's variants begin."""
    trunk_gb: float = 10.0
    """Disk for the states that runs branch from, 10^9 bytes; those used longest ago make room."""

    def __post_init__(self) -> None:
        if self.init not in ("scratch", "trunk"):
            raise ValueError(f"init is '{self.init}'; choose scratch or trunk")
        if self.reuse and self.folder:
            raise ValueError(f"reuse=true names the folder itself; leave out folder={self.folder}")
        if not self.trunk_gb >= 0:
            raise ValueError(f"trunk_gb is {self.trunk_gb}; give 10^9 bytes from 0")


@dataclass(frozen=True, kw_only=True)
class Budget:
    """How much of a published run is run; values in conf/budget."""

    name: str
    share: float
    """Of the iterations."""

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise ValueError(f"budget.share is {self.share}; give a fraction above 0, at most 1")


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Published scenes below one folder; values in conf/dataset."""

    name: str
    title: str
    """As tables name it."""
    obtained: str
    """Where it is to be had."""
    folder: str
    """Below data_root; empty: it is built in."""
    needs: list[str]
    """What the folder of a scene must hold."""
    scenes: dict[str, str]
    """Folder and name in tables, by scene."""
    scene: str
    """The one that is trained."""


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """A component and its typed options."""

    component: Component
    options: Any


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A composed and checked experiment."""

    general: GeneralOptions
    training: TrainingOptions
    evaluation: EvalOptions
    raster: RasterSettings
    scene: Chosen
    backbone: Chosen
    augmenters: dict[str, Chosen]
    """By name, in the order of the command line."""
    regenerators: dict[str, Chosen]
    """By role: upscale, restore. Only those that an augmenter asks for are built."""
    dataset: Dataset | None
    trackers: dict[str, Chosen]
    """By name, in the order of the command line."""
    resolved: dict[str, Any]
    """The same as plain values, for config.yaml."""


@contextmanager
def hydra_session(plugins: Plugins) -> Iterator[None]:
    """Hydra initialised on the packaged configuration and the plugins' search paths, and cleared afterwards."""
    from hydra import initialize_config_module
    from hydra.core.global_hydra import GlobalHydra

    register_search_paths(plugins)
    GlobalHydra.instance().clear()
    with initialize_config_module(MODULE, version_base="1.3"):
        yield


def register_search_paths(plugins: Plugins) -> None:
    """Let Hydra search the configuration packages of plugins."""
    from hydra.core.config_search_path import ConfigSearchPath
    from hydra.core.plugins import Plugins as HydraPlugins
    from hydra.plugins.search_path_plugin import SearchPathPlugin

    paths = plugins.config_paths

    class PluginPaths(SearchPathPlugin):
        def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
            for path in paths:
                search_path.append(provider="gsx", path=path)

    if paths:
        HydraPlugins.instance().register(PluginPaths)


class Compositions:
    """Many compositions in one session of Hydra: `with Compositions(plugins) as compositions`."""

    def __init__(self, plugins: Plugins) -> None:
        self.plugins, self.session = plugins, hydra_session(plugins)

    def __enter__(self) -> "Compositions":
        self.session.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.session.__exit__(*error)

    def settings(self, overrides: Sequence[str]) -> Settings:
        """One composition, checked; see `compose`."""
        return settings_from(compose_raw(overrides), self.plugins)

    def node(self, overrides: Sequence[str], key: str) -> dict[str, Any]:
        """One node of a composition as plain values, unchecked; empty where there is none."""
        found = OmegaConf.select(compose_raw(overrides), key)
        return OmegaConf.to_container(found, resolve=True) if isinstance(found, DictConfig) else {}  # type: ignore

    def keys(self, overrides: Sequence[str]) -> list[str]:
        """Dotted keys of a composition."""
        return list(dotted(OmegaConf.to_container(compose_raw(overrides), resolve=False)))

    def value(self, overrides: Sequence[str], key: str) -> Any:
        """One value of a composition."""
        return OmegaConf.select(compose_raw(overrides), key)

    def choices(self, group: str) -> list[str]:
        """Options of a group."""
        from hydra.core.global_hydra import GlobalHydra

        return list(GlobalHydra.instance().config_loader().get_group_options(group))

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
        context = HydraContext(config_loader=GlobalHydra.instance().config_loader(), callbacks=Callbacks(config))
        launcher = HydraPlugins.instance().instantiate_launcher(hydra_context=context, task_function=job, config=config)
        for result in launcher.launch([list(words) for words in jobs], initial_job_idx=0):
            _ = result.return_value  # raises what a job raised


def quoted(text: str) -> str:
    """A text as the value of an override, whatever characters it has."""
    return "'" + text.replace("'", "\\'") + "'"


def compose(overrides: Sequence[str], plugins: Plugins) -> Settings:
    """Compose and check an experiment.

    Raises:
        ConfigError: a group, option, key or value is wrong; the nearest right one is named.
    """
    with hydra_session(plugins):
        return settings_from(compose_raw(overrides), plugins)


def compose_raw(overrides: Sequence[str]) -> DictConfig:
    """Hydra's composition inside a `hydra_session`, with its errors turned into ours."""
    from hydra import compose as hydra_compose
    from hydra.errors import HydraException

    check_groups(overrides)
    try:
        return hydra_compose("config", overrides=list(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error, overrides)) from error


def parse_overrides(overrides: Sequence[str]) -> list[Any]:
    """Hydra's Override objects, or ConfigError."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        raise ConfigError(f"override cannot be read: {first_line(error)} (quote it for the shell)") from error


def check_groups(overrides: Sequence[str]) -> None:
    """Refuse unknown groups and options with the nearest match before Hydra does so less helpfully."""
    from hydra.core.global_hydra import GlobalHydra

    loader = GlobalHydra.instance().config_loader()
    groups = known_groups()
    for override in parse_overrides(overrides):
        if override.key_or_group == "hydra/launcher":
            refuse_absent_launcher(str(override.value()))
        if override.key_or_group not in groups or override.is_sweep_override():
            continue
        options = loader.get_group_options(override.key_or_group)
        if not options:
            inner = ", ".join(group for group in groups if group.startswith(f"{override.key_or_group}/"))
            raise ConfigError(f"{override.key_or_group} is chosen by role: {inner}")
        value = override.value()
        for name in value if isinstance(value, list) else [value]:
            if str(name) not in options:
                raise ConfigError(
                    f"{override.key_or_group}={name}: there is no such {override.key_or_group}; "
                    f"choose from {', '.join(options)}.{nearest(str(name), options)}"
                )


def refuse_absent_launcher(name: str) -> None:
    """Raise ConfigError if a launcher's package is not installed."""
    from importlib.metadata import PackageNotFoundError, distribution

    package, extra = LAUNCHERS.get(name, ("", ""))
    try:
        if package:
            distribution(package)
    except PackageNotFoundError as error:
        raise ConfigError(f"hydra/launcher={name} needs the package {package}: pip install 'gsx[{extra}]'") from error


def known_groups() -> list[str]:
    """Configuration groups, nested ones included: `regenerator/upscale`."""
    from hydra.core.global_hydra import GlobalHydra

    loader = GlobalHydra.instance().config_loader()
    outer = [group for group in loader.list_groups("") if not group.startswith("hydra")]
    return outer + [f"{group}/{inner}" for group in outer for inner in loader.list_groups(group)]


def explain(error: Exception, overrides: Sequence[str]) -> str:
    """One sentence for an error of composition, with the nearest key where a key is unknown."""
    found = re.search(r"Could not override '([^']+)'|Key '([^']+)' is not in struct", str(error))
    if not found:
        return f"the configuration cannot be composed: {first_line(error)}"
    key = (found.group(1) or found.group(2)).lstrip("+~")
    known = known_keys(overrides)
    if key in known:  # a mapping that is open, such as arguments of a function
        return f"'{key}' takes its entries one by one: '+{key}.NAME=VALUE'"
    return f"'{key}' is no configuration key.{nearest(key, known) or ' `gsx --cfg job` lists all keys.'}"


def known_keys(overrides: Sequence[str]) -> list[str]:
    """Dotted keys of the composition made from the group choices alone."""
    from hydra import compose as hydra_compose

    choices = [o for o in overrides if re.match(r"^[a-z_/]+=[\w\[\],]+$", o) and is_group(o.split("=")[0])]
    return list(dotted(OmegaConf.to_container(hydra_compose("config", overrides=choices), resolve=False)))


def is_group(key: str) -> bool:
    """Whether a key names a configuration group."""
    return key in known_groups()


def dotted(node: Any, prefix: str = "") -> Iterator[str]:
    """Dotted paths of all keys, inner nodes included."""
    for key, value in node.items() if isinstance(node, dict) else ():
        yield f"{prefix}{key}"
        yield from dotted(value, f"{prefix}{key}.")


def settings_from(config: DictConfig | dict[str, Any], plugins: Plugins) -> Settings:
    """Check a composed configuration, or one read back from a run folder, against the schemas.

    Raises:
        ConfigError: an unknown key or a value of the wrong type; value, key and remedy are named.
    """
    config = OmegaConf.create(config)
    refuse_unknown_scene(config)
    refuse_unknown_roles(config)
    try:
        raw = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"a value cannot be resolved: {first_line(error)}") from error
    assert isinstance(raw, dict)
    if isinstance(raw.get("scene"), dict) and raw["scene"].get("path"):  # a run folder must open from anywhere
        raw["scene"]["path"] = str(Path(str(raw["scene"]["path"])).expanduser().resolve())
    values = {key: value for key, value in raw.items() if key != "experiment"}
    for role, node in named_nodes(values.pop("checks", None), "checks").items():
        typed(Checks, node, f"checks.{role}")  # augmenters have taken theirs over
    dataset, budget = values.pop("dataset", None), values.pop("budget", None)
    if budget is not None:
        typed(Budget, budget, "budget")
    augmenters, regenerators = (named_nodes(values.pop(kind, None), kind) for kind in ("augmenter", "regenerator"))
    trackers = named_nodes(values.pop("tracker", None), "tracker")
    parts = {key: values.pop(key, None) for key in ("training", "eval", "metrics", "rasterizer", *COMPONENT_KINDS)}
    evaluation = dict(parts["eval"] or {}) | {"lpips": (parts["metrics"] or {}).get("lpips", {})}
    return Settings(
        general=typed(GeneralOptions, values, ""),
        training=typed(TrainingOptions, parts["training"], "training"),
        evaluation=typed(EvalOptions, evaluation, "eval"),
        raster=typed(RasterSettings, parts["rasterizer"], "rasterizer"),
        scene=chosen("scene", parts["scene"], plugins),
        backbone=chosen("backbone", parts["backbone"], plugins),
        augmenters={name: chosen("augmenter", node, plugins, name) for name, node in augmenters.items()},
        regenerators={role: chosen("regenerator", node, plugins, role) for role, node in regenerators.items()},
        dataset=typed(Dataset, dataset, "dataset") if dataset else None,
        trackers={name: chosen("tracker", node, plugins, name) for name, node in trackers.items()},
        resolved={key: value for key, value in raw.items() if key not in ("experiment", "checks")},  # type: ignore[misc]
    )


def refuse_unknown_roles(config: Any) -> None:
    """Raise ConfigError if an augmenter that checks pictures takes the role of no regenerator."""
    raw = OmegaConf.to_container(config, resolve=False)
    assert isinstance(raw, dict)
    known = list(raw.get("checks") or {})
    for name, node in named_nodes(raw.get("augmenter"), "augmenter").items():
        role = node.get("role") if isinstance(node, dict) and "checks" in node else None
        if known and role is not None and role not in known:
            raise ConfigError(
                f"augmenter.{name}.role: no regenerator is chosen for '{role}', there are {', '.join(known)}: take one "
                f"of them, or add regenerator/{role}=NAME and +checks/strict@checks.{role}.{nearest(role, known)}"
            )


def refuse_unknown_scene(config: Any) -> None:
    """Raise ConfigError if the scene chosen is none of the dataset's."""
    dataset = OmegaConf.to_container(config.get("dataset") or OmegaConf.create({}), resolve=False)
    assert isinstance(dataset, dict)
    known = list(dataset.get("scenes") or {})
    if dataset and (name := str(dataset.get("scene"))) not in known:
        raise ConfigError(
            f"dataset.scene is '{name}'; {dataset.get('title')} has "
            f"{', '.join(known) or 'no scenes: name them, +dataset.scenes.FOLDER=NAME'}.{nearest(name, known)}"
        )


def named_nodes(values: Any, kind: str) -> dict[str, Any]:
    """Nodes below a group that may hold several; none where it is empty, or missing from an older run."""
    if isinstance(values, dict):
        return values
    if values:
        raise ConfigError(f"{kind} is {values!r}; choose with {kind}=[NAME,...] when training")
    return {}


def chosen(kind: str, node: Any, plugins: Plugins, inner: str = "") -> Chosen:
    """The component a node names, and its options; `inner` is its key where a group holds several."""
    if not isinstance(node, dict):
        raise ConfigError(
            f"{kind} is {node!r}, which is no group of options: choose one with {kind}=NAME when training"
        )
    component = plugins.registry.find(kind, str(node.get("name", "")))
    return Chosen(component=component, options=typed(component.options, node, f"{kind}.{inner}" if inner else kind))


def typed(schema: type, values: Any, path: str) -> Any:
    """An instance of a dataclass from plain values; see `settings_from` for errors."""
    try:
        given = values if isinstance(values, dict) else {}
        merged = OmegaConf.merge(writable(OmegaConf.structured(schema), given), OmegaConf.create(values or {}))
        return OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise ConfigError(complaint(error, schema, path)) from error
    except ValueError as error:  # a dataclass refused the combination
        raise ConfigError(str(error)) from error


def writable(node: DictConfig, given: dict[str, Any]) -> DictConfig:
    """Frozen dataclasses make read-only nodes, which OmegaConf cannot merge into; `given`: what is to be merged."""
    OmegaConf.set_readonly(node, False)
    for key in node:
        child = node._get_node(key)
        if isinstance(child, DictConfig):
            inner = given.get(str(key))
            absent = child._is_missing() or (child._is_none() and isinstance(inner, dict))
            if absent and dataclasses.is_dataclass(child._metadata.ref_type):
                child._set_value(child._metadata.ref_type)  # its fields must be there to be made writable
            if not child._is_none():
                writable(child, inner if isinstance(inner, dict) else {})
    return node


def complaint(error: OmegaConfBaseException, schema: type, path: str) -> str:
    """What is wrong at which key, in one sentence."""
    inner = str(error.full_key or "")
    key = ".".join(part for part in (path, inner) if part)
    if type(error).__name__ == "ConfigKeyError":
        options = [f"{path}.{k}".lstrip(".") for k in schema_keys(schema)]
        return f"'{key}' is no configuration key.{nearest(key, options)}"
    return f"{key}: {first_line(error)}"


def schema_keys(schema: type, prefix: str = "") -> Iterator[str]:
    """Dotted field names of a dataclass and of those inside it."""
    for entry in dataclasses.fields(schema):
        yield f"{prefix}{entry.name}"
        if dataclasses.is_dataclass(entry.type):
            yield from schema_keys(entry.type, f"{prefix}{entry.name}.")  # type: ignore[arg-type]


def write_config(path: Path, resolved: dict[str, Any]) -> None:
    """Save a resolved configuration as YAML."""
    from gsx.core.files import replace_file

    replace_file(path, OmegaConf.to_yaml(OmegaConf.create(resolved)).encode())


def read_config(path: Path, plugins: Plugins, overrides: Sequence[str] = ()) -> Settings:
    """Settings of an existing run, with `key=value` overrides of existing keys.

    Raises:
        ConfigError: the file is unreadable, or an override names no key of it.
    """
    try:
        config = OmegaConf.load(path)
    except Exception as error:
        raise ConfigError(f"{path} cannot be read ({first_line(error)}): give the folder of a gsx run") from error
    add_newer_settings(config)
    known = list(dotted(OmegaConf.to_container(config)))
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or key not in known:
            raise ConfigError(f"'{key}' is no key of {path}.{nearest(key, known)}")
        try:
            OmegaConf.update(config, key, OmegaConf.select(OmegaConf.create(f"value: {value}"), "value"))
        except Exception as error:  # the YAML parser has its own family of errors
            raise ConfigError(f"override '{override}' cannot be read: {first_line(error)}") from error
    return settings_from(config, plugins)  # type: ignore[arg-type]


def add_newer_settings(config: Any) -> None:
    """Give the configuration of an older gsx the rasterizer settings it does not know, at their defaults."""
    if isinstance(config, DictConfig) and isinstance(config.get("rasterizer"), DictConfig):
        config.rasterizer = OmegaConf.merge(dataclasses.asdict(RasterSettings()), config.rasterizer)


def check_overrides(overrides: Sequence[str], plugins: Plugins) -> Path:
    """Refuse wrong groups and keys of a multirun before Hydra starts it; of swept values the first is composed.

    Returns the folder that its runs go to.
    """
    with hydra_session(plugins):
        parsed = parse_overrides(overrides)
        composed = compose_raw([first_of(override) for override in parsed if override.input_line])
        return Path(str(composed.output))


def first_of(override: Any) -> str:
    """An override with its first value where it is swept."""
    if not override.is_sweep_override():
        return str(override.input_line)
    return f"{override.get_key_element()}={next(iter(override.sweep_string_iterator()))}"


def hydra_main(arguments: Sequence[str], plugins: Plugins, job: Callable[[DictConfig], Any]) -> None:
    """Hydra's own command line on our configuration; `job` must be importable, for launchers that start processes."""
    import sys

    import hydra

    register_search_paths(plugins)
    sys.argv = ["gsx", *arguments]
    hydra.main(version_base="1.3", config_path=f"pkg://{MODULE}", config_name="config")(job)()


def job_place() -> tuple[Path, int] | None:
    """(folder of the multirun, number in it) of the job that runs in this process; None outside of one."""
    from hydra.core.hydra_config import HydraConfig

    if not HydraConfig.initialized() or OmegaConf.is_missing(HydraConfig.get().job, "num"):
        return None
    return Path(HydraConfig.get().sweep.dir), int(HydraConfig.get().job.num)
