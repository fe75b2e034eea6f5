"""Differences between compositions and the paper's protocol."""

from collections.abc import Iterator, Sequence
from typing import Any

from gsx.experiments.run_folder.files import part
from gsx.experiments.run_folder.run_key import NAMES, WHERE, comparable, used_regenerators, without

PLACES = ("model", "revision", "variant", "dtype", "tiling")
"""Keys of regenerators that say where a model comes from and how it fits into memory."""
LISTED_KEYS = 12
"""Differences from the paper's protocol that are listed."""


def protocol_differences(compared: Sequence[tuple[dict[str, Any], dict[str, Any], frozenset[str]]]) -> list[str]:
    """Lists the keys in which compositions differ, with both values, those of most rows first.

    `compared`: (as run, as published, keys without effect) of each row.
    """
    found: dict[str, list[tuple[str, str]]] = {}
    for own, paper, idle in compared:
        for key, value, published in differing(own, paper, idle):
            found.setdefault(key, []).append((value, published))
    lines = []
    for key in sorted(found, key=lambda key: -len(found[key])):
        ours, theirs = (", ".join(dict.fromkeys(values)) for values in zip(*found[key], strict=True))
        lines.append(f"{key}={ours} (paper: {theirs})")
    more = [f"and {len(lines) - LISTED_KEYS} more"] if len(lines) > LISTED_KEYS else []
    return lines[:LISTED_KEYS] + more


def differing(own: dict[str, Any], paper: dict[str, Any], idle: frozenset[str]) -> Iterator[tuple[str, str, str]]:
    """Yields keys whose values differ, with ours and the paper's; of another component only its name."""
    mine, theirs = (comparable(protocol_settings(config, idle)) for config in (own, paper))
    others = {key.removesuffix(".name") for key in mine if key.endswith(".name") and mine[key] != theirs.get(key)}
    for key in dict.fromkeys([*mine, *theirs]):
        inside = any(key.startswith(f"{other}.") and key != f"{other}.name" for other in others)
        if mine.get(key) != theirs.get(key) and not inside:
            yield key, str(mine.get(key, "absent")), str(theirs.get(key, "absent"))


def protocol_settings(config: dict[str, Any], idle: frozenset[str]) -> dict[str, Any]:
    """Returns the protocol of a composition: all but where it runs, its seed and its zooms."""
    known = without(config, idle)
    kept = {key: value for key, value in known.items() if key not in (*WHERE, *NAMES, "seed")}
    kept["dataset"] = part(known, "dataset").get("title")
    kept["eval"] = without(part(known, "eval"), ("zoom", "tile_pixels"))
    kept["metrics"] = {key: part(part(known, "metrics"), "lpips").get(key) for key in ("net", "input_range")}
    return kept | {"regenerator": placeless(used_regenerators(known))}


def placeless(node: Any) -> Any:
    """Removes from regenerators where their models come from and how they fit into memory."""
    if not isinstance(node, dict):
        return node
    return {key: placeless(value) for key, value in node.items() if key not in PLACES}
