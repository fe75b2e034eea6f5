"""Paired differences between methods, with intervals over views and over repetitions."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

QUANTILES = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""Student's t at 97.5 %, for 1 to 10 degrees of freedom."""
NORMAL = 1.959964
"""The normal distribution's."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Mean difference of two methods, and half the width of its 95 % interval; None: too few values."""

    mean: float
    values: int
    """Number of views, or of repetitions."""
    over_views: float | None
    over_repetitions: float | None


def difference(one: Sequence[Mapping[str, float]], other: Sequence[Mapping[str, float]]) -> Difference | None:
    """Compares two methods by a figure of each view, one mapping for each repetition; None: they share no view.

    Views are paired. Repetitions are paired where both have as many, otherwise each mean is taken over its own.
    """
    shared = sorted(set.intersection(*(set(views) for views in (*one, *other))))
    if not shared:
        return None
    views = [statistics.fmean(r[name] for r in one) - statistics.fmean(r[name] for r in other) for name in shared]
    means, others = ([statistics.fmean(r[name] for name in shared) for r in runs] for runs in (one, other))
    return Difference(
        mean=statistics.fmean(views),
        values=len(shared),
        over_views=half_width(views),
        over_repetitions=over_repetitions(means, others),
    )


def over_repetitions(means: Sequence[float], others: Sequence[float]) -> float | None:
    """Returns half the 95 % interval of the difference of two methods' means over repetitions; None: one alone."""
    if len(means) == len(others):
        return half_width([a - b for a, b in zip(means, others, strict=True)])
    errors = [statistics.variance(values) / len(values) for values in (means, others) if len(values) > 1]
    freedom = max(len(means), len(others)) - 1
    return quantile(freedom) * math.sqrt(sum(errors)) if errors else None


def half_width(values: Sequence[float]) -> float | None:
    """Returns half the width of the 95 % interval of a mean, by Student's t; None: there is one value."""
    if len(values) < 2:
        return None
    return quantile(len(values) - 1) * statistics.stdev(values) / math.sqrt(len(values))


def quantile(freedom: int) -> float:
    """Returns Student's t at 97.5 %; above 10 degrees of freedom by Cornish and Fisher's expansion (error < 2e-4)."""
    if freedom <= len(QUANTILES):
        return QUANTILES[freedom - 1]
    z, n = NORMAL, freedom
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
    return z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2) + third
