"""What numbers an option may be: stated beside its type, checked before a run has a folder.

`steps: Annotated[int, Range(1, 100)]` in a dataclass of options, or one of the names below; of lists every number is
meant. The ends are where a value stops having a meaning or a run its memory; they belong to the range.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, get_args, get_type_hints


@dataclass(frozen=True)
class Range:
    """Numbers from `least` to `most`."""

    least: float
    most: float

    def __contains__(self, value: float) -> bool:
        return self.least <= value <= self.most

    def __str__(self) -> str:
        return f"from {self.least:,} to {self.most:,}"


MOST_STEPS = 10**9
LARGEST_SEED = 2**63 - 1

Share = Annotated[float, Range(0, 1)]
Rate = Annotated[float, Range(0, 1)]
"""Learning rates."""
Steps = Annotated[int, Range(0, MOST_STEPS)]
Interval = Annotated[int, Range(1, MOST_STEPS)]
"""Steps between two of something, or until its end."""
Count = Annotated[int, Range(0, 10**9)]
Points = Annotated[int, Range(1, 10**8)]
"""Of a scene without any."""
Weight = Annotated[float, Range(0, 1000)]
"""Of a term of the loss."""
Gradient = Annotated[float, Range(0, 10**12)]
"""Of the loss by screen positions, NDC: thresholds of density control."""
Length = Annotated[float, Range(1e-9, 10**9)]
"""World units."""
Seconds = Annotated[float, Range(0, 10**9)]
Gigabytes = Annotated[float, Range(0, 10**6)]
"""10^9 bytes."""
Seed = Annotated[int, Range(0, LARGEST_SEED)]
ZOOMS = Range(1 / 64, 64)
"""Times a resolution."""


def beyond_range(options: type, values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any, Range]]:
    """(dotted key, value, its range) of the numbers for a dataclass of options that are outside of theirs."""
    for name, (kinds, bounds) in stated(options).items():
        value, key = values.get(name), f"{prefix}{name}"
        if isinstance(value, Mapping):
            for inner in kinds:
                yield from beyond_range(inner, value, f"{key}.")
        for own, one in by_key(key, value).items():
            if bounds is not None and not all(number in bounds for number in numbers_in(one)):
                yield own, one, bounds


def by_key(key: str, value: Any) -> dict[str, Any]:
    """A value by its dotted key, those of a mapping by theirs."""
    return {f"{key}.{inner}": one for inner, one in value.items()} if isinstance(value, Mapping) else {key: value}


def numbers_in(value: Any) -> list[float]:
    """A number, or those of a list; none where there is no value yet."""
    several = value if isinstance(value, list | tuple) else [value]
    return [number for number in several if isinstance(number, int | float)]


def without_range(options: type, prefix: str = "") -> Iterator[str]:
    """Dotted keys of the fields of a dataclass that hold numbers of which no range is stated."""
    hints = get_type_hints(options, include_extras=True)
    for name, (kinds, bounds) in stated(options).items():
        for inner in kinds:
            yield from without_range(inner, f"{prefix}{name}.")
        if bounds is None and any(part in (int, float) for part in parts_of(hints[name])):
            yield f"{prefix}{name}"


def stated(options: type) -> dict[str, tuple[list[type], Range | None]]:
    """By field of a dataclass: the dataclasses that it may hold, and the range of its numbers."""
    found = {}
    for name, hint in get_type_hints(options, include_extras=True).items():
        inner = list(parts_of(hint))
        kinds = [part for part in inner if isinstance(part, type) and is_dataclass(part)]
        found[name] = kinds, next((part for part in inner if isinstance(part, Range)), None)
    return found


def parts_of(hint: Any) -> Iterator[Any]:
    """A type, its arguments, theirs, and what is noted beside them."""
    yield hint
    for inner in (*get_args(hint), *getattr(hint, "__metadata__", ())):
        yield from parts_of(inner)
