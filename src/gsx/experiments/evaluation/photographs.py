"""Faults of training photos: exposure, pose, blur, or content that no other photo has.

A trained model shows what photos agree on: a photo that differs from it, where others do not, is mostly at fault.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median

from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsx.core.quality.sharpness import BLURRED
from gsx.core.shapes import Bool, Float
from gsx.modules.exposure import log_gains

UNEVEN = 1 / 3
"""Stops from the median, and between channels, above which a photo is named: the step of cameras' dials."""
SHIFTED, TIMES = 0.5, 3.0
"""Px of shift above which a photo is named, if it is so many times the median."""
CELL, FEW = 8, 0.05
"""Px of the squares that errors are summed in; the share of the squares with the largest errors."""
ELSEWHERE, MORE = 0.5, 1.5
"""Share of the error in these squares above which a photo is named, if it is so many times the median."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One training photo compared with the model's render."""

    name: str
    psnr: float
    """With the corrections that were learnt for it, dB."""
    gains: tuple[float, float, float] | None
    """Stops by which each channel is brighter than the uncorrected render; None: unknown."""
    shift: tuple[float, float] | None
    """Px to the right and down from the render; None: unknown."""
    concentrated: float
    """Share of its squared error in the FEW squares with the most."""
    sharpness: float | None
    """Fine contrast relative to its neighbours (`gsx.core.quality.sharpness`); None: unknown."""
    masked: float
    """Share of its pixels that count in nothing."""
    remarks: list[str] = field(default_factory=list)
    """Faults and what was done or can be done about them."""

    @property
    def distance(self) -> float | None:
        """Returns the length of the shift, px."""
        return math.hypot(*self.shift) if self.shift else None

    @property
    def stops(self) -> float | None:
        """Returns the mean gain."""
        return sum(self.gains) / 3 if self.gains else None


def gains_of(
    render: Float[Tensor, "3 H W"], photo: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None
) -> tuple[float, float, float] | None:
    """Estimates the stops by which each channel of a photo is brighter; None where too few pixels count."""
    red, green, blue = (log_gains(render, photo, counted) / math.log(2)).tolist()
    return (red, green, blue) if math.isfinite(red + green + blue) else None


def concentrated(error: Float[Tensor, "H W"], counted: Bool[Tensor, "H W"] | None) -> float:
    """Returns the share of squared errors in the FEW squares of CELL px with the most, of those with counted pixels."""
    cells = avg_pool2d(error[None], CELL, ceil_mode=True, count_include_pad=False)[0].flatten()
    if counted is not None:
        cells = cells[avg_pool2d(counted.to(error)[None], CELL, ceil_mode=True)[0].flatten() > 0]
    most = cells.topk(max(1, round(FEW * len(cells)))).values.sum()
    return float(most / cells.sum().clamp_min(1e-30))


def remarks_on(findings: Sequence[Finding], exposures: str, learnt: bool, corrected: bool = False) -> list[list[str]]:
    """Compares each photo with all and lists its faults.

    `exposures`: training.exposure.when; `learnt`: exposures were learnt; `corrected`: poses were corrected.
    """
    values = zip(*((f.stops, f.distance, f.concentrated, f.psnr) for f in findings), strict=True)
    stops, distance, concentration, quality = map(usual, values)
    remedy = f"training.exposure.when={'auto' if exposures == 'never' else 'always'} learns exposures"
    exposure = "its exposure was learnt" if learnt else remedy
    pose = "even with its pose corrected" if corrected else "training.poses.when=always corrects poses"

    def remarks(one: Finding) -> Iterator[str]:
        if one.gains and one.stops is not None:
            brighter, balance = one.stops - stops, max(one.gains) - min(one.gains)
            if abs(brighter) > UNEVEN:
                than = f"{'brighter' if brighter > 0 else 'darker'} than the others"
                yield f"{abs(brighter):.2f} stops {than}: {exposure}"
            if balance > UNEVEN:
                yield f"its colours are balanced otherwise, channels by up to {balance:.2f} stops: {exposure}"
        if one.shift and one.distance is not None and one.distance >= max(SHIFTED, TIMES * distance):
            x, y = one.shift
            yield f"it is displaced by {one.distance:.1f} px from its render ({x:+.1f} across, {y:+.1f} down): {pose}"
        if one.sharpness is not None and one.sharpness < BLURRED:
            yield f"it has {one.sharpness:.2f} of its neighbours' fine contrast: blurred, leave it out or take it again"
        if one.concentrated >= max(ELSEWHERE, MORE * concentration) and one.psnr < quality:
            yield (
                f"{one.concentrated:.0%} of its error lies in {FEW:.0%} of it: if only this photograph shows what is "
                "there, mask it (masks/)"
            )

    return [list(remarks(one)) for one in findings]


def usual(values: Sequence[float | None]) -> float:
    """Returns the median of the known values; 0 of none."""
    known = [value for value in values if value is not None]
    return median(known) if known else 0.0
