"""A stroke font on a 4 x 6 grid: letters are the points within half a stroke of a few straight lines.

Letters defined by distance have crisp edges at every zoom, which is what makes a blurred rendering of them obvious.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float, Int

GLYPHS = {
    " ": "",
    "A": "00 26 40|12 32", "B": "00 06 36 45 44 33 03|33 42 41 30 00", "C": "45 36 16 05 01 10 30 41",
    "D": "00 06 26 44 42 20 00", "E": "40 00 06 46|03 33", "F": "00 06 46|03 33", "G": "45 36 16 05 01 10 30 41 43 23",
    "H": "00 06|40 46|03 43", "I": "20 26|10 30|16 36", "J": "46 41 30 10 01", "K": "00 06|46 02|24 40",
    "L": "06 00 40", "M": "00 06 23 46 40", "N": "00 06 40 46", "O": "10 30 41 45 36 16 05 01 10",
    "P": "00 06 36 45 44 33 03", "Q": "10 30 41 45 36 16 05 01 10|22 40", "R": "00 06 36 45 44 33 03|23 40",
    "S": "45 36 16 05 04 13 33 42 41 30 10 01", "T": "06 46|26 20", "U": "06 01 10 30 41 46", "V": "06 20 46",
    "W": "06 10 23 30 46", "X": "00 46|06 40", "Y": "06 23 46|23 20", "Z": "06 46 00 40",
    "0": "10 30 41 45 36 16 05 01 10|11 35", "1": "15 26 20|10 30", "2": "05 16 36 45 44 00 40",
    "3": "05 16 36 45 44 33 42 41 30 10 01|13 33", "4": "30 36 02 42", "5": "46 06 03 33 42 41 30 10 01",
    "6": "45 36 16 05 01 10 30 41 42 33 13 02", "7": "06 46 20", "8": "13 33 44 45 36 16 05 04 13 02 01 10 30 41 42 33",
    "9": "01 10 30 41 45 36 16 05 04 13 33 44", "-": "13 33", ".": "20 20", "?": "05 16 36 45 44 23 22|20 20",
}  # fmt: skip
"""Character -> polylines of grid points `xy` (x to the right 0..4, y up 0..6), separated by |."""

WIDTH, HEIGHT = 4.0, 6.0  # of a letter, grid units
ADVANCE = 5.9  # from one letter to the next, grid units
STROKE = 0.95  # thickness of a line, grid units
FAR = 1e3  # where unused lines of the table lie, grid units
ALPHABET = "".join(GLYPHS)


def strokes(glyph: str) -> list[tuple[float, float, float, float]]:
    """Return the straight lines (x0, y0, x1, y1) of one entry of GLYPHS."""
    polylines = [[(float(p[0]), float(p[1])) for p in polyline.split()] for polyline in glyph.split("|")]
    return [(*a, *b) for points in polylines for a, b in pairwise(points)]


def stroke_table() -> Float[Tensor, "lines glyphs 4"]:
    """Return the lines of every letter, padded with far ones to the largest count."""
    table = [strokes(glyph) for glyph in GLYPHS.values()]
    most = max(len(lines) for lines in table)
    return torch.tensor([lines + [(FAR,) * 4] * (most - len(lines)) for lines in table]).permute(1, 0, 2).contiguous()


@dataclass(frozen=True)
class Line:
    """One centred line of text."""

    text: str
    size: float
    """Height of the letters, scene units."""
    centre: float
    """Height of the line's middle on the panel, scene units."""


@dataclass(frozen=True, eq=False)
class Lettering:
    """Lines of text as tables, which look up all points of a panel at once."""

    strokes: Float[Tensor, "lines glyphs 4"]
    letters: Int[Tensor, "rows columns"]
    """Indices into ALPHABET; blanks fill short lines, and at least one ends each: places before a line wrap to it."""
    unit: Float[Tensor, "rows"]
    """Scene units per grid unit."""
    left: Float[Tensor, "rows"]
    bottom: Float[Tensor, "rows"]

    def ink(self, u: Float[Tensor, "points"], v: Float[Tensor, "points"]) -> Bool[Tensor, "points"]:
        """Return which panel points (u to the right, v up, from the middle, scene units) lie on a letter."""
        result = torch.zeros_like(u, dtype=torch.bool)
        for row in range(len(self.unit)):
            x, y = (u - self.left[row]) / self.unit[row], (v - self.bottom[row]) / self.unit[row]
            inside = (y > -STROKE) & (y < HEIGHT + STROKE) & (x > -STROKE) & (x < (self.letters.shape[1] - 1) * ADVANCE)
            chosen = inside.nonzero()[:, 0]
            if len(chosen):
                result[chosen] |= self.row_ink(row, x.index_select(0, chosen), y.index_select(0, chosen))
        return result

    def row_ink(self, row: int, x: Float[Tensor, "points"], y: Float[Tensor, "points"]) -> Bool[Tensor, "points"]:
        """Return which grid points of one row of text lie on a letter."""
        place = ((x + (ADVANCE - WIDTH) / 2) / ADVANCE).floor()
        letter = self.letters[row].index_select(0, place.long() % self.letters.shape[1])
        x = x - place * ADVANCE
        nearest = torch.full_like(x, FAR)
        for lines in self.strokes:
            nearest = torch.minimum(nearest, squared_distance(x, y, lines.T.index_select(1, letter)))
        return nearest < (STROKE / 2) ** 2


def squared_distance(
    x: Float[Tensor, "points"], y: Float[Tensor, "points"], line: Float[Tensor, "4 points"]
) -> Float[Tensor, "points"]:
    """Return the squared distance from points to straight lines (x0, y0, x1, y1)."""
    run, rise = line[2] - line[0], line[3] - line[1]
    x, y = x - line[0], y - line[1]
    length = (run * run + rise * rise).clamp(min=1e-6)  # a dot is a line of no length
    along = ((x * run + y * rise) / length).clamp(0.0, 1.0)
    dx, dy = x - along * run, y - along * rise
    return dx * dx + dy * dy


def typeset(lines: Sequence[Line]) -> Lettering:
    """Tabulate lines of text; KeyError: a character is not in the font."""
    index = {character: place for place, character in enumerate(ALPHABET)}
    columns = max(len(line.text) for line in lines)
    unit = torch.tensor([line.size / HEIGHT for line in lines])
    widths = torch.tensor([len(line.text) * ADVANCE - (ADVANCE - WIDTH) for line in lines])
    return Lettering(
        strokes=stroke_table(),
        letters=torch.tensor([[index[c] for c in line.text.ljust(columns + 1)] for line in lines]),
        unit=unit,
        left=-widths * unit / 2,
        bottom=torch.tensor([line.centre - line.size / 2 for line in lines]),
    )
