"""config.yaml of a run folder: written, read back with overrides, and translated from older versions."""

import dataclasses
import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gsx.core.errors import ConfigError, first_line
from gsx.core.files import replace_text
from gsx.core.plugins import Plugins
from gsx.core.rasterizer import RasterOptions
from gsx.core.rasterizer.settings import OF_BACKBONES
from gsx.core.training.run import TrainingOptions
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.run_folder.files import part, read_run
from gsx.experiments.run_folder.general_options import GeneralOptions
from gsx.experiments.run_folder.renamed import renamed
from gsx.experiments.runs.compose import Compositions
from gsx.experiments.runs.protocols import GROUP
from gsx.experiments.runs.settings import (
    COMPETITOR,
    COMPETITOR_GROUP,
    COMPONENT_KINDS,
    SEVERAL,
    Settings,
    plain_values,
    settings_from,
    strict_node,
)
from gsx.experiments.runs.typed import dotted, schema_keys, texts, unknown_key


def write_config(path: Path, resolved: dict[str, Any]) -> None:
    """Save a resolved configuration as YAML."""
    replace_text(path, OmegaConf.to_yaml(OmegaConf.create(resolved)))


def read_config(path: Path, plugins: Plugins, overrides: Sequence[str] = (), spare: Collection[str] = ()) -> Settings:
    """Return the settings of a run, with `key=value` overrides of its keys and of keys that gsx has added since.

    spare: kinds (of SEVERAL, COMPETITOR) whose components are left out of the settings if no plugin provides them.

    Raises:
        ConfigError: the file is unreadable, an override names no such key, or no plugin provides a component.
    """
    config = with_newer_settings(saved_config(path))
    for override in with_protocols(overrides, config, plugins, str(path.parent)):
        key, equals, value = override.partition("=")
        if not equals:
            raise ConfigError(f"'{override}' has no value: write {override}=VALUE")
        known = list(dict.fromkeys([*dotted(OmegaConf.to_container(config)), *newer_keys(config, plugins)]))
        if key == COMPETITOR_GROUP:
            with Compositions(plugins) as compositions:
                upscaler = compositions.node([override], COMPETITOR)
            OmegaConf.update(config, COMPETITOR, upscaler, merge=False, force_add=True)
            continue
        if key not in known:
            raise ConfigError(unknown_key(key, known, f" for {path}", " That file lists all keys."))
        try:
            OmegaConf.update(config, key, value_of(value), force_add=True)
        except Exception as error:  # the YAML parser has its own family of errors
            raise ConfigError(f"override '{override}' cannot be read: {first_line(error)}") from error
    return settings_without(absent_nodes(config, plugins), config, plugins, path.parent, spare)


def with_protocols(overrides: Sequence[str], config: DictConfig, plugins: Plugins, place: str) -> Iterator[str]:
    """Yield the values that each `protocol=NAME` sets, then the other overrides; `place`: the run's folder.

    Raises:
        ConfigError: a protocol is unknown, or the run was prepared otherwise.
    """
    for override in overrides:
        if override.startswith(f"{GROUP}="):
            with Compositions(plugins) as compositions:
                protocol = compositions.protocol(override.partition("=")[2])
            protocol.refuse_run(config, place)
            yield from (f"{key}={json.dumps(value)}" for key, value in protocol.measuring.items())
    yield from (override for override in overrides if not override.startswith(f"{GROUP}="))


def absent_nodes(config: DictConfig, plugins: Plugins) -> dict[str, tuple[str, str]]:
    """Return (kind, name) of the components that no plugin provides, by dotted key."""
    values: Any = OmegaConf.to_container(config)
    named, options = component_names(values), {entry.name for entry in dataclasses.fields(TrainingOptions)}
    modules = [name for name, node in part(values, "training").items() if isinstance(node, dict)]
    named |= {f"training.{name}": ("module", name) for name in modules if name not in options}
    return {key: one for key, one in named.items() if one not in plugins.registry.components}


def component_names(values: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """Return (kind, name) of the components that a configuration names, by dotted key; modules are not named."""
    nodes = {kind: (kind, part(values, kind)) for kind in COMPONENT_KINDS if part(values, kind)}
    for kind in SEVERAL:
        nodes |= {f"{kind}.{name}": (kind, node) for name, node in part(values, kind).items() if isinstance(node, dict)}
    if upscaler := part(part(values, "eval"), "competitor"):
        nodes[COMPETITOR] = ("regenerator", upscaler)
    return {key: (kind, str(node.get("name", ""))) for key, (kind, node) in nodes.items()}


def settings_without(
    absent: dict[str, tuple[str, str]], config: DictConfig, plugins: Plugins, folder: Path, spare: Collection[str]
) -> Settings:
    """Return settings without absent nodes of spare kinds; `resolved` has them. Raise ConfigError for other nodes."""
    for key, (_, name) in absent.items():
        if key not in spare and key.partition(".")[0] not in spare:
            remedy = plugin_remedy(folder, plugins) + f", or leave it out by {COMPETITOR}=null" * (key == COMPETITOR)
            raise ConfigError(f"{key} is '{name}', which no plugin provides: {remedy}")
    if not absent:
        return settings_from(config, plugins)
    rest = config.copy()
    for group, _, name in (key.rpartition(".") for key in absent):
        OmegaConf.select(rest, group).pop(name)
    return dataclasses.replace(settings_from(rest, plugins), resolved=plain_values(config))


def plugin_remedy(folder: Path, plugins: Plugins) -> str:
    """Return which plugin to install for a run, by its environment.json and the plugins that failed to load."""
    environment = read_run(folder).environment
    names = part(environment, "distributions")
    others = {name: of for name, of in part(environment, "plugins").items() if plugins.versions.get(name) != of}
    failed = [f"{one.plugin} did not load ({one.reason})" for one in plugins.failures if one.plugin in others]
    if failed:
        return f"{', '.join(failed)}: correct that plugin"
    known = ", ".join(f"{names.get(name, name)} {version}" for name, version in others.items())
    return (
        f"install {known}, with which the run was trained" if known else "install the plugin that it was trained with"
    )


def saved_config(path: Path) -> DictConfig:
    """Read a configuration by today's names.

    Raises:
        ConfigError: it cannot be read, or has interpolations: gsx writes plain values, and a foreign file could read
            this machine's environment.
    """
    try:
        content = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    except Exception as error:
        raise ConfigError(f"{path} cannot be read ({first_line(error)}): give the folder of a gsx run") from error
    for key, text in texts(content):
        if "${" in text:
            raise ConfigError(f"{path}: {key} is '{text}'; a run's configuration holds plain values: write its value")
    if not isinstance(content, dict):
        raise ConfigError(f"{path} holds no configuration: give the folder of a gsx run")
    return OmegaConf.create(renamed(content))  # type: ignore[arg-type]


def newer_keys(config: DictConfig, plugins: Plugins) -> Iterator[str]:
    """Yield the dotted keys of today's schemas for a run's composition; an older run's file lacks some."""
    values: Any = OmegaConf.to_container(config)
    schemas: dict[str, type] = {"training": TrainingOptions, "eval": EvalOptions, "metrics.lpips": LpipsOptions}
    schemas |= {f"training.{name}": one.options for name, one in plugins.registry.of("module").items()}
    registered = plugins.registry.components
    components = {key: registered.get(named) for key, named in component_names(values).items()}
    schemas |= {key: component.options for key, component in components.items() if component}
    yield from schema_keys(GeneralOptions)
    yield COMPETITOR
    for key, schema in schemas.items():
        yield from (name for name in schema_keys(schema, f"{key}.") if not name.startswith(("eval.lpips", "eval.perc")))
    yield from ("metrics.perceptual", "metrics.perceptual_pixels")


def value_of(word: str) -> Any:
    """Parse a word of the command line as YAML."""
    return OmegaConf.select(OmegaConf.create(f"value: {word}"), "value")


def with_newer_settings(config: DictConfig) -> DictConfig:
    """Add the values by which older runs trained without a key for them.

    These are defaults of the rasterizer, any number of absent images, and strict checks of redrawn pictures. The gate
    of `clone_split` is removed for anchors, which do not have it.
    """
    if isinstance(config.get("rasterizer"), DictConfig):
        options = {key: v for key, v in dataclasses.asdict(RasterOptions()).items() if key not in OF_BACKBONES}
        config.rasterizer = OmegaConf.merge(options, config.rasterizer)
    if "downscale" in (config.get("scene") or {}) and "missing" not in config.scene:
        config.scene.missing = 1.0
    augmenters = config.get("augmenter")
    for node in augmenters.values() if isinstance(augmenters, DictConfig) else ():
        if isinstance(node, DictConfig) and {"scales", "weight_map"} <= node.keys() and "checks" not in node:
            node.checks = strict_node()
    density = OmegaConf.select(config, "backbone.clone_split.level_density")
    if isinstance(density, DictConfig) and config.backbone.get("densification") != "clone_split":
        density.pop("gate", None)
    return config
