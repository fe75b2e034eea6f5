"""Settings that are tried on a scene, and which of them go together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from gsx.core.errors import ConfigError, nearest
from gsx.core.ranges import Range
from gsx.experiments.runs.typed import typed


@dataclass(frozen=True, kw_only=True)
class Change:
    """What a setting is beside the composition as given; values in conf/trade."""

    words: list[str] = field(default_factory=list)
    """Overrides."""
    steps: Annotated[float, Range(1e-3, 1000)] = 1.0
    """So many times its steps."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A change, or several, with a name; none: the composition as given."""

    name: str
    trades: Sequence[str] = ()
    """What is traded."""
    words: Sequence[str] = ()
    steps: float = 1.0

    def overrides(self, iterations: int) -> list[str]:
        """What is added to a composition of so many steps."""
        length = [] if self.steps == 1 else [f"iterations={max(1, round(self.steps * iterations))}"]
        return [*self.words, *length]


GIVEN = Setting(name="as given")


def settings_of(listed: Mapping[str, Any], wanted: Sequence[str] = ()) -> list[Setting]:
    """All settings of conf/trade, or those of the trades wanted.

    Raises:
        ConfigError: there is no such trade, or a setting is none.
    """
    for trade in wanted:
        if trade not in listed:
            raise ConfigError(f"'{trade}' is no trade: choose from {', '.join(listed)}.{nearest(trade, list(listed))}")
    return [
        setting(trade, name, typed(Change, change, f"trade.{trade}.{name}"))
        for trade, changes in listed.items()
        if not wanted or trade in wanted
        for name, change in changes.items()
    ]


def setting(trade: str, name: str, change: Change) -> Setting:
    """One change with its name."""
    return Setting(name=name, trades=(trade,), words=tuple(change.words), steps=change.steps)


def together(settings: Sequence[Setting]) -> Setting:
    """Several changes at once."""
    steps = 1.0
    for one in settings:
        steps *= one.steps
    return Setting(
        name=" + ".join(one.name for one in settings),
        trades=tuple(trade for one in settings for trade in one.trades),
        words=tuple(word for one in settings for word in one.words),
        steps=steps,
    )
