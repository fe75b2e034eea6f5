"""Ranges of numeric options, checked before a run creates its folder: `steps: Annotated[int, Range(1, 100)]`.

In lists, the range holds for every number.
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, get_args, get_type_hints


@dataclass(frozen=True)
class Range:
    """Closed interval of numbers."""

    least: float
    most: float

    def __contains__(self, value: float) -> bool:
        return self.least <= value <= self.most

    def __str__(self) -> str:
        least, most = (int(bound) if float(bound).is_integer() else bound for bound in (self.least, self.most))
        return f"from {least:,} to {most:,}"  # alike for 10**6 and 1e6, which are equal: typing keeps one for both


MOST_STEPS = 10**9
LARGEST_SEED = 2**63 - 1

Share = Annotated[float, Range(0, 1)]
Rate = Annotated[float, Range(0, 1)]
"""Learning rates."""
Steps = Annotated[int, Range(0, MOST_STEPS)]
Interval = Annotated[int, Range(1, MOST_STEPS)]
"""Number of steps between two events, or until an end."""
Count = Annotated[int, Range(0, 10**9)]
Points = Annotated[int, Range(1, 10**8)]
"""Number of points for a scene without any."""
Weight = Annotated[float, Range(0, 1000)]
"""Weight of a term of the loss."""
Gradient = Annotated[float, Range(0, 10**12)]
"""Gradient of the loss by screen positions, NDC; thresholds of density control."""
Length = Annotated[float, Range(1e-9, 10**9)]
"""World units."""
Seconds = Annotated[float, Range(0, 10**9)]
Gigabytes = Annotated[float, Range(0, 10**6)]
"""10^9 bytes."""
Seed = Annotated[int, Range(0, LARGEST_SEED)]
ZOOMS = Range(1 / 64, 64)
"""Factors of a resolution."""


def beyond_range(options: type, values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any, Range]]:
    """Yields (dotted key, value, range) of the numbers outside their range."""
    for name, (kinds, bounds) in field_ranges(options).items():
        value, key = values.get(name), f"{prefix}{name}"
        if isinstance(value, Mapping):
            for inner in kinds:
                yield from beyond_range(inner, value, f"{key}.")
        named = {f"{key}.{inner}": one for inner, one in value.items()} if isinstance(value, Mapping) else {key: value}
        for entry, one in named.items():
            if bounds is not None and not all(number in bounds for number in numbers_in(one)):
                yield entry, one, bounds


def numbers_in(value: Any) -> list[float]:
    """Returns a number, or those of a list, as a list."""
    several = value if isinstance(value, list | tuple) else [value]
    return [number for number in several if isinstance(number, int | float)]


@functools.cache
def field_ranges(options: type) -> dict[str, tuple[list[type], Range | None]]:
    """Returns, by field of a dataclass, its nested dataclasses and the range of its numbers."""
    found = {}
    for name, hint in get_type_hints(options, include_extras=True).items():
        inner = list(parts_of(hint))
        kinds = [part for part in inner if isinstance(part, type) and is_dataclass(part)]
        found[name] = kinds, next((part for part in inner if isinstance(part, Range)), None)
    return found


def parts_of(hint: Any) -> Iterator[Any]:
    """Yields a type, its arguments recursively, and their annotations."""
    yield hint
    for inner in (*get_args(hint), *getattr(hint, "__metadata__", ())):
        yield from parts_of(inner)
