"""Plain values checked against dataclasses of options; errors name the nearest match. No Hydra here."""

import copy
import dataclasses
import math
import re
import types
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsx.core.errors import ConfigError, first_line, nearest
from gsx.core.ranges import Range, beyond_range, parts_of
from gsx.experiments.run_folder.renamed import advice

KINDS = {int: "whole number", float: "number", str: "text", bool: "true or false", Path: "path"}
EXAMPLES = (10, 1, 2, 0)
"""Numbers for examples; the first in the range of an option."""


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
    if problem := wrong_type(schema, path, inner, values):
        return problem
    if text.startswith("Cannot assign") and " to Dict[" in text:
        return f"{key} is a group of settings, not a value: give {key}.NAME=VALUE"
    if (group := re.search(r"is not a subclass of (\w+)", text)) is not None:
        key = ".".join([part for part in (path, key_of_type(schema, group[1], values)) if part]) or key
        return f"{key} is a group of settings, not a value: give {key}.NAME=VALUE"
    return f"{key}: {text}"


def wrong_type(schema: type, path: str, inner: str, values: dict[str, Any]) -> str:
    """Return an error for a value of another type than its field's; empty: that is no plain type, or not the reason."""
    name = re.sub(r"\[\d+\]", "", inner)
    value, hint = value_at(name, values), hint_at(schema, name.split("."))
    kind, example = kind_in(schema, name.split(".")), example_of(hint)
    if not kind or value is dataclasses.MISSING:
        return ""
    key = ".".join(part for part in (path, name) if part)
    article = "" if kind.startswith(("text", "true")) else "a "
    word = f"{key}={example}"
    such = f", such as {repr(word) if '[' in word else word}" if example else ""
    return f"{key} is {'null' if value is None else repr(value)}; give {article}{kind}{such}"


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


def value_at(key: str, node: Any) -> Any:
    """Return the value of a dotted key; dataclasses.MISSING: there is none."""
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            return dataclasses.MISSING
        node = node[part]
    return node


def hint_at(schema: type, parts: Sequence[str]) -> Any:
    """Return the type of a field of a dataclass, with its range; None: there is no such field."""
    hint = get_type_hints(schema, include_extras=True).get(parts[0])
    if len(parts) == 1 or hint is None:
        return hint
    kinds = list(parts_of(hint))
    inner = next((part for part in kinds if isinstance(part, type) and dataclasses.is_dataclass(part)), None)
    return hint_at(inner, parts[1:]) if inner else next((kind for kind in (float, int, str) if kind in kinds), None)


def bounds_of(hint: Any) -> Range | None:
    """Return the range of a type's numbers."""
    return next((part for part in parts_of(hint) if isinstance(part, Range)), None)


def kind_in(schema: type, parts: Sequence[str]) -> str:
    """Return type and range of a field of a dataclass in words; empty: there is no such field, or no plain type."""
    hint = hint_at(schema, parts)
    bounds = bounds_of(hint)
    return f"{in_words(hint)}{f' {bounds}' if bounds else ''}"


def example_of(hint: Any) -> str:
    """Return a value for a number or a list; empty for other types."""
    kinds, bounds = list(parts_of(hint)), bounds_of(hint)
    several, numbers = any(get_origin(kind) is list for kind in kinds), int in kinds or float in kinds
    fitting = [number for number in EXAMPLES if bounds is None or number in bounds]
    if several:
        return f"[{','.join(map(str, [number for number in fitting if 0 < number < 10]))}]" if numbers else "[A,B]"
    return f"{fitting[0]}" if numbers and fitting else ""


def in_words(hint: Any) -> str:
    """Return a type in words; empty for others than plain types, their unions and lists."""
    origin, inner = get_origin(hint), list(get_args(hint))
    if origin in (Union, types.UnionType):
        words = [in_words(part) for part in inner if part is not type(None)]
        return " or ".join([*filter(None, words), *(["null"] if type(None) in inner else [])])
    if origin in (list, tuple):
        return f"list of {in_words(inner[0])}s"
    if hasattr(hint, "__metadata__"):
        return in_words(inner[0])
    return KINDS.get(hint, "")
