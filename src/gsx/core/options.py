"""Metadata of option fields; `without_effect` and `label` keep a field out of the hash in a run's name."""

from collections.abc import Mapping
from dataclasses import field, fields, is_dataclass
from typing import Any, get_args, get_type_hints

EFFECT = "effect"


def without_effect(**default: Any) -> Any:
    """Returns a field that changes no result: a path, a memory limit, a logging interval."""
    return field(metadata={EFFECT: "none"}, **default)


def label(**default: Any) -> Any:
    """Returns a field that only names the content of other fields."""
    return field(metadata={EFFECT: "label"}, **default)


def fields_with(effect: str, options: type, prefix: str = "") -> frozenset[str]:
    """Returns the dotted names of all fields, also nested ones, with this effect."""
    found = {f"{prefix}{entry.name}" for entry in fields(options) if entry.metadata.get(EFFECT) == effect}
    for name, hint in get_type_hints(options).items():
        for kind in (hint, *get_args(hint)):
            if isinstance(kind, type) and is_dataclass(kind):
                found |= fields_with(effect, kind, f"{prefix}{name}.")
    return frozenset(found)


def flattened(node: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns the values of a nested configuration by dotted key."""
    out: dict[str, Any] = {}
    for key, value in node.items():
        out |= flattened(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return out
