"""Shapes of the JSON files of a run folder: a file that does not fit counts as damaged."""

from pathlib import Path
from typing import Any, TypeAlias, TypeGuard

LARGEST = 1e100
"""Larger numbers occur in no run and are not safe to compute with."""


def is_number(value: Any) -> TypeGuard[float]:
    """Recognises a finite number of a size that occurs in runs."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST <= value <= LARGEST


def is_count(value: Any) -> bool:
    """Recognises a number or null."""
    return value is None or is_number(value)


def is_text(value: Any) -> bool:
    """Recognises a text."""
    return isinstance(value, str)


def is_list(value: Any) -> bool:
    """Recognises a list of anything."""
    return isinstance(value, list)


def is_pair(value: Any) -> bool:
    """Recognises a list of two values."""
    return isinstance(value, list) and len(value) == 2


def is_range(value: Any) -> bool:
    """Recognises a list of two numbers."""
    return is_pair(value) and all(map(is_number, value))


def is_size(value: Any) -> bool:
    """Recognises a width and a height above 0."""
    return is_range(value) and min(value) > 0


def is_window(value: Any) -> bool:
    """Recognises the left, top, width and height of a window; the last two are above 0."""
    return isinstance(value, list) and len(value) == 4 and all(map(is_number, value)) and min(value[2:]) > 0


def is_decimal(word: str) -> bool:
    """Recognises a key of JSON that spells a number."""
    try:
        return is_number(float(word))
    except ValueError:
        return False


def is_file_name(name: Any) -> bool:
    """Recognises a text that can name a file."""
    return isinstance(name, str) and Path(name).name not in ("", "..")


Shape: TypeAlias = dict[Any, Any]

PICTURES: Shape = {is_text: is_file_name}
SHARES: Shape = {is_text: is_number}
COUNTS: Shape = {is_decimal: is_number}
PSEUDO: Shape = {"asked": COUNTS, "dropped": COUNTS, "warned": {is_text: COUNTS}}
LINE: Shape = {
    "step": is_number,
    "memory_mb?": is_count,
    "withheld?": is_count,
    "test_psnr?": is_count,
    "pseudo?": {is_text: PSEUDO},
}
"""A line of metrics.jsonl, as far as a run that goes on reads it again."""
EVALUATION: Shape = {
    "step?": is_count,
    "views?": [{"name?": is_text}],
    "zoom?": {is_decimal: {}},
    "groups?": {is_text: {}},
    "protocol?": {"size?": is_size, "scene?": {}, "test_views?": is_list},
    "withheld?": {"step": is_number},
    "pseudo?": {is_text: {"dropped": SHARES, "warned?": {is_text: SHARES}}},
    "left_out?": is_count,
    "remarks?": [is_text],
}
ENVIRONMENT: Shape = {"scene?": {"notes?": is_list}, "history?": [{"changed?": {is_text: is_pair}}]}
DRAWN: Shape = {
    "views?": [{"size": is_size, "files?": PICTURES, "depth?": is_range}],
    "zoom?": [{"factor": is_number, "window": is_window, "files?": PICTURES}],
    "flight?": {"file": is_file_name, "size": is_size, "frames": is_number},
}
PSEUDO_VIEWS: Shape = {"views?": [{}]}
PHOTOGRAPHS: Shape = {"step?": is_count, "views": [{"name": is_text, "remarks": is_list, "files?": PICTURES}]}
STATUS: Shape = {"step?": is_count}
COMPACT: Shape = {"from": is_text}


def fits(value: Any, shape: Any) -> bool:
    """Checks a value of JSON against a shape.

    A shape is a predicate, [shape of all entries], or {key: shape}: "key?" may be missing, a predicate stands for all.
    """
    if isinstance(shape, list):
        return isinstance(value, list) and all(fits(entry, shape[0]) for entry in value)
    if isinstance(shape, dict):
        return isinstance(value, dict) and all(key_fits(value, key, inner) for key, inner in shape.items())
    return bool(shape(value))


def key_fits(content: dict[str, Any], key: Any, shape: Any) -> bool:
    """Checks what a mapping has under a key of a shape."""
    if callable(key):
        return all(key(name) and fits(inner, shape) for name, inner in content.items())
    name = key.removesuffix("?")
    return fits(content[name], shape) if name in content else key.endswith("?")
