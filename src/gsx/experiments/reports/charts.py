"""Line charts and scatter plots as inline SVG: no script, no library, colours from the page's style sheet."""

import html
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

from markupsafe import Markup

WIDTH, HEIGHT = 480, 250
"""Drawing units of a chart; the page scales it."""
LEFT, RIGHT, TOP, BOTTOM = 54, 14, 10, 38
"""Margins for labels, drawing units."""
LETTER, LINE = 6, 12
"""Width of a letter, about, and height of a line of text, drawing units."""
MOST_POINTS = 400
"""Longer curves are averaged in groups down to this many points."""
PADDING = 0.04
"""Room around the data, as a fraction of their range."""
COLOURS, DASHES = 6, 3
"""Colours of the page, and ways to draw each: solid, dashed or hollow, dotted or faint."""
STYLES = COLOURS * DASHES
"""Curves or points that can be told apart."""
LEAST, MOST = 1e-30, 1e30
"""Sizes between which logarithmic axes, and beyond which no axes, have room for numbers."""
DIGITS_DECADES, MOST_DECADES = 4, 8
"""A logarithmic axis over more decades is marked with powers of ten only; over yet more, with every other one."""


@dataclass(frozen=True)
class Axis:
    """Maps values to [0, 1]."""

    low: float
    high: float
    log: bool = False
    chosen: tuple[float, ...] = ()
    """Ticks to use instead of round ones."""

    def at(self, value: float) -> float:
        """Position of a value."""
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self) -> list[float]:
        """Round values inside the range, or those chosen."""
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
    """Mark every point."""


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
    """Shown on hovering."""
    label: str
    """Written beside points of the front."""
    colour: int
    """Number of its style."""
    link: str = ""
    """Where a click leads."""


def style(number: int) -> str:
    """Classes of the page for the curve or point of that number: colours first, then other ways to draw them."""
    return f"k{number % COLOURS} v{number // COLOURS % DASHES}"


def linear_ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten inside [low, high], about `wanted` of them."""
    raw = (high - low) / wanted
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(digit * power for digit in (1, 2, 5, 10) if digit * power >= raw * 0.999)
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def axis_of(values: Iterable[float], log: bool = False, zero: bool = False) -> Axis:
    """An axis around the values, at most up to MOST; `zero`: it begins at 0."""
    known = [min(max(value, -MOST), MOST) for value in values]
    low, high = min(known), max(known)
    if log and low >= LEAST:
        room = max((high / low) ** PADDING, 1.05)
        return Axis(low / room, high * room, True)
    room = PADDING * (high - low) or max(abs(high) * PADDING, 0.5)
    return Axis(0.0 if zero else low - room, high + room)


def compact(value: float) -> str:
    """A short number: 1200000 is 1.2M, 30000 is 30k."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= size:
            return f"{value / (1e3 if letter == 'k' else size):.3g}{letter}"
    return f"{value:.4g}"


def thinned(x: Sequence[float], y: Sequence[float], most: int = MOST_POINTS) -> tuple[list[float], list[float]]:
    """Means over groups of equal size, so that at most `most` points are left."""
    size = math.ceil(len(x) / most) or 1

    def means(values: Sequence[float]) -> list[float]:
        groups = (values[i : i + size] for i in range(0, len(values), size))
        return [math.fsum(group) / len(group) for group in groups]

    return means(x), means(y)


def smoothed(values: Sequence[float], reach: int) -> list[float]:
    """Means over up to `reach` neighbours to either side."""
    sums = [0.0, *accumulate(values)]
    ends = [(max(0, i - reach), min(len(values), i + reach + 1)) for i in range(len(values))]
    return [(sums[last] - sums[first]) / (last - first) for first, last in ends]


@dataclass(frozen=True)
class Plot:
    """Two axes and where they lie on the drawing."""

    x: Axis
    y: Axis

    def across(self, value: float) -> float:
        """Drawing unit of an x value."""
        return round(LEFT + self.x.at(value) * (WIDTH - LEFT - RIGHT), 1)

    def down(self, value: float) -> float:
        """Drawing unit of a y value."""
        return round(HEIGHT - BOTTOM - self.y.at(value) * (HEIGHT - TOP - BOTTOM), 1)

    def points(self, x: Sequence[float], y: Sequence[float]) -> str:
        """The `points` of a polyline."""
        return " ".join(f"{self.across(a)},{self.down(b)}" for a, b in zip(x, y, strict=True))

    def frame(self, x_label: str) -> str:
        """Grid lines, tick labels and the name of the x axis."""
        bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
        parts = []
        for tick in self.y.ticks():
            at = self.down(tick)
            parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{at}" y2="{at}"/>')
            parts.append(f'<text class="tick" x="{LEFT - 7}" y="{at + 4}" text-anchor="end">{compact(tick)}</text>')
        for tick in self.x.ticks():
            at = self.across(tick)
            parts.append(f'<line class="grid" x1="{at}" x2="{at}" y1="{bottom}" y2="{bottom + 4}"/>')
            parts.append(f'<text class="tick" x="{at}" y="{bottom + 16}" text-anchor="middle">{compact(tick)}</text>')
        parts.append(f'<line class="axis" x1="{LEFT}" x2="{right}" y1="{bottom}" y2="{bottom}"/>')
        middle = (LEFT + right) / 2
        parts.append(
            f'<text class="name" x="{middle}" y="{HEIGHT - 5}" text-anchor="middle">{html.escape(x_label)}</text>'
        )
        return "".join(parts)


def line_chart(
    series: Sequence[Series],
    *,
    x_label: str,
    log: bool = False,
    marks: Sequence[Mark] = (),
    x_ticks: Sequence[float] = (),
) -> Markup:
    """Curves over a common x axis; empty when no series has two points.

    `log`: logarithmic y axis; `x_ticks`: a logarithmic x axis with these ticks, else linear from 0.
    """
    drawn = [s for s in series if s.x]
    if not any(len(s.x) > 1 for s in drawn):
        return Markup()
    places = [x for s in drawn for x in s.x]
    across = replace(axis_of(places, log=True), chosen=tuple(x_ticks)) if x_ticks else axis_of(places, zero=True)
    plot = Plot(across, axis_of((y for s in drawn for y in s.y), log=log))
    body = plot.frame(x_label) + "".join(mark_line(plot, mark) for mark in marks if plot.x.low <= mark.x <= plot.x.high)
    body += "".join(curve(plot, s) for s in drawn) + '<line class="cursor" y1="10" y2="212"/>'
    return svg(body, hover_data(plot, drawn, x_label))


def mark_line(plot: Plot, mark: Mark) -> str:
    """A vertical line."""
    at = plot.across(mark.x)
    title = f"<title>{html.escape(mark.text)}</title>"
    return f'<line class="mark {mark.kind}" x1="{at}" x2="{at}" y1="{TOP}" y2="{HEIGHT - BOTTOM}">{title}</line>'


def curve(plot: Plot, series: Series) -> str:
    """A polyline, with dots where asked for."""
    x, y = thinned(series.x, series.y)
    title = f"<title>{html.escape(series.name)}</title>"
    body = f'<polyline class="curve {series.kind}" points="{plot.points(x, y)}">{title}</polyline>'
    if series.dots:
        places = zip(x, y, strict=True)
        body += "".join(
            f'<circle class="{series.kind}" cx="{plot.across(a)}" cy="{plot.down(b)}" r="3"/>' for a, b in places
        )
    return body


def hover_data(plot: Plot, series: Sequence[Series], x_label: str) -> str:
    """What the page's script needs to show values under the pointer."""
    named = [(s.name, *thinned(s.x, s.y)) for s in series if s.kind != "faint"]
    content = {
        "box": [LEFT, WIDTH - RIGHT],
        "x": [plot.x.low, plot.x.high],
        "log": plot.x.log,
        "label": x_label,
        "series": [{"name": n, "x": digits(x), "y": digits(y)} for n, x, y in named],
    }
    return json.dumps(content, separators=(",", ":"))


def digits(values: Iterable[float]) -> list[float]:
    """Five significant digits."""
    return [float(f"{value:.5g}") for value in values]


def svg(body: str, data: str = "") -> Markup:
    """The drawing around its parts."""
    hover = f" data-chart='{html.escape(data)}'" if data else ""
    return Markup(f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img"{hover}>{body}</svg>')


def pareto_front(costs: Sequence[float], gains: Sequence[float]) -> list[int]:
    """Indices, by rising cost, of points that no other beats: costs no more, gains no less, and is better in one."""

    def beaten(i: int) -> bool:
        return any(
            c <= costs[i] and g >= gains[i] and (c < costs[i] or g > gains[i])
            for c, g in zip(costs, gains, strict=True)
        )

    return sorted((i for i in range(len(costs)) if not beaten(i)), key=lambda i: (costs[i], gains[i]))


def scatter(dots: Sequence[Dot], *, x_label: str) -> Markup:
    """Points with the Pareto front (lower x, higher y) joined and named; empty without points."""
    if not dots:
        return Markup()
    log = min(dot.x for dot in dots) > 0 and max(dot.x for dot in dots) > 8 * min(dot.x for dot in dots)
    plot = Plot(axis_of((dot.x for dot in dots), log=log), axis_of(dot.y for dot in dots))
    front = pareto_front([dot.x for dot in dots], [dot.y for dot in dots])
    line = plot.points([dots[i].x for i in front], [dots[i].y for i in front])
    body = plot.frame(x_label) + f'<polyline class="front" points="{line}"/>'
    body += "".join(scatter_dot(plot, dot, i in front) for i, dot in enumerate(dots))
    return svg(body + labels(plot, [dots[i] for i in front]))


def scatter_dot(plot: Plot, dot: Dot, on_front: bool) -> str:
    """A point; those of the front are larger."""
    kind, radius = ("dot best", 5.5) if on_front else ("dot", 4)
    title = f"<title>{html.escape(dot.text)}</title>"
    place = f'cx="{plot.across(dot.x)}" cy="{plot.down(dot.y)}"'
    body = f'<circle class="{kind} {style(dot.colour)}" {place} r="{radius}">{title}</circle>'
    return f'<a href="{html.escape(dot.link)}">{body}</a>' if dot.link else body


def labels(plot: Plot, dots: Sequence[Dot]) -> str:
    """Names beside points, above or below them, on the side with room; one that would cover another is left out."""
    body, taken = "", list[tuple[float, float, float]]()
    for dot in dots:
        x, y, width = plot.across(dot.x), plot.down(dot.y), LETTER * len(dot.label)
        leftwards = x + 8 + width > WIDTH and x > WIDTH / 2
        left = x - 8 - width if leftwards else x + 8
        free = [line for line in (y - 7, y + 16) if not any(covers(left, line, width, other) for other in taken)]
        if free:
            taken.append((left, free[0], width))
            anchor, at = ("end", x - 8) if leftwards else ("start", x + 8)
            text = html.escape(dot.label)
            body += f'<text class="tick" x="{at:g}" y="{free[0]:g}" text-anchor="{anchor}">{text}</text>'
    return body


def covers(left: float, line: float, width: float, other: tuple[float, float, float]) -> bool:
    """Whether two texts would overlap: left end, base line and width of each."""
    return abs(line - other[1]) < LINE and left < other[0] + other[2] and other[0] < left + width
