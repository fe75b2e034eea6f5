"""What options say of themselves beside their values: whether they have any effect on results. Dotted keys.

A run is named by what it trains. Fields made by `without_effect` and `label` do not count for that name, in options of
plugins just as in those of gsx itself.
"""

from collections.abc import Mapping
from dataclasses import field, fields, is_dataclass
from typing import Any, get_args, get_type_hints

EFFECT = "effect"


def without_effect(**default: Any) -> Any:
    """A field that changes no result: where something lies, with which means it is computed, how often it is told."""
    return field(metadata={EFFECT: "none"}, **default)


def label(**default: Any) -> Any:
    """A field that only names what other fields hold."""
    return field(metadata={EFFECT: "label"}, **default)


def fields_with(effect: str, options: type, prefix: str = "") -> frozenset[str]:
    """Dotted names of the fields of a dataclass, and of those inside it, that say this of their effect."""
    found = {f"{prefix}{entry.name}" for entry in fields(options) if entry.metadata.get(EFFECT) == effect}
    for name, hint in get_type_hints(options).items():
        for kind in (hint, *get_args(hint)):
            if isinstance(kind, type) and is_dataclass(kind):
                found |= fields_with(effect, kind, f"{prefix}{name}.")
    return frozenset(found)


def flattened(node: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values of a nested configuration by dotted key."""
    out: dict[str, Any] = {}
    for key, value in node.items():
        out |= flattened(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return out
