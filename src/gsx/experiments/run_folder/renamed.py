"""Configuration keys that were renamed, moved or removed: run folders hold the old ones, and users type them."""

import copy
from collections.abc import Mapping
from dataclasses import MISSING
from typing import Any

from gsx.core.options import flattened

MOVED = {
    "training.coarse": "training.coarse_to_fine.factor",
    "training.coarse_until": "training.coarse_to_fine.until",
    "training.supersample": "training.supersampling.factor",
    "training.supersample_from": "training.supersampling.start",
}
"""New dotted keys by old ones; digests of compositions still use the old ones (`run_key`)."""
RENAMED = MOVED | {
    "trunk_at": "warm_start_at",
    "backbone.rates.sh_constant": "backbone.rates.sh_dc",
    "backbone.clone_split.rates.sh_constant": "backbone.clone_split.rates.sh_dc",
}
"""New dotted keys by old ones."""
REMOVED: dict[str, Any] = {
    "trunk_gb": None,
    "training.cuda_graphs": None,
    "rasterizer.exponent": "squares",
}
"""Keys without a successor, each with the value that gsx still trains by; None: the key changed no result."""


def renamed(config: dict[str, Any]) -> dict[str, Any]:
    """Return a copy with today's keys; a removed key stays if its value is not what gsx trains by."""
    config, values = copy.deepcopy(config), flattened(config)
    for key, value in REMOVED.items():
        if value is None or values.get(key, MISSING) == value:
            take(config, key)
    return moved(config, RENAMED)


def moved(config: dict[str, Any], places: Mapping[str, str]) -> dict[str, Any]:
    """Return a copy with values moved to other dotted keys; `places`: new by old."""
    config = copy.deepcopy(config)
    for old, new in places.items():
        if (value := take(config, old)) is not MISSING:
            put(config, new, value)
    return config


def take(config: dict[str, Any], key: str) -> Any:
    """Remove a dotted key and the mappings that it leaves empty; return its value or MISSING."""
    name, _, inner = key.partition(".")
    if not inner or not isinstance(config.get(name), dict):
        return MISSING if inner else config.pop(name, MISSING)
    value = take(config[name], inner)
    if value is not MISSING and not config[name]:
        del config[name]
    return value


def put(config: dict[str, Any], key: str, value: Any) -> None:
    """Set the value of a dotted key; make the mappings around it."""
    *outer, last = key.split(".")
    for name in outer:
        config = config.setdefault(name, {})
    config[last] = value


def advice(key: str) -> str:
    """Return a remedy for a key of older versions: ` It is now called 'x'.`; empty for other keys."""
    if key in RENAMED:
        return f" It is now called '{RENAMED[key]}'."
    return " It has been removed: leave it out." if key in REMOVED else ""
