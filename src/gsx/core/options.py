"""What options say of themselves beside their values: whether they have any effect on results.

A run is named by what it trains. Fields made by `without_effect` and `label` do not count for that name, in options of
plugins just as in those of gsx itself.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, get_args

EFFECT = "effect"


def without_effect(**default: Any) -> Any:
    """A field that changes no result: where something lies, with which means it is computed, how often it is told."""
    return field(metadata={EFFECT: "none"}, **default)


def label(**default: Any) -> Any:
    """A field that only names what other fields hold."""
    return field(metadata={EFFECT: "label"}, **default)


def fields_with(effect: str, options: type) -> frozenset[str]:
    """Names of the fields of a dataclass, and of those inside it, that say this of their effect."""
    names = {entry.name for entry in fields(options) if entry.metadata.get(EFFECT) == effect}
    kinds = [kind for entry in fields(options) for kind in (entry.type, *get_args(entry.type))]
    inner = [kind for kind in kinds if isinstance(kind, type) and is_dataclass(kind)]
    return frozenset(names).union(*(fields_with(effect, kind) for kind in inner))


@dataclass(frozen=True, kw_only=True)
class IdleKeys:
    """Keys of a composition that change nothing of what is trained."""

    scene: frozenset[str] = frozenset()
    regenerator: frozenset[str] = frozenset()
    training: frozenset[str] = frozenset()


def idle_keys(scene: type, regenerators: Iterable[type], training: type) -> IdleKeys:
    """As the options of the components say."""
    return IdleKeys(
        scene=fields_with("none", scene),
        regenerator=frozenset().union(*(fields_with("none", options) for options in regenerators)),
        training=fields_with("none", training),
    )
