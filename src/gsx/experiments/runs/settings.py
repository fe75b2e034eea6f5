"""A composed experiment: a component and its typed options for each group. No Hydra here."""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsx.augmenters.checks import Checks, WithChecks
from gsx.core.errors import ConfigError, first_line, nearest
from gsx.core.files import expand_home
from gsx.core.options import fields_with
from gsx.core.plugins import Component, Plugins
from gsx.core.ranges import Range, Share
from gsx.core.rasterizer import RasterOptions, RasterSettings
from gsx.core.rasterizer.compositor import Compositor
from gsx.core.training.regenerator import NamesCode
from gsx.core.training.run import TrainingOptions
from gsx.experiments.evaluation.eval_options import EvalOptions, MetricOptions
from gsx.experiments.run_folder.general_options import GeneralOptions, splat_file
from gsx.experiments.runs.typed import schema_keys, texts, typed, unknown_key
from gsx.formats.suffixes import splat_file_at, suffix_of

COMPONENT_KINDS = ("scene", "backbone")
"""Groups whose node names a registered component."""
REDRAWING = ("augmenter", "regenerator")
SEVERAL = (*REDRAWING, "tracker")
"""Groups with several components, by name or role."""
COMPETITOR = "eval.competitor"
"""Key of the upscaler that zoomed renders are compared with."""
COMPETITOR_GROUP = f"regenerator/upscale@{COMPETITOR}"
"""Choice of that upscaler on the command line."""
GROUPS = ("training", "eval", "metrics", "rasterizer")
"""Groups of settings without a component."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Share of a published run that is trained; values in conf/budget."""

    name: str
    share: Share
    """Share of the iterations."""

    def __post_init__(self) -> None:
        if not self.share > 0:
            raise ValueError(f"budget.share is {self.share}; give a fraction above 0, at most 1")


@dataclass(frozen=True, kw_only=True)
class Archive:
    """A ZIP file of a dataset's authors, for `gsx datasets --get`."""

    file: str
    """Name below data_root/archives."""
    url: str = ""
    """Public address; empty: fetch it by hand."""
    scenes: list[str]
    """Scenes that it holds."""
    megabytes: Annotated[int, Range(0, 10**7)] = 0
    """Size, 10^6 bytes, rounded; 0: not known before the server states it."""
    sha256: str = ""
    """Published checksum; empty: none is published."""

    def __post_init__(self) -> None:
        """Refuse names with folders, and addresses of other protocols than HTTP."""
        if Path(self.file).name != self.file:
            raise ValueError(f"dataset.archives: file '{self.file}' has to be a name without folders")
        if self.url and not self.url.startswith(("https://", "http://")):
            raise ValueError(f"dataset.archives: url '{self.url}' has to start with https:// or http://")


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Published scenes below one folder; values in conf/dataset."""

    name: str
    title: str
    """Name in tables."""
    obtained: str
    """Source of the data."""
    folder: str
    """Folder below data_root; empty: the scene is built in."""
    needs: list[str]
    """Files and folders that the folder of a scene must hold."""
    scenes: dict[str, str]
    """Folder and name in tables, by scene."""
    images: Annotated[dict[str, int], Range(0, 10**6)] = dataclasses.field(default_factory=dict)
    """Published number of images in a scene's folder `images`, by scene."""
    scene: str
    """Scene to train."""
    licence: str = ""
    """Terms of use as its authors state them, or where; empty: they state none."""
    archives: list[Archive] = dataclasses.field(default_factory=list)
    """Files that hold its scenes."""


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
    """Augmenters by name, in the order of the command line."""
    regenerators: dict[str, Chosen]
    """Regenerators by role: upscale, restore. Only those that an augmenter uses are built."""
    checks: dict[str, Checks]
    """Checks of pictures by role, for augmenters without their own."""
    dataset: Dataset | None
    trackers: dict[str, Chosen]
    """Trackers by name, in the order of the command line."""
    competitor: Chosen | None
    """Upscaler of x1 renders that zoomed renders are compared with; None: none."""
    modules: dict[str, Chosen]
    """Modules below `training` by name, in the order of their registration."""
    resolved: dict[str, Any]
    """All of it as plain values, for config.yaml."""
    idle: frozenset[str]
    """Dotted keys that do not change the training."""
    repeat: tuple[str, ...] = ()
    """Words that train the same without a plan; empty: those of the command line."""
    time_plan: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Facts of a plan by wall time, for environment.json; empty: there is none."""


def settings_from(config: DictConfig | dict[str, Any], plugins: Plugins) -> Settings:
    """Check a composed configuration, or that of a run folder, against the schemas; raise ConfigError as `typed`."""
    raw = plain_values(OmegaConf.create(config))
    values = {key: value for key, value in raw.items() if key != "experiment"}
    nodes = {kind: named_nodes(values.pop(kind, None), kind) for kind in (*SEVERAL, "checks")}
    several = {
        kind: {n: chosen(kind, node, plugins, f"{kind}.{n}") for n, node in nodes[kind].items()} for kind in SEVERAL
    }
    single = {kind: chosen(kind, values.pop(kind, None), plugins) for kind in COMPONENT_KINDS}
    groups = {key: group_of(values.pop(key, {}), key) for key in GROUPS}
    loop, modules = training_parts(groups["training"], plugins)
    evaluation = dict(groups["eval"])
    competitor = competitor_from(evaluation.pop("competitor", None), plugins)
    dataset, budget = values.pop("dataset", None), values.pop("budget", None)
    if budget is not None:
        typed(Budget, budget, "budget")
    checks = {role: typed(Checks, node, f"checks.{role}") for role, node in nodes["checks"].items()}
    strict = typed(Checks, OmegaConf.to_container(strict_node()), "checks")
    if all(isinstance(one.options, WithChecks) for one in several["augmenter"].values()):
        raw.pop("checks", None)  # nothing uses them
    return Settings(
        general=typed(GeneralOptions, values, ""),
        training=typed(TrainingOptions, loop, "training"),
        modules=modules,
        evaluation=evaluation_options(evaluation, groups["metrics"]),
        raster=with_compositors(typed(RasterOptions, groups["rasterizer"], "rasterizer"), plugins),
        scene=single["scene"],
        backbone=single["backbone"],
        competitor=competitor,
        augmenters=several["augmenter"],
        regenerators=several["regenerator"],
        dataset=typed(Dataset, dataset, "dataset") if dataset else None,
        trackers=several["tracker"],
        checks={role: checks.get(role) or strict for role in several["regenerator"]},
        resolved={key: value for key, value in raw.items() if key != "experiment"},
        idle=idle_keys(
            {"training": TrainingOptions}
            | {f"training.{name}": one.component.options for name, one in modules.items()}
            | {kind: one.component.options for kind, one in single.items()}
            | {f"{kind}.{n}": one.component.options for kind in REDRAWING for n, one in several[kind].items()}
        ),
    )


def evaluation_options(evaluation: dict[str, Any], metrics: dict[str, Any]) -> EvalOptions:
    """Return the options of the groups `eval` and `metrics`, of which an older run has only `lpips`; ConfigError."""
    names = {entry.name for entry in dataclasses.fields(MetricOptions)}
    own = {"lpips": {}} | {name: value for name, value in metrics.items() if name in names}
    typed(MetricOptions, own, "metrics")  # errors name that group
    return typed(EvalOptions, evaluation | own, "eval")


def plain_values(config: DictConfig) -> dict[str, Any]:
    """Resolve a configuration and make paths absolute, so that a run folder opens from anywhere."""
    refuse_unknown_scene(config)
    refuse_unknown_roles(config)
    try:
        raw: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"a value cannot be resolved: {first_line(error)}") from error
    for key, text in texts(raw):
        if "${" in text:  # an escaped one; reading the run's configuration would resolve it
            raise ConfigError(f"{key} is '{text}'; ${{...}} is not allowed in a run's configuration: rename it")
    if isinstance(raw.get("scene"), dict) and raw["scene"].get("path"):
        raw["scene"]["path"] = str(expand_home(str(raw["scene"]["path"])).resolve())
    if (named := splat_file(raw.get("init"))) is not None and suffix_of(file := splat_file_at(expand_home(named))):
        raw["init"] = str(file.resolve())
    return raw


def training_parts(node: dict[str, Any], plugins: Plugins) -> tuple[dict[str, Any], dict[str, Chosen]]:
    """Split the group `training` into options of the loop and modules; raise ConfigError for any other key."""
    options = {entry.name for entry in dataclasses.fields(TrainingOptions)}
    registered = plugins.registry.of("module")
    for name, value in node.items():
        if name not in options and name not in registered:
            known = [*schema_keys(TrainingOptions, "training."), *(f"training.{module}" for module in registered)]
            missing = ", and no installed plugin has a module of that name" if isinstance(value, dict) else ""
            raise ConfigError(unknown_key(f"training.{name}", known, missing, ""))
    modules = {
        name: Chosen(component=one, options=typed(one.options, group_of(node[name], path), path))
        for name, one in registered.items()
        if name in node and (path := f"training.{name}")
    }
    return {name: value for name, value in node.items() if name in options}, modules


def idle_keys(options: dict[str, type]) -> frozenset[str]:
    """Return the dotted keys of a composition that change no result; `options`: schemas by key."""
    return frozenset[str]().union(*(fields_with("none", schema, f"{key}.") for key, schema in options.items()))


def refuse_unknown_roles(config: Any) -> None:
    """Raise ConfigError if an augmenter that checks pictures names the role of no regenerator."""
    raw = OmegaConf.to_container(config, resolve=False)
    assert isinstance(raw, dict)
    known = list(raw.get("checks") or {})
    for name, node in named_nodes(raw.get("augmenter"), "augmenter").items():
        role = node.get("role") if isinstance(node, dict) and "checks" in node else None
        if known and role is not None and role not in known:
            raise ConfigError(
                f"augmenter.{name}.role: no regenerator is chosen for '{role}'. Use one of {', '.join(known)}, or add "
                f"regenerator/{role}=NAME and +checks/strict@checks.{role}.{nearest(role, known)}"
            )


def refuse_unknown_scene(config: Any) -> None:
    """Raise ConfigError if the chosen scene is not in the dataset."""
    dataset = OmegaConf.to_container(config.get("dataset") or OmegaConf.create({}), resolve=False)
    assert isinstance(dataset, dict)
    known = list(dataset.get("scenes") or {})
    if dataset and (name := str(dataset.get("scene"))) not in known:
        raise ConfigError(
            f"dataset.scene is '{name}'; {dataset.get('title')} has "
            f"{', '.join(known) or 'no scenes: name them, +dataset.scenes.FOLDER=NAME'}.{nearest(name, known)}"
        )


def named_nodes(values: Any, kind: str) -> dict[str, Any]:
    """Return the nodes of a group that may hold several; none if it is empty or missing."""
    if isinstance(values, dict):
        return values
    if values:
        raise ConfigError(f"{kind} is {values!r}; choose with {kind}=[NAME,...] when training")
    return {}


def competitor_from(node: Any, plugins: Plugins) -> Chosen | None:
    """Return the upscaler of a node; None if it is null, or absent as in older runs."""
    if node is None:
        return None
    if not isinstance(node, dict):
        raise ConfigError(f"{COMPETITOR} is {node!r}: choose one with {COMPETITOR_GROUP}=NAME, or {COMPETITOR}=null")
    return chosen("regenerator", node, plugins, COMPETITOR)


def chosen(kind: str, node: Any, plugins: Plugins, key: str = "") -> Chosen:
    """Return the component of a node with its options; `key`: dotted key of the node, if it is not the kind's."""
    if not isinstance(node, dict):
        raise ConfigError(f"{kind} is {node!r}, not a group of options: choose one with {kind}=NAME when training")
    component = plugins.registry.find(kind, str(node.get("name", "")))
    return Chosen(component=component, options=typed(component.options, node, key or kind))


def group_of(value: Any, key: str) -> dict[str, Any]:
    """Return the values of a group of settings; raise ConfigError if it is a single value."""
    if not isinstance(value, dict):
        word = "null" if value is None else value
        raise ConfigError(f"{key} is {word}, but it is a group of settings: give {key}.NAME=VALUE")
    return value


def named_code(settings: Settings) -> dict[str, str]:
    """Return modules and files outside of installed packages that a composition runs, by dotted role."""
    options = {f"regenerator.{role}": one.options for role, one in settings.regenerators.items()}
    options |= {COMPETITOR: settings.competitor.options} if settings.competitor else {}
    found = {key: one.named_code() for key, one in options.items() if isinstance(one, NamesCode)}
    return {key: code for key, code in found.items() if code}


def strict_node() -> Any:
    """Load conf/checks/strict.yaml, the default: the checks of regenerators that promise consistency."""
    with as_file(files("gsx.conf").joinpath("checks", "strict.yaml")) as path:
        return OmegaConf.load(path)


class Compositors(Mapping[str, Compositor]):
    """Compositors by name, each built at its first use."""

    def __init__(self, components: Mapping[str, Component]) -> None:
        self.components = components
        self.built: dict[str, Compositor] = {}

    def __getitem__(self, name: str) -> Compositor:
        if name not in self.built:
            component = self.components[name]
            self.built[name] = component.factory(component.options())
        return self.built[name]

    def __contains__(self, name: object) -> bool:
        return name in self.components

    def __iter__(self) -> Iterator[str]:
        return iter(self.components)

    def __len__(self) -> int:
        return len(self.components)


def with_compositors(options: RasterOptions, plugins: Plugins) -> RasterSettings:
    """Return settings whose path may name any registered compositor; raise ConfigError if it names none."""
    try:
        return RasterSettings(**vars(options), compositors=Compositors(plugins.registry.of("compositor")))
    except ValueError as error:
        raise ConfigError(str(error)) from error


def overridden(settings: Settings, changes: Mapping[str, object], plugins: Plugins) -> Settings:
    """Return settings with other values by dotted key; raise ConfigError as `settings_from`."""
    config = OmegaConf.create(settings.resolved)
    for key, value in changes.items():
        OmegaConf.update(config, key, value, force_add=True)
    return settings_from(config, plugins)
