"""What is wrong with training photographs, told from what a trained model shows in their places.

A model shows what photographs agree on. Where one of them differs from it, and others do not, it is mostly that
photograph: its exposure, its pose, a blur, or something in it that no other shows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsx.core.quality.sharpness import BLURRED
from gsx.core.shapes import Bool, Float
from gsx.modules.exposure import log_gains

UNEVEN = 1 / 3
"""Stops from the middle from which on a photograph is named, and between its channels: the step of cameras' dials."""
SHIFTED, TIMES = 0.5, 3.0
"""Px by which a photograph is named that lies beside the render, if it is so many times the usual."""
CELL, FEW = 8, 0.05
"""Px of the squares that errors are summed in; the share of the squares with the most of them."""
ELSEWHERE, MORE = 0.5, 1.5
"""Share of the error in these squares from which on a photograph is named, if it is so many times the usual."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One training photograph beside the model's render."""

    name: str
    psnr: float
    """At the exposure that was learnt for it, if any, dB."""
    gains: tuple[float, float, float] | None
    """Stops by which each channel is brighter than the render at the model's own exposure; None: nothing tells."""
    shift: tuple[float, float] | None
    """Px to the right and down by which it lies beside the render; None: nothing tells."""
    concentrated: float
    """Share of its squared error in the FEW squares with the most."""
    sharpness: float | None
    """Its fineness by that of its neighbours (`gsx.core.quality.sharpness`); None: not told."""
    masked: float
    """Share of its pixels that count in nothing."""
    remarks: list[str] = field(default_factory=list)
    """What is wrong, and what was done or can be done about it."""

    @property
    def moved(self) -> float | None:
        """Length of the shift, px."""
        return math.hypot(*self.shift) if self.shift else None

    @property
    def stops(self) -> float | None:
        """Mean of its gains."""
        return sum(self.gains) / 3 if self.gains else None


# -- one photograph ----------------------------------------------------------------------------------------------------


def gains_of(
    render: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None
) -> tuple[float, float, float] | None:
    """Stops by which each channel of a photograph is brighter; None where too few pixels tell."""
    red, green, blue = (log_gains(render, photograph, counted) / math.log(2)).tolist()
    return (red, green, blue) if math.isfinite(red + green + blue) else None


def concentrated(error: Float[Tensor, "H W"], counted: Bool[Tensor, "H W"] | None) -> float:
    """Share of squared errors in the FEW squares of CELL px that have the most, of those in which any pixel counts."""
    cells = avg_pool2d(error[None], CELL, ceil_mode=True, count_include_pad=False)[0].flatten()
    if counted is not None:
        cells = cells[avg_pool2d(counted.to(error)[None], CELL, ceil_mode=True)[0].flatten() > 0]
    most = cells.topk(max(1, round(FEW * len(cells)))).values.sum()
    return float(most / cells.sum().clamp_min(1e-30))


# -- all of them -------------------------------------------------------------------------------------------------------


def remarks_on(findings: Sequence[Finding], exposures: str, learnt: bool, corrected: bool = False) -> list[list[str]]:
    """What is wrong with each, against the others; `exposures`: training.exposure.when; `learnt`: whether each has its
    own; `corrected`: whether poses have been."""
    stops, shift, part, usual_psnr = (
        usual(of) for of in zip(*((f.stops, f.moved, f.concentrated, f.psnr) for f in findings), strict=True)
    )
    remedy = f"training.exposure.when={'auto' if exposures == 'never' else 'always'} learns exposures"
    done = "its exposure was learnt" if learnt else remedy
    return [
        [
            *exposure_remarks(one, stops, done),
            *shift_remarks(one, shift, corrected),
            *blur_remarks(one),
            *part_remarks(one, part, usual_psnr),
        ]
        for one in findings
    ]


def usual(values: Sequence[float | None]) -> float:
    """Median of those that are told; 0 of none."""
    known = [value for value in values if value is not None]
    return median(known) if known else 0.0


def exposure_remarks(one: Finding, middle: float, done: str) -> list[str]:
    """Of a photograph that is brighter or darker than the middle one, or differs in its balance of colours; `done`:
    about it."""
    if one.gains is None or one.stops is None:
        return []
    stops, balance = one.stops - middle, max(one.gains) - min(one.gains)
    out = []
    if abs(stops) > UNEVEN:
        out.append(f"{abs(stops):.2f} stops {'brighter' if stops > 0 else 'darker'} than the others: {done}")
    if balance > UNEVEN:
        out.append(f"its colours are balanced otherwise, channels by up to {balance:.2f} stops: {done}")
    return out


def shift_remarks(one: Finding, usual_shift: float, corrected: bool) -> list[str]:
    """Of a photograph that lies beside the render."""
    if one.shift is None or one.moved is None or one.moved < max(SHIFTED, TIMES * usual_shift):
        return []
    x, y = one.shift
    remedy = "even with its pose corrected" if corrected else "training.poses.when=always corrects poses"
    return [f"it lies {one.moved:.1f} px beside the model's render ({x:+.1f} across, {y:+.1f} down): {remedy}"]


def blur_remarks(one: Finding) -> list[str]:
    """Of a blurred photograph."""
    if one.sharpness is None or one.sharpness >= BLURRED:
        return []
    return [f"it has {one.sharpness:.2f} of its neighbours' fine contrast: blurred, leave it out or take it again"]


def part_remarks(one: Finding, usual_part: float, usual_psnr: float) -> list[str]:
    """Of a photograph with an error in one place, that is shown worse than the usual one."""
    if one.concentrated < max(ELSEWHERE, MORE * usual_part) or one.psnr >= usual_psnr:
        return []
    return [
        f"{one.concentrated:.0%} of its error lies in {FEW:.0%} of it: if only this photograph shows what is there, "
        "mask it (masks/)"
    ]
