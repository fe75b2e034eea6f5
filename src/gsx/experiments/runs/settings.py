"""A composed experiment: a component and its typed options for each group. No Hydra here."""

import dataclasses
from dataclasses import dataclass
from importlib.resources import as_file, files
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
from gsx.core.training.regenerator import NamesCode
from gsx.core.training.run import TrainingOptions
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.run_folder.general_options import GeneralOptions, splat_file
from gsx.experiments.runs.plugin_compositors import with_compositors
from gsx.experiments.runs.typed import right_key, schema_keys, texts, typed
from gsx.formats.suffixes import splat_file_at, suffix_of

COMPONENT_KINDS = ("scene", "backbone")
"""Groups whose node names a registered component."""
REDRAWING = ("augmenter", "regenerator")
SEVERAL = (*REDRAWING, "tracker")
"""Groups of such nodes, by name or role."""
GROUPS = ("training", "eval", "metrics", "rasterizer")
"""Of settings that are no component's."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """How much of a published run is run; values in conf/budget."""

    name: str
    share: Share
    """Of the iterations."""

    def __post_init__(self) -> None:
        if not self.share > 0:
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
    images: Annotated[dict[str, int], Range(0, 10**6)] = dataclasses.field(default_factory=dict)
    """Published number of images in a scene's folder `images`, by scene; where it is known."""
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
    checks: dict[str, Checks]
    """By role: what its pictures have to keep, for augmenters without checks of their own."""
    dataset: Dataset | None
    trackers: dict[str, Chosen]
    """By name, in the order of the command line."""
    modules: dict[str, Chosen]
    """Training modules below `training`, by name, in the order in which they are registered."""
    resolved: dict[str, Any]
    """The same as plain values, for config.yaml."""
    idle: frozenset[str]
    """Dotted keys of them that change nothing of what is trained, as their options say."""


def settings_from(config: DictConfig | dict[str, Any], plugins: Plugins) -> Settings:
    """Checks a composed configuration, or one read back from a run folder, against the schemas.

    Raises:
        ConfigError: an unknown key or a value of the wrong type; value, key and remedy are named.
    """
    raw = plain_values(OmegaConf.create(config))
    values = {key: value for key, value in raw.items() if key != "experiment"}
    nodes = {kind: named_nodes(values.pop(kind, None), kind) for kind in (*SEVERAL, "checks")}
    several = {kind: {n: chosen(kind, node, plugins, n) for n, node in nodes[kind].items()} for kind in SEVERAL}
    single = {kind: chosen(kind, values.pop(kind, None), plugins) for kind in COMPONENT_KINDS}
    groups = {key: group_of(values.pop(key, {}), key) for key in GROUPS}
    loop, modules = training_parts(groups["training"], plugins)
    dataset, budget = values.pop("dataset", None), values.pop("budget", None)
    if budget is not None:
        typed(Budget, budget, "budget")
    checks = {role: typed(Checks, node, f"checks.{role}") for role, node in nodes["checks"].items()}
    if all(isinstance(one.options, WithChecks) for one in several["augmenter"].values()):
        raw.pop("checks", None)  # nothing asks for them
    return Settings(
        general=typed(GeneralOptions, values, ""),
        training=typed(TrainingOptions, loop, "training"),
        modules=modules,
        evaluation=typed(EvalOptions, groups["eval"] | {"lpips": groups["metrics"].get("lpips", {})}, "eval"),
        raster=with_compositors(typed(RasterOptions, groups["rasterizer"], "rasterizer"), plugins),
        scene=single["scene"],
        backbone=single["backbone"],
        augmenters=several["augmenter"],
        regenerators=several["regenerator"],
        dataset=typed(Dataset, dataset, "dataset") if dataset else None,
        trackers=several["tracker"],
        checks={role: checks.get(role) or strict_checks() for role in several["regenerator"]},
        resolved={key: value for key, value in raw.items() if key != "experiment"},
        idle=idle_keys(
            {"training": TrainingOptions}
            | {f"training.{name}": one.component.options for name, one in modules.items()}
            | {kind: one.component.options for kind, one in single.items()}
            | {f"{kind}.{n}": one.component.options for kind in REDRAWING for n, one in several[kind].items()}
        ),
    )


def plain_values(config: DictConfig) -> dict[str, Any]:
    """Resolves a configuration and makes paths absolute, so that a run folder opens from anywhere.

    Raises:
        ConfigError: a value cannot be resolved, or names what its group does not have.
    """
    refuse_unknown_scene(config)
    refuse_unknown_roles(config)
    try:
        raw: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"a value cannot be resolved: {first_line(error)}") from error
    for key, text in texts(raw):
        if "${" in text:  # an escaped one; it would be looked up when the run's configuration is read
            raise ConfigError(f"{key} is '{text}'; a run's configuration holds no ${{...}}: name it otherwise")
    if isinstance(raw.get("scene"), dict) and raw["scene"].get("path"):
        raw["scene"]["path"] = str(expand_home(str(raw["scene"]["path"])).resolve())
    if (named := splat_file(raw.get("init"))) is not None and suffix_of(file := splat_file_at(expand_home(named))):
        raw["init"] = str(file.resolve())
    return raw


def training_parts(node: dict[str, Any], plugins: Plugins) -> tuple[dict[str, Any], dict[str, Chosen]]:
    """Splits the group `training` into options of the loop and the modules that it configures.

    Raises:
        ConfigError: a key is neither an option nor a module, or a module is given a value of its own.
    """
    options = {entry.name for entry in dataclasses.fields(TrainingOptions)}
    registered = plugins.registry.of("module")
    for name, value in node.items():
        if name not in options and name not in registered:
            known = [*schema_keys(TrainingOptions, "training."), *(f"training.{module}" for module in registered)]
            missing = ", and no installed plugin has a module of that name" if isinstance(value, dict) else ""
            key = f"training.{name}"
            raise ConfigError(f"'{key}' is no configuration key{missing}.{right_key(key, known)}")
    modules = {
        name: Chosen(component=one, options=typed(one.options, group_of(node[name], path), path))
        for name, one in registered.items()
        if name in node and (path := f"training.{name}")
    }
    return {name: value for name, value in node.items() if name in options}, modules


def idle_keys(options: dict[str, type]) -> frozenset[str]:
    """Returns the dotted keys of a composition that change no result; `options`: schemas by key."""
    return frozenset[str]().union(*(fields_with("none", schema, f"{key}.") for key, schema in options.items()))


def refuse_unknown_roles(config: Any) -> None:
    """Raises ConfigError if an augmenter that checks pictures takes the role of no regenerator."""
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
    """Raises ConfigError if the scene chosen is none of the dataset's."""
    dataset = OmegaConf.to_container(config.get("dataset") or OmegaConf.create({}), resolve=False)
    assert isinstance(dataset, dict)
    known = list(dataset.get("scenes") or {})
    if dataset and (name := str(dataset.get("scene"))) not in known:
        raise ConfigError(
            f"dataset.scene is '{name}'; {dataset.get('title')} has "
            f"{', '.join(known) or 'no scenes: name them, +dataset.scenes.FOLDER=NAME'}.{nearest(name, known)}"
        )


def named_nodes(values: Any, kind: str) -> dict[str, Any]:
    """Returns the nodes below a group that may hold several; none where it is empty or missing."""
    if isinstance(values, dict):
        return values
    if values:
        raise ConfigError(f"{kind} is {values!r}; choose with {kind}=[NAME,...] when training")
    return {}


def chosen(kind: str, node: Any, plugins: Plugins, inner: str = "") -> Chosen:
    """Returns the component that a node names, with its options; `inner` is its key where a group holds several."""
    if not isinstance(node, dict):
        raise ConfigError(
            f"{kind} is {node!r}, which is no group of options: choose one with {kind}=NAME when training"
        )
    component = plugins.registry.find(kind, str(node.get("name", "")))
    return Chosen(component=component, options=typed(component.options, node, f"{kind}.{inner}" if inner else kind))


def group_of(value: Any, key: str) -> dict[str, Any]:
    """Returns the values of a group of settings.

    Raises:
        ConfigError: it was given a value of its own.
    """
    if not isinstance(value, dict):
        given = "null" if value is None else value
        raise ConfigError(f"{key} is {given}, but it is a group of settings: give {key}.NAME=VALUE")
    return value


def named_code(settings: Settings) -> dict[str, str]:
    """Returns modules and files that a composition runs outside of installed packages, by dotted role."""
    options = {f"regenerator.{role}": one.options for role, one in settings.regenerators.items()}
    found = {key: one.named_code() for key, one in options.items() if isinstance(one, NamesCode)}
    return {key: code for key, code in found.items() if code}


def strict_node() -> Any:
    """Returns conf/checks/strict.yaml."""
    with as_file(files("gsx.conf").joinpath("checks", "strict.yaml")) as path:
        return OmegaConf.load(path)


def strict_checks() -> Checks:
    """Returns the checks of regenerators that promise consistency, and of all that say nothing."""
    return typed(Checks, OmegaConf.to_container(strict_node()), "checks")
