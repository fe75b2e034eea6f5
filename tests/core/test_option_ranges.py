"""Every number that an option holds has a range, and beyond it is refused by name."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, get_type_hints

import pytest

from gsx.augmenters.checks import Checks
from gsx.builtin import plugins
from gsx.core.errors import ConfigError
from gsx.core.options import flattened
from gsx.core.ranges import Range, Share, beyond_range, field_ranges, parts_of
from gsx.core.rasterizer import RasterOptions
from gsx.core.training.run import TrainingOptions
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.run_folder.general_options import GeneralOptions
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.settings import Budget
from gsx.experiments.runs.typed import typed
from gsx.experiments.tables.plan import Experiment

GENERAL = [GeneralOptions, TrainingOptions, EvalOptions, RasterOptions, Budget, Checks, Experiment]


@dataclass(frozen=True)
class Inner:
    share: Share = 0.5
    loose: float = 1.0


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    several: Annotated[list[int], Range(1, 3)] = field(default_factory=lambda: [1, 3])
    bare: list[float] = field(default_factory=list)
    word: str = ""
    loose_or_none: int | None = None
    either: Annotated[int, Range(1, 3)] | None = None
    named: Annotated[dict[str, int], Range(1, 3)] = field(default_factory=lambda: {"a": 1})
    switch: bool = False


def without_range(options: type, prefix: str = "") -> Iterator[str]:
    """Yields the dotted keys of numeric fields without a range."""
    hints = get_type_hints(options, include_extras=True)
    for name, (kinds, bounds) in field_ranges(options).items():
        for inner in kinds:
            yield from without_range(inner, f"{prefix}{name}.")
        if bounds is None and any(part in (int, float) for part in parts_of(hints[name])):
            yield f"{prefix}{name}"


def test_numbers_beyond_their_range_are_found_in_lists_and_below() -> None:
    assert list(beyond_range(Outer, asdict(Outer()))) == []
    found = list(beyond_range(Outer, {"inner": {"share": 1.01}, "several": [1, 4]}))
    assert found == [("inner.share", 1.01, Range(0, 1)), ("several", [1, 4], Range(1, 3))]
    assert list(beyond_range(Outer, {"inner": {"share": "???"}, "several": None})) == []
    assert str(Range(1, 10**6)) == "from 1 to 1,000,000"


def test_numbers_without_a_range_are_found() -> None:
    assert list(without_range(Outer)) == ["inner.loose", "bare", "loose_or_none"]
    assert list(beyond_range(Outer, {"either": 4})) == [("either", 4, Range(1, 3))]
    assert list(beyond_range(Outer, {"named": {"a": 3, "b": 4}})) == [("named.b", 4, Range(1, 3))]


@pytest.mark.parametrize("options", GENERAL, ids=lambda options: options.__name__)
def test_general_numbers_have_a_range(options: type) -> None:
    assert list(without_range(options)) == []


def test_numbers_of_every_component_have_a_range() -> None:
    for component in plugins().registry.components.values():
        assert list(without_range(component.options)) == [], component.name


@pytest.mark.parametrize("words", [["augmenter=[upscale,bootstrap]"], ["backbone=octree_scaffold"]], ids=" ".join)
def test_a_number_beyond_either_end_is_refused_by_its_key(words: list[str]) -> None:
    settings = compose(words, plugins())
    parts = {"backbone": settings.backbone, "scene": settings.scene} | {
        f"{kind}.{name}": chosen
        for kind, group in (("augmenter", settings.augmenters), ("regenerator", settings.regenerators))
        for name, chosen in group.items()
    }
    tried = 0
    for path, chosen in parts.items():
        node: Any = settings.resolved
        for name in path.split("."):
            node = node[name]
        for key, value in flattened(node).items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            beyond = (-(10**19), 10**19)[tried % 2]  # in turn: that either end counts is asked above
            with pytest.raises(ConfigError, match=rf"^{path}.{key} is .*; give a number from"):
                typed(chosen.component.options, nested(node, key, beyond), path)
            tried += 1
    assert tried > 40


def nested(node: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy with another value at a dotted key."""
    head, _, rest = key.partition(".")
    return node | {head: nested(node[head], rest, value) if rest else value}


def test_bounds_that_are_equal_read_alike() -> None:
    """`typing` keeps one annotation for both."""
    assert str(Range(0, 1e6)) == str(Range(0, 10**6)) == "from 0 to 1,000,000"
    assert str(Range(0.5, 2**63 - 1)) == "from 0.5 to 9,223,372,036,854,775,807"
