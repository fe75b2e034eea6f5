"""A picture of PSNR over wall time, one panel per scene."""

import html
from collections.abc import Mapping, Sequence
from dataclasses import replace

from gsx.experiments.reports.charts import Axis, Plot, Series, axis_of, drawing
from measuring.curves import Point
from measuring.results import STYLE

COLOURS = ("#888888", "#d2601a", "#3366aa", "#2a8a4a")
"""Colours of arms, in their order."""
TICKS = (10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600)
"""Seconds that a reader knows."""
ACROSS, HEADING = 2, 24
"""Panels in a row; height of a panel's heading, drawing units."""
Curves = Mapping[tuple[str, str], Sequence[Point]]
"""(seconds, PSNR) by arm and zoom."""


def panels(scenes: Mapping[str, Curves]) -> str:
    """Draws PSNR over seconds by scene; zooms beyond the first are dashed. Empty if no curve has two points."""
    drawn = {scene: curves for scene, curves in scenes.items() if any(len(points) > 1 for points in curves.values())}
    if not drawn:
        return ""
    arms = list(dict.fromkeys(arm for curves in drawn.values() for arm, _ in curves))
    across, down = min(ACROSS, len(drawn)), -(-len(drawn) // ACROSS)
    width, height = across * Plot.WIDTH, down * (Plot.HEIGHT + HEADING)
    body = "".join(placed(index, panel(scene, curves, arms)) for index, (scene, curves) in enumerate(drawn.items()))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}">'
        f"<style>{STYLE}</style>{body}</svg>\n"
    )


def placed(index: int, drawing: str) -> str:
    """Moves a panel to its place, row by row."""
    down, across = divmod(index, ACROSS)
    x, y = across * Plot.WIDTH, down * (Plot.HEIGHT + HEADING) + HEADING
    return f'<g transform="translate({x} {y})">{drawing}</g>'


def panel(scene: str, curves: Curves, arms: Sequence[str]) -> str:
    """Draws one scene."""
    points = [point for group in curves.values() for point in group]
    plot = Plot(seconds_axis([x for x, _ in points]), axis_of(y for _, y in points))
    zooms = list(dict.fromkeys(zoom for _, zoom in curves))
    heading = f'<text x="{plot.LEFT}" y="{plot.TOP - 8}">{html.escape(scene)}: PSNR, dB</text>'
    body = str(drawing().frame(plot, "wall time, s")) + heading
    for number, ((arm, zoom), group) in enumerate(curves.items()):
        ordered = sorted(group)
        series = Series(name=f"{arm}, {zoom}", x=[x for x, _ in ordered], y=[y for _, y in ordered], dots=True)
        line = str(drawing().curve(plot, series)) + legend(len(curves) - number, series.name)
        body += f"<g {pen(arms.index(arm), zooms.index(zoom))}>{line}</g>"
    return body


def seconds_axis(seconds: Sequence[float]) -> Axis:
    """Returns a logarithmic axis with ticks at round times."""
    axis = axis_of(seconds, log=True)
    ticks = tuple(float(tick) for tick in TICKS if axis.low <= tick <= axis.high)
    return replace(axis, chosen=ticks) if len(ticks) > 1 else axis


def pen(arm: int, zoom: int) -> str:
    """Returns an arm's colour; curves of further zooms are dashed."""
    colour = COLOURS[arm % len(COLOURS)]
    dashes = f' stroke-dasharray="{max(1, 6 - 2 * zoom)} 3"' if zoom else ""
    return f'stroke="{colour}" fill="{colour}"{dashes}'


def legend(number: int, text: str) -> str:
    """Draws a line of the legend, counted from below: long runs are good, so the lower right is free."""
    x, y = Plot.right - 130, Plot.bottom - 14 * number + 4
    line = f'<line class="curve" x1="{x}" x2="{x + 22}" y1="{y - 4}" y2="{y - 4}"/>'
    return line + f'<text x="{x + 28}" y="{y}" stroke="none">{html.escape(text)}</text>'
