"""Line charts and scatter plots: axes, curves, Pareto fronts and labels, drawn by charts.html."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, ClassVar

from markupsafe import Markup

from gsx.experiments.reports.page import template

LETTER, LINE = 6, 12
"""Width of a letter, about, and height of a line of text, drawing units."""
MOST_POINTS = 400
"""Longer curves are averaged in groups down to this many points."""
PADDING = 0.04
"""Room around the data, as a fraction of their range."""
COLOURS, DASHES = 6, 3
"""Colours of the page, and ways to draw each: solid, dashed or hollow, dotted or faint."""
STYLES = COLOURS * DASHES
"""Different styles of curves and points."""
LEAST, MOST = 1e-30, 1e30
"""Sizes between which logarithmic axes, and beyond which no axes, have room for numbers."""
DIGITS_DECADES, MOST_DECADES = 4, 8
"""A logarithmic axis over more decades has ticks at powers of ten only; over yet more, at every other one."""


@dataclass(frozen=True)
class Axis:
    """Maps values to [0, 1]."""

    low: float
    high: float
    log: bool = False
    chosen: tuple[float, ...] = ()
    """Ticks to use instead of round ones."""

    def at(self, value: float) -> float:
        """Returns the position of a value."""
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self) -> list[float]:
        """Returns round values inside the range, or those chosen."""
        if self.chosen:
            return list(self.chosen)
        if not self.log:
            return linear_ticks(self.low, self.high)
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        step = -(-len(decades) // MOST_DECADES)
        digits = (1, 2, 5) if len(decades) <= DIGITS_DECADES else (1,)
        ticks = [digit * 10.0**decade for decade in decades if decade % step == 0 for digit in digits]
        inside = [tick for tick in ticks if self.low <= tick <= self.high]
        return inside if len(inside) >= 2 else linear_ticks(self.low, self.high)


@dataclass(frozen=True, kw_only=True)
class Series:
    """A curve: values over positions, drawn in style `kind` of the page (main, faint, test, or of `style`)."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    kind: str = "main"
    dots: bool = False
    """Marks every point."""

    def points(self) -> tuple[list[float], list[float]]:
        """Returns the points that are drawn."""
        return thinned(self.x, self.y)


@dataclass(frozen=True, kw_only=True)
class Mark:
    """A vertical line with an explanation, in style `kind` (reset, skipped)."""

    x: float
    text: str
    kind: str


@dataclass(frozen=True, kw_only=True)
class Dot:
    """A point of a scatter plot."""

    x: float
    y: float
    text: str
    """Appears on hovering."""
    label: str
    """Label of points of the front."""
    colour: int
    """Number of its style."""
    link: str = ""
    """Target of a click."""

    @property
    def style(self) -> str:
        """Returns its classes of the page."""
        return style(self.colour)


@dataclass(frozen=True, kw_only=True)
class Label:
    """A point's label: its anchored end, base line and left end, drawing units."""

    text: str
    x: float
    line: float
    left: float
    anchor: str

    def covers(self, other: "Label") -> bool:
        """Returns whether two texts would overlap."""
        apart = self.left + LETTER * len(self.text) <= other.left or other.left + LETTER * len(other.text) <= self.left
        return abs(self.line - other.line) < LINE and not apart


@dataclass(frozen=True)
class Plot:
    """Two axes on a drawing, whose units the page scales."""

    x: Axis
    y: Axis
    WIDTH: ClassVar[int] = 480
    HEIGHT: ClassVar[int] = 250
    LEFT: ClassVar[int] = 54
    RIGHT: ClassVar[int] = 14
    TOP: ClassVar[int] = 10
    BOTTOM: ClassVar[int] = 38
    right: ClassVar[int] = WIDTH - RIGHT
    bottom: ClassVar[int] = HEIGHT - BOTTOM

    def across(self, value: float) -> float:
        """Returns the drawing unit of an x value."""
        return round(self.LEFT + self.x.at(value) * (self.right - self.LEFT), 1)

    def down(self, value: float) -> float:
        """Returns the drawing unit of a y value."""
        return round(self.bottom - self.y.at(value) * (self.bottom - self.TOP), 1)

    def points(self, x: Iterable[float], y: Iterable[float]) -> str:
        """Returns the `points` of a polyline."""
        return " ".join(f"{self.across(a)},{self.down(b)}" for a, b in zip(x, y, strict=True))


def style(number: int) -> str:
    """Returns the classes of the page for a curve or point: colours first, then other ways to draw them."""
    return f"k{number % COLOURS} v{number // COLOURS % DASHES}"


def linear_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Returns multiples of 1, 2 or 5 times a power of ten inside [low, high], about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(digit * power for digit in (1, 2, 5, 10) if digit * power >= raw * 0.999)
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def axis_of(values: Iterable[float], log: bool = False, zero: bool = False) -> Axis:
    """Makes an axis around the values, at most up to MOST; `zero`: it begins at 0."""
    known = [min(max(value, -MOST), MOST) for value in values]
    low, high = min(known), max(known)
    if log and low >= LEAST:
        room = max((high / low) ** PADDING, 1.05)
        return Axis(low / room, high * room, True)
    room = PADDING * (high - low) or max(abs(high) * PADDING, 0.5)
    return Axis(0.0 if zero else low - room, high + room)


def thinned(x: Sequence[float], y: Sequence[float], most: int = MOST_POINTS) -> tuple[list[float], list[float]]:
    """Averages groups of equal size, so that at most `most` points are left."""
    size = math.ceil(len(x) / most) or 1

    def means(values: Sequence[float]) -> list[float]:
        groups = (values[i : i + size] for i in range(0, len(values), size))
        return [math.fsum(group) / len(group) for group in groups]

    return means(x), means(y)


def smoothed(values: Sequence[float], reach: int) -> list[float]:
    """Averages up to `reach` neighbours on either side."""
    sums = [0.0, *accumulate(values)]
    ends = [(max(0, i - reach), min(len(values), i + reach + 1)) for i in range(len(values))]
    return [(sums[last] - sums[first]) / (last - first) for first, last in ends]


def drawing() -> Any:
    """Returns the macros of charts.html."""
    return template("reports/charts.html").module


def line_chart(
    series: Sequence[Series],
    *,
    x_label: str,
    log: bool = False,
    marks: Sequence[Mark] = (),
    x_ticks: Sequence[float] = (),
) -> Markup:
    """Draws curves over a common x axis; empty when no series has two points.

    `log`: logarithmic y axis; `x_ticks`: a logarithmic x axis with these ticks, else linear from 0.
    """
    drawn = [s for s in series if s.x]
    if not any(len(s.x) > 1 for s in drawn):
        return Markup()
    places = [x for s in drawn for x in s.x]
    across = replace(axis_of(places, log=True), chosen=tuple(x_ticks)) if x_ticks else axis_of(places, zero=True)
    plot = Plot(across, axis_of((y for s in drawn for y in s.y), log=log))
    inside = [mark for mark in marks if plot.x.low <= mark.x <= plot.x.high]
    return Markup(drawing().lines(plot, x_label, drawn, inside, hover_data(plot, drawn, x_label)))


def hover_data(plot: Plot, series: Sequence[Series], x_label: str) -> str:
    """Returns what the page's script needs to show values under the pointer."""
    named = [(s.name, *s.points()) for s in series if s.kind != "faint"]
    content = {
        "box": [plot.LEFT, plot.right],
        "x": [plot.x.low, plot.x.high],
        "log": plot.x.log,
        "label": x_label,
        "series": [{"name": name, "x": digits(x), "y": digits(y)} for name, x, y in named],
    }
    return json.dumps(content, separators=(",", ":"))


def digits(values: Iterable[float]) -> list[float]:
    """Rounds to five significant digits."""
    return [float(f"{value:.5g}") for value in values]


def pareto_front(costs: Sequence[float], gains: Sequence[float]) -> list[int]:
    """Returns the indices, by rising cost, of points that no other beats: costs no more, gains no less, one better."""

    def beaten(i: int) -> bool:
        return any(
            c <= costs[i] and g >= gains[i] and (c < costs[i] or g > gains[i])
            for c, g in zip(costs, gains, strict=True)
        )

    return sorted((i for i in range(len(costs)) if not beaten(i)), key=lambda i: (costs[i], gains[i]))


def scatter(dots: Sequence[Dot], *, x_label: str, sign: int = 1) -> Markup:
    """Draws points, with the Pareto front joined and named: lower x, higher y (`sign` 1) or lower y (-1).

    Empty without points.
    """
    if not dots:
        return Markup()
    log = min(dot.x for dot in dots) > 0 and max(dot.x for dot in dots) > 8 * min(dot.x for dot in dots)
    plot = Plot(axis_of((dot.x for dot in dots), log=log), axis_of(dot.y for dot in dots))
    front = [dots[i] for i in pareto_front([dot.x for dot in dots], [sign * dot.y for dot in dots])]
    return Markup(drawing().points(plot, x_label, dots, front, labels(plot, front)))


def labels(plot: Plot, dots: Sequence[Dot]) -> list[Label]:
    """Places names next to points, above or below on the side with room, unless they cover another."""
    placed: list[Label] = []
    for dot in dots:
        x, y, width = plot.across(dot.x), plot.down(dot.y), LETTER * len(dot.label)
        leftwards = x + 8 + width > plot.WIDTH and x > plot.WIDTH / 2
        end, left, anchor = (x - 8, x - 8 - width, "end") if leftwards else (x + 8, x + 8, "start")
        lines = (Label(text=dot.label, x=end, line=line, left=left, anchor=anchor) for line in (y - 7, y + 16))
        placed += [one for one in lines if not any(one.covers(other) for other in placed)][:1]
    return placed
