"""Keys of configurations that were once called otherwise: run folders hold the old names, people type them."""

import copy
from typing import Any

RENAMED = {
    "trunk_at": "warm_start_at",
    "trunk_gb": "disk_cache_gb",
    "warm_start_gb": "disk_cache_gb",
    "backbone.rates.sh_constant": "backbone.rates.sh_dc",
    "backbone.clone_split.rates.sh_constant": "backbone.clone_split.rates.sh_dc",
}
"""New dotted names by old ones, in the same place."""


def renamed(config: dict[str, Any]) -> dict[str, Any]:
    """A copy with the new names, in the same order; `init: trunk` is `init: warm_start`.

    A budget of states alone is dropped: it would be that of the whole cache.
    """
    config = copy.deepcopy(config)
    for key in ("trunk_gb", "warm_start_gb"):
        config.pop(key, None)
    say_what_is_cached(config.get("regenerator"))
    if config.get("init") == "trunk":
        config["init"] = "warm_start"
    for old, new in RENAMED.items():
        *outer, key = old.split(".")
        node: Any = config
        for name in outer:
            node = node.get(name) if isinstance(node, dict) else None
        if isinstance(node, dict) and key in node:
            items = [(new.rpartition(".")[2] if name == key else name, value) for name, value in node.items()]
            node.clear()
            node.update(items)
    return config


def say_what_is_cached(node: Any) -> None:
    """In options of diffusion models, which other options lie around: a size of the cache once said whether to keep."""
    if not isinstance(node, dict):
        return
    if {"offload", "batch_pixels", "cache_gb"} <= node.keys() and "cached" not in node:
        node["cached"] = node.pop("cache_gb") != 0
    for inner in node.values():
        say_what_is_cached(inner)
