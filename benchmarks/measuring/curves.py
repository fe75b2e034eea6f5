"""Curves of PSNR over wall time: values between runs, and the steps that last some time."""

import math
from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean

Point = tuple[float, float]
"""(seconds, PSNR in dB), or (steps, seconds)."""
REACH = 1.1
"""Factor of seconds up to which a curve goes on beyond its first and last run."""


def line_at(one: Point, other: Point, x: float) -> float:
    """Returns the value at x of the straight line through two points."""
    return one[1] + (x - one[0]) / (other[0] - one[0]) * (other[1] - one[1])


def neighbours(points: Sequence[Point], x: float) -> tuple[Point, Point]:
    """Returns the two points around x, or the two at the end beyond which x lies."""
    ordered = sorted(points)
    return next((pair for pair in pairwise(ordered) if x <= pair[1][0]), (ordered[-2], ordered[-1]))


def psnr_at(curve: Sequence[Point], seconds: float) -> float | None:
    """Returns the PSNR that a curve has after some seconds, linear in log(seconds).

    None: the curve ends more than `REACH` away. A single run stands for seconds that near.
    """
    ordered = sorted(curve)
    if not ordered or not ordered[0][0] / REACH <= seconds <= ordered[-1][0] * REACH:
        return None
    if len(ordered) == 1:
        return ordered[0][1]
    one, other = neighbours(ordered, seconds)
    return line_at((math.log(one[0]), one[1]), (math.log(other[0]), other[1]), math.log(seconds))


def seconds_to(curve: Sequence[Point], psnr: float) -> float | None:
    """Returns the seconds after which a curve first has a PSNR, linear in log(seconds); None: no run reaches it.

    If the shortest run has it, these are its seconds: fewer may be enough.
    """
    ordered = sorted(curve)
    if not ordered or ordered[0][1] >= psnr:
        return ordered[0][0] if ordered else None
    for one, other in pairwise(ordered):
        if other[1] >= psnr:
            return math.exp(line_at((one[1], math.log(one[0])), (other[1], math.log(other[0])), psnr))
    return None


def steps_for(seconds: float, runs: Sequence[Point]) -> int:
    """Returns the steps that last some seconds, linear between (steps, seconds) of runs and beyond them.

    Runs of as many steps count once, by their mean.

    Raises:
        ValueError: there are not two runs of different lengths, or a longer run was not slower.
    """
    lengths = {steps for steps, _ in runs}
    if len(lengths) < 2:
        raise ValueError(f"{len(runs)} runs of one length say nothing about others: measure two lengths")
    swapped = [(fmean(lasted for steps, lasted in runs if steps == length), length) for length in lengths]
    one, other = neighbours(swapped, seconds)
    if other[0] <= one[0] or other[1] <= one[1]:
        shorter, longer = (f"{steps:.0f} steps lasted {lasted:.0f} s" for lasted, steps in (other, one))
        raise ValueError(f"{shorter}, but {longer}: remove these runs and measure them again")
    return max(1, round(line_at(one, other, seconds)))
