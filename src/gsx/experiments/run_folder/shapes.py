"""Shapes of the JSON files in a run folder: a file that does not fit its shape counts as damaged."""

from pathlib import Path
from typing import Any, TypeAlias, TypeGuard

LARGEST = 1e100
"""Larger numbers do not occur in runs and are not safe to compute with."""


def is_number(value: Any) -> TypeGuard[float]:
    """Recognise a finite number of a size that occurs in runs."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST <= value <= LARGEST


def is_length(value: Any) -> bool:
    """Recognise a number above 0."""
    return is_number(value) and value > 0


def is_number_or_null(value: Any) -> bool:
    """Recognise a number or null."""
    return value is None or is_number(value)


def is_decimal(word: str) -> bool:
    """Recognise a key of JSON that spells a number."""
    try:
        return is_number(float(word))
    except ValueError:
        return False


def is_file_name(name: Any) -> bool:
    """Recognise a text that can name a file."""
    return isinstance(name, str) and Path(name).name not in ("", "..")


Shape: TypeAlias = Any
"""A type, a predicate, [shape of all entries], (shape of each entry), or {key: shape of its value}.

"key?" may be missing; a type or predicate as key stands for all keys.
"""
SIZE: Shape = (is_length, is_length)
PICTURES: Shape = {str: is_file_name}
SHARES: Shape = {str: is_number}
COUNTS: Shape = {is_decimal: is_number}
PSEUDO: Shape = {"asked": COUNTS, "dropped": COUNTS, "warned": {str: COUNTS}}
LINE: Shape = {
    "step": is_number,
    "memory_mb?": is_number_or_null,
    "withheld?": is_number_or_null,
    "test_psnr?": is_number_or_null,
    "pseudo?": {str: PSEUDO},
}
"""A line of metrics.jsonl, as far as a resumed run reads it."""
EVALUATION: Shape = {
    "step?": is_number_or_null,
    "views?": [{"name?": str}],
    "zoom?": {is_decimal: dict},
    "groups?": {str: dict},
    "protocol?": {"size?": SIZE, "scene?": dict, "test_views?": list},
    "withheld?": {"step": is_number},
    "pseudo?": {str: {"dropped": SHARES, "warned?": {str: SHARES}}},
    "left_out?": is_number_or_null,
    "perceptual?": {str: is_number_or_null},
    "remarks?": [str],
    "depth?": {"absolute": is_number, "relative": is_number, "within": is_number},
    "coverage?": {
        "unavailable?": str,
        "least_views?": is_number,
        "share?": is_number_or_null,
        "classes?": {str: {"from": is_number, "views": is_number, "psnr": is_number_or_null}},
        "training?": {"share": is_number_or_null, "classes": {str: is_number}},
    },
}
ENVIRONMENT: Shape = {"scene?": {"notes?": list}, "history?": [{"changed?": {str: (object, object)}}]}
DRAWN: Shape = {
    "views?": [{"size": SIZE, "files?": PICTURES, "depth?": (is_number, is_number)}],
    "zoom?": [{"factor": is_number, "window": (is_number, is_number, *SIZE), "files?": PICTURES}],
    "flight?": {"file": is_file_name, "size": SIZE, "frames": is_number},
}
PSEUDO_VIEWS: Shape = {"views?": [dict]}
PHOTOGRAPHS: Shape = {"step?": is_number_or_null, "views": [{"name": str, "remarks": list, "files?": PICTURES}]}
RETAKES: Shape = {
    "step?": is_number_or_null,
    "facts": str,
    "gaps": str,
    "places": [{"view": str, "words": str, "reason": str, "files": PICTURES}],
    "photos": [{"name": str, "remarks": [str], "files?": PICTURES}],
    "unplaced": [{"name": str, "where": str, "files?": PICTURES}],
}
STATUS: Shape = {"step?": is_number_or_null}
COMPACT: Shape = {"from": str}


def fits(value: Any, shape: Shape) -> bool:
    """Check a value of JSON against a shape."""
    if isinstance(shape, type):
        return isinstance(value, shape)
    if isinstance(shape, list):
        return isinstance(value, list) and all(fits(entry, shape[0]) for entry in value)
    if isinstance(shape, tuple):
        return isinstance(value, list) and len(value) == len(shape) and all(map(fits, value, shape))
    if isinstance(shape, dict):
        return isinstance(value, dict) and all(key_fits(value, key, inner) for key, inner in shape.items())
    return bool(shape(value))


def key_fits(content: dict[str, Any], key: Shape, shape: Shape) -> bool:
    """Check what a mapping has under a key of a shape."""
    if not isinstance(key, str):
        return all(fits(name, key) and fits(inner, shape) for name, inner in content.items())
    name = key.removesuffix("?")
    return fits(content[name], shape) if name in content else key.endswith("?")
