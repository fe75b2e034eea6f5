"""Plain values checked against dataclasses of options; errors name the nearest match. No Hydra here."""

import copy
import dataclasses
import math
import re
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsx.core.errors import ConfigError, first_line, nearest
from gsx.core.ranges import beyond_range
from gsx.experiments.run_folder.renamed import advice


@dataclasses.dataclass(frozen=True)
class Values:
    """Plain values, compared by their text: 1, 1.0 and true differ."""

    plain: Any = dataclasses.field(compare=False)
    text: str


def typed(schema: type, values: Any, path: str) -> Any:
    """Return an instance of a dataclass from the plain values at a dotted key.

    Raises:
        ConfigError: an unknown key or a value of the wrong type; value, key and remedy are named.
    """
    return copy.deepcopy(checked(schema, Values(values, repr(values)), path))


@lru_cache(maxsize=512)
def checked(schema: type, content: Values, path: str) -> Any:
    """Return the same, cached: most nodes of many compositions are equal."""
    values = content.plain
    refuse_not_finite(values, path)
    try:
        named = values if isinstance(values, dict) else {}
        merged = OmegaConf.merge(writable(OmegaConf.structured(schema), named), OmegaConf.create(values or {}))
        plain: Any = OmegaConf.to_container(merged)
        for key, value, bounds in beyond_range(schema, plain):
            raise ConfigError(f"{f'{path}.{key}'.lstrip('.')} is {value}; give a number {bounds}")
        return OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise ConfigError(complaint(error, schema, path, named)) from error
    except ValueError as error:  # a dataclass refused the combination
        raise ConfigError(str(error)) from error


def refuse_not_finite(value: Any, path: str) -> None:
    """Raise ConfigError for an infinite number or NaN anywhere below a key: NaN passes every comparison."""
    if isinstance(value, dict):
        for key, inner in value.items():
            refuse_not_finite(inner, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for inner in value:
            refuse_not_finite(inner, path)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{path} is {value}; give a finite number")


def writable(node: DictConfig, values: dict[str, Any]) -> DictConfig:
    """Unlock the nodes of frozen dataclasses for OmegaConf to merge into; `values`: to be merged."""
    OmegaConf.set_readonly(node, False)
    for key in node:
        child = node._get_node(key)
        if isinstance(child, DictConfig):
            inner = values.get(str(key))
            absent = child._is_missing() or (child._is_none() and isinstance(inner, dict))
            if absent and dataclasses.is_dataclass(child._metadata.ref_type):
                child._set_value(child._metadata.ref_type)  # creates the fields to unlock
            if not child._is_none():
                writable(child, inner if isinstance(inner, dict) else {})
    return node


def complaint(error: OmegaConfBaseException, schema: type, path: str, values: dict[str, Any]) -> str:
    """Return an error of OmegaConf for values as one sentence with the key."""
    inner = str(error.full_key or "")
    key, text = ".".join(part for part in (path, inner) if part), first_line(error)
    if type(error).__name__ == "ConfigKeyError":
        return unknown_key(key, [f"{path}.{k}".lstrip(".") for k in schema_keys(schema)])
    if "is not a ListConfig" in text:
        return f"{key} takes a list: give {key}=[...], with commas between its values"
    if (group := re.search(r"is not a subclass of (\w+)", text)) is not None:
        key = ".".join([part for part in (path, key_of_type(schema, group[1], values)) if part]) or key
        return f"{key} is a group of settings, not a value: give {key}.NAME=VALUE"
    return f"{key}: {text}"


def key_of_type(schema: type, name: str, values: Any, prefix: str = "") -> str:
    """Return the dotted name of the field for a dataclass of that name that has another value; empty: there is none."""
    for entry in dataclasses.fields(schema):
        if not dataclasses.is_dataclass(entry.type) or not isinstance(values, dict) or entry.name not in values:
            continue
        key, value = f"{prefix}{entry.name}", values[entry.name]
        if entry.type.__name__ == name and not isinstance(value, dict):  # type: ignore[union-attr]
            return key
        if found := key_of_type(entry.type, name, value, f"{key}."):  # type: ignore[arg-type]
            return found
    return ""


def unknown_key(
    key: str, known: Iterable[str], where: str = "", remedy: str = " `gsx --cfg job` lists all keys."
) -> str:
    """Return an error that names the key's new name, else the nearest key, else `remedy`."""
    return f"Unknown key '{key}'{where}.{advice(key) or nearest(key, known) or remedy}"


def schema_keys(schema: type, prefix: str = "") -> Iterator[str]:
    """Yield dotted field names of a dataclass and of those inside it, with keys of mappings by default."""
    for entry in dataclasses.fields(schema):
        yield f"{prefix}{entry.name}"
        made = entry.default_factory() if entry.default_factory is not dataclasses.MISSING else None
        yield from (f"{prefix}{entry.name}.{key}" for key in (made if isinstance(made, dict) else ()))
        if dataclasses.is_dataclass(entry.type):
            yield from schema_keys(entry.type, f"{prefix}{entry.name}.")  # type: ignore[arg-type]


def dotted(node: Any, prefix: str = "") -> Iterator[str]:
    """Yield dotted paths of all keys, inner nodes included."""
    for key, value in node.items() if isinstance(node, dict) else ():
        yield f"{prefix}{key}"
        yield from dotted(value, f"{prefix}{key}.")


def texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield (key, text) of all texts inside nested mappings and lists."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, one in inner:
        yield from texts(one, f"{key}.{name}".lstrip("."))
    if isinstance(value, str):
        yield key, value
