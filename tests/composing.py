"""Compositions of tests: choices of groups are composed once per process, values are set as Hydra sets them."""

import pickle
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import hydra
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from gsx.experiments.runs.config_files import GsxSearchPath

compose: Callable[..., DictConfig] = hydra.compose


@cache
def chosen(choices: tuple[str, ...]) -> bytes:
    """Return a pickled composition of gsx's own files."""
    return pickle.dumps(compose("config", overrides=list(choices)))


def composed_once(config_name: str, overrides: Sequence[str], **more: Any) -> DictConfig:
    """`hydra.compose`; with files of plugins, sweeps or settings of Hydra nothing is reused."""
    parsed, loader = OverridesParser.create().parse_overrides(list(overrides)), GlobalHydra.instance().config_loader()
    hydras = any(one.key_or_group.startswith("hydra") or one.is_sweep_override() for one in parsed)
    if hydras or more or GsxSearchPath.extra:
        return compose(config_name, overrides=list(overrides), **more)
    groups = [loader.repository.group_exists(one.key_or_group) for one in parsed]
    config = pickle.loads(chosen(tuple(word for word, group in zip(overrides, groups, strict=True) if group)))
    values = [one for one, group in zip(parsed, groups, strict=True) if not group]
    ConfigLoaderImpl._apply_overrides_to_config(values, config)
    return config
