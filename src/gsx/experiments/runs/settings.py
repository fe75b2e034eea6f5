"""A composed configuration, checked against typed schemas: mistakes get the nearest match. No Hydra here."""

import copy
import dataclasses
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsx.augmenters.checked_regenerator import Checks, WithChecks
from gsx.core.errors import ConfigError, first_line, nearest
from gsx.core.files import at_home
from gsx.core.options import fields_with
from gsx.core.plugins import Component, Plugins
from gsx.core.ranges import Range, Share, beyond_range
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.settings import OF_BACKBONES
from gsx.core.training.regenerator import NamesCode
from gsx.core.training.run import TrainingOptions
from gsx.experiments.evaluation.evaluator import EvalOptions
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.run_folder.files import part
from gsx.experiments.run_folder.general_options import GeneralOptions, splat_file
from gsx.experiments.run_folder.renamed import advice, renamed
from gsx.formats.suffixes import splat_file_at, suffix_of

COMPONENT_KINDS = ("scene", "backbone")
"""Groups whose node names a registered component."""
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
    for key, text in texts(raw):
        if "${" in text:  # an escaped one; it would be looked up when the run's configuration is read
            raise ConfigError(f"{key} is '{text}'; a run's configuration holds no ${{...}}: name it otherwise")
    if isinstance(raw.get("scene"), dict) and raw["scene"].get("path"):  # a run folder must open from anywhere
        raw["scene"]["path"] = str(at_home(str(raw["scene"]["path"])).resolve())
    if (named := splat_file(raw.get("init"))) is not None and suffix_of(file := splat_file_at(at_home(named))):
        raw["init"] = str(file.resolve())
    values = {key: value for key, value in raw.items() if key != "experiment"}
    checks = {r: typed(Checks, n, f"checks.{r}") for r, n in named_nodes(values.pop("checks", None), "checks").items()}
    dataset, budget = values.pop("dataset", None), values.pop("budget", None)
    if budget is not None:
        typed(Budget, budget, "budget")
    augmenters, regenerators = (named_nodes(values.pop(kind, None), kind) for kind in ("augmenter", "regenerator"))
    trackers = named_nodes(values.pop("tracker", None), "tracker")
    parts = {key: values.pop(key, None) for key in COMPONENT_KINDS}
    parts |= {key: group_of(values.pop(key, {}), key) for key in GROUPS}
    evaluation = parts["eval"] | {"lpips": parts["metrics"].get("lpips", {})}
    single = {kind: chosen(kind, parts[kind], plugins) for kind in COMPONENT_KINDS}
    loop, modules = training_parts(parts["training"], plugins)
    redrawing = {role: chosen("regenerator", node, plugins, role) for role, node in regenerators.items()}
    found = {name: chosen("augmenter", node, plugins, name) for name, node in augmenters.items()}
    unused = () if any(not isinstance(one.options, WithChecks) for one in found.values()) else ("checks",)
    return Settings(
        general=typed(GeneralOptions, values, ""),
        training=typed(TrainingOptions, loop, "training"),
        modules=modules,
        evaluation=typed(EvalOptions, evaluation, "eval"),
        raster=typed(RasterSettings, parts["rasterizer"], "rasterizer"),
        scene=single["scene"],
        backbone=single["backbone"],
        augmenters=found,
        regenerators=redrawing,
        dataset=typed(Dataset, dataset, "dataset") if dataset else None,
        trackers={name: chosen("tracker", node, plugins, name) for name, node in trackers.items()},
        checks={role: checks.get(role) or strict_checks() for role in regenerators},
        resolved={key: value for key, value in raw.items() if key not in ("experiment", *unused)},  # type: ignore[misc]
        idle=idle_keys(
            {"training": TrainingOptions}
            | {f"training.{name}": one.component.options for name, one in modules.items()}
            | {kind: one.component.options for kind, one in single.items()}
            | {f"augmenter.{name}": one.component.options for name, one in found.items()}
            | {f"regenerator.{role}": one.component.options for role, one in redrawing.items()}
        ),
    )


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
    chosen = {
        name: Chosen(component=one, options=typed(one.options, group_of(node[name], path), path))
        for name, one in registered.items()
        if name in node and (path := f"training.{name}")
    }
    return {name: value for name, value in node.items() if name in options}, chosen


def idle_keys(options: dict[str, type]) -> frozenset[str]:
    """Dotted keys of a composition that change nothing of what is trained; `options`: schemas by key."""
    return frozenset[str]().union(*(fields_with("none", schema, f"{key}.") for key, schema in options.items()))


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


@dataclass(frozen=True)
class Values:
    """Plain values; equal where they are written alike, so that 1 is neither 1.0 nor true."""

    plain: Any = field(compare=False)
    text: str

    @classmethod
    def of(cls, plain: Any) -> "Values":
        """Some values."""
        return cls(plain, repr(plain))


def group_of(value: Any, key: str) -> dict[str, Any]:
    """The values of a group of settings.

    Raises:
        ConfigError: it was given a value of its own.
    """
    if not isinstance(value, dict):
        given = "null" if value is None else value
        raise ConfigError(f"{key} is {given}, but it is a group of settings: give {key}.NAME=VALUE")
    return value


def typed(schema: type, values: Any, path: str) -> Any:
    """An instance of a dataclass from plain values; see `settings_from` for errors."""
    return copy.deepcopy(checked(schema, Values.of(values), path))


@lru_cache(maxsize=512)
def checked(schema: type, given: Values, path: str) -> Any:
    """As `typed`; kept, since most nodes of many compositions are the same."""
    values = given.plain
    refuse_not_finite(values, path)
    try:
        named = values if isinstance(values, dict) else {}
        merged = OmegaConf.merge(writable(OmegaConf.structured(schema), named), OmegaConf.create(values or {}))
        plain: Any = OmegaConf.to_container(merged)
        for key, value, bounds in beyond_range(schema, plain):
            raise ConfigError(f"{f'{path}.{key}'.lstrip('.')} is {value}; give a number {bounds}")
        return OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise ConfigError(complaint(error, schema, path)) from error
    except ValueError as error:  # a dataclass refused the combination
        raise ConfigError(str(error)) from error


def refuse_not_finite(value: Any, path: str) -> None:
    """Raise ConfigError for a number that is none, anywhere below a key: every comparison with nan lets it pass."""
    if isinstance(value, dict):
        for key, inner in value.items():
            refuse_not_finite(inner, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for inner in value:
            refuse_not_finite(inner, path)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{path} is {value}; give a finite number")


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
    key, text = ".".join(part for part in (path, inner) if part), first_line(error)
    if type(error).__name__ == "ConfigKeyError":
        options = [f"{path}.{k}".lstrip(".") for k in schema_keys(schema)]
        return f"'{key}' is no configuration key.{right_key(key, options)}"
    if "is not a ListConfig" in text:
        return f"{key} takes a list: give {key}=[...], with commas between its values"
    if (group := re.search(r"is not a subclass of (\w+)", text)) is not None:
        key = ".".join([part for part in (path, key_of_type(schema, group[1])) if part]) or key
        return f"{key} is no value but a group of settings: give {key}.NAME=VALUE"
    return f"{key}: {text}"


def key_of_type(schema: type, name: str, prefix: str = "") -> str:
    """Dotted name of the first field that is a dataclass of that name, or empty."""
    for entry in dataclasses.fields(schema):
        if not dataclasses.is_dataclass(entry.type):
            continue
        key = f"{prefix}{entry.name}"
        if entry.type.__name__ == name:  # type: ignore[union-attr]
            return key
        if found := key_of_type(entry.type, name, f"{key}."):  # type: ignore[arg-type]
            return found
    return ""


def right_key(key: str, known: Iterable[str]) -> str:
    """` It is now called 'x'.` for a key of older versions, else ` Did you mean 'x'?` or nothing."""
    return advice(key) or nearest(key, known)


def schema_keys(schema: type, prefix: str = "") -> Iterator[str]:
    """Dotted field names of a dataclass and of those inside it, with keys of mappings by default."""
    for entry in dataclasses.fields(schema):
        yield f"{prefix}{entry.name}"
        made = entry.default_factory() if entry.default_factory is not dataclasses.MISSING else None
        yield from (f"{prefix}{entry.name}.{key}" for key in (made if isinstance(made, dict) else ()))
        if dataclasses.is_dataclass(entry.type):
            yield from schema_keys(entry.type, f"{prefix}{entry.name}.")  # type: ignore[arg-type]


def write_config(path: Path, resolved: dict[str, Any]) -> None:
    """Save a resolved configuration as YAML."""
    from gsx.core.files import replace_text

    replace_text(path, OmegaConf.to_yaml(OmegaConf.create(resolved)))


def read_config(path: Path, plugins: Plugins, overrides: Sequence[str] = ()) -> Settings:
    """Settings of an existing run, with `key=value` overrides of its keys, and of those that gsx has had since.

    Raises:
        ConfigError: the file is unreadable, or an override names no such key.
    """
    try:
        config = OmegaConf.load(path)
    except Exception as error:
        raise ConfigError(f"{path} cannot be read ({first_line(error)}): give the folder of a gsx run") from error
    if isinstance(config, DictConfig):
        config = OmegaConf.create(renamed(OmegaConf.to_container(config)))  # type: ignore[arg-type]
        refuse_interpolation(path, config)
    add_newer_settings(config)
    written = OmegaConf.to_container(config)
    newer = newer_keys(written, plugins) if overrides and isinstance(written, dict) else ()
    known = list(dict.fromkeys([*dotted(written), *newer]))
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise ConfigError(f"'{override}' is given no value: write {override}=VALUE")
        if key not in known:
            near = right_key(key, known) or " All of them are in that file."
            raise ConfigError(f"'{key}' is no key of {path}.{near}")
        try:
            OmegaConf.update(config, key, value_of(value), force_add=True)
        except Exception as error:  # the YAML parser has its own family of errors
            raise ConfigError(f"override '{override}' cannot be read: {first_line(error)}") from error
    return settings_from(config, plugins)  # type: ignore[arg-type]


def newer_keys(config: Any, plugins: Plugins) -> Iterator[str]:
    """Dotted keys that a run's composition may have by today's schemas; an older run's file lacks some of them."""
    schemas: dict[str, type] = {"training": TrainingOptions, "eval": EvalOptions, "metrics.lpips": LpipsOptions}
    nodes = {kind: (kind, part(config, kind)) for kind in COMPONENT_KINDS}
    for kind in ("augmenter", "regenerator", "tracker"):
        nodes |= {f"{kind}.{name}": (kind, node) for name, node in part(config, kind).items() if isinstance(node, dict)}
    for key, (kind, node) in nodes.items():
        schemas[key] = plugins.registry.find(kind, str(node.get("name", ""))).options
    schemas |= {f"training.{name}": one.options for name, one in plugins.registry.of("module").items()}
    yield from schema_keys(GeneralOptions)
    for key, schema in schemas.items():
        yield from (name for name in schema_keys(schema, f"{key}.") if not name.startswith("eval.lpips"))


def refuse_interpolation(path: Path, config: DictConfig) -> None:
    """Raise ConfigError for a value that is looked up when it is read: somebody else's file would learn of this
    machine's environment. gsx writes none."""
    for key, text in texts(OmegaConf.to_container(config, resolve=False)):
        if "${" in text:
            raise ConfigError(f"{path}: {key} is '{text}'; a run's configuration holds plain values: write what it is")


def value_of(word: str) -> Any:
    """What a word of the command line stands for, as YAML."""
    return OmegaConf.select(OmegaConf.create(f"value: {word}"), "value")


def texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """All texts inside nested mappings and lists, with their keys."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, one in inner:
        yield from texts(one, f"{key}.{name}".lstrip("."))
    if isinstance(value, str):
        yield key, value


def named_code(settings: Settings) -> dict[str, str]:
    """Modules and files that a composition runs and that are part of no installed package, by dotted role."""
    options = {f"regenerator.{role}": one.options for role, one in settings.regenerators.items()}
    found = {key: one.named_code() for key, one in options.items() if isinstance(one, NamesCode)}
    return {key: code for key, code in found.items() if code}


def add_newer_settings(config: Any) -> None:
    """Give the configuration of an older gsx what it does not know, as older runs had it.

    Settings of the rasterizer at their defaults; any number of absent images; checks of redrawn pictures, which were
    the strict ones; the gate of `clone_split`, which was a yes or no beside its numbers.
    """
    if not isinstance(config, DictConfig):
        return
    if isinstance(config.get("rasterizer"), DictConfig):
        options = {key: v for key, v in dataclasses.asdict(RasterSettings()).items() if key not in OF_BACKBONES}
        config.rasterizer = OmegaConf.merge(options, config.rasterizer)
    if "downscale" in (config.get("scene") or {}) and "missing" not in config.scene:
        config.scene.missing = 1.0
    augmenters = config.get("augmenter")
    for node in augmenters.values() if isinstance(augmenters, DictConfig) else ():
        if isinstance(node, DictConfig) and {"scales", "weight_map"} <= node.keys() and "checks" not in node:
            node.checks = strict_node()
    density = OmegaConf.select(config, "backbone.clone_split.level_density")
    if isinstance(density, DictConfig) and "gate" in density:
        waits = density.pop("gate")
        if config.backbone.get("densification") == "clone_split":
            OmegaConf.update(config, "backbone.quirks.gate", "closed" if waits else "open", force_add=True)


def strict_node() -> Any:
    """conf/checks/strict.yaml."""
    with as_file(files("gsx.conf").joinpath("checks", "strict.yaml")) as path:
        return OmegaConf.load(path)


def strict_checks() -> Checks:
    """The checks of regenerators that promise consistency, and of all that say nothing."""
    return typed(Checks, OmegaConf.to_container(strict_node()), "checks")
