"""By how many px one picture lies beside another, whatever their exposures."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from gsx.core.shapes import Bool, Float

ROUNDS, SMALLEST = 8, 24
"""Of the search for a shift at each size; the least side of a picture that is searched, px."""
BORDER = 4
"""Px at the borders that say nothing of it, beside the shift itself."""
ALIKE = 1e-3
"""Differences of display values below it, a quarter of what eight bits tell, are none."""
LEAST = 64
"""Pixels that tell it."""
SLOPED, FEW = 1 / 255, 0.05
"""Display values from px to px, from which on a pixel tells something: what is plain lies nowhere in particular. Fewer
than this share of all pixels do not stand for the others."""
TELLING = 1e-5
"""Least eigenvalue of the normal equations, of columns of length 1, from which on they tell a shift."""


def shift_of(
    render: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None
) -> tuple[float, float] | None:
    """Px to the right and down by which a photograph lies beside a render; None where nothing tells, or what is found
    explains no more than no shift does.

    The translation that explains their difference best, beside a gain and an offset: by least squares on slopes of the
    render, moved there again and again (Lucas and Kanade 1981), in which pixels that differ by more than the usual of
    those that have slopes count little; in pictures of a half and of a quarter of the size first, where those are large
    enough.
    """
    still, shown = grey(render), grey(photograph)
    inside = torch.ones_like(still, dtype=torch.bool) if counted is None else counted.to(still.device)
    found = shift_between(still, shown, inside)
    if found is None or mismatch(still, shown, inside, found) > mismatch(still, shown, inside, 0 * found) + ALIKE:
        return None
    return float(found[0]), float(found[1])


def shift_between(
    still: Float[Tensor, "H W"], shown: Float[Tensor, "H W"], inside: Bool[Tensor, "H W"]
) -> Float[Tensor, "2"] | None:
    """Coarse to fine; see `shift_of`."""
    start = None
    if min(still.shape) >= 2 * SMALLEST:
        half = [avg_pool2d(values[None].double(), 2)[0] for values in (still, shown, inside)]
        start = shift_between(half[0], half[1], half[2] == 1)
    return refined(still, shown, inside, still.new_zeros(2) if start is None else 2 * start)


def refined(
    still: Float[Tensor, "H W"], shown: Float[Tensor, "H W"], inside: Bool[Tensor, "H W"], shift: Float[Tensor, "2"]
) -> Float[Tensor, "2"] | None:
    """The shift found from one near to it; None where nothing tells, or it runs away."""
    residual = None
    for _ in range(ROUNDS):
        moved, told = translated(still, shift), inside & interior(still, float(shift.abs().max()))
        columns = torch.stack([central(moved, 1), central(moved, 0), moved, torch.ones_like(moved)])[:, told]
        residual = by_medians(moved, shown, told) if residual is None else residual
        fit = least_squares(columns, shown[told], robust(residual[told], sloped(columns)))
        if fit is None:
            return None
        residual = shown - fit[2] * moved - fit[3]
        shift = shift - fit[:2] / fit[2]
        if not bool(shift.abs().max() < min(still.shape) / 4):
            return None
    return shift


def mismatch(
    still: Float[Tensor, "H W"], shown: Float[Tensor, "H W"], inside: Bool[Tensor, "H W"], shift: Float[Tensor, "2"]
) -> float:
    """Median of what a shift leaves, beside a gain and an offset; infinite where nothing tells."""
    moved, told = translated(still, shift), inside & interior(still, float(shift.abs().max()))
    weights = robust(by_medians(moved, shown, told)[told])
    fit = least_squares(torch.stack([moved, torch.ones_like(moved)])[:, told], shown[told], weights)
    return math.inf if fit is None else float((shown - fit[0] * moved - fit[1])[told].abs().median())


def by_medians(
    image: Float[Tensor, "*S"], wanted: Float[Tensor, "*S"], told: Bool[Tensor, "*S"]
) -> Float[Tensor, "*S"]:
    """wanted - image, brought to the same median."""
    if not told.any():
        return wanted - image
    return wanted - image * (wanted[told].median() / image[told].median().clamp_min(1e-6))


def robust(residual: Float[Tensor, "P"], telling: Bool[Tensor, "P"] | None = None) -> Float[Tensor, "P"]:
    """Weights of pixels: less than half for a residual beyond the median of those that tell something, or of all where
    these are few (Cauchy)."""
    few = telling is None or int(telling.sum()) < max(LEAST, FEW * len(residual))
    usual = (residual if few else residual[telling]).abs().median()
    return 1 / (1 + (residual / (usual + 1e-4)).square())


def sloped(slopes: Float[Tensor, "C P"]) -> Bool[Tensor, "P"]:
    """Pixels whose first two values, slopes along the axes, say that they are not plain."""
    return slopes[:2].abs().amax(0) > SLOPED


def grey(image: Float[Tensor, "3 H W"]) -> Float[Tensor, "H W"]:
    """Mean of the channels, a little smoothed: slopes then hold over a pixel or two."""
    return avg_pool2d(image.double().mean(0)[None], 3, stride=1, padding=1, count_include_pad=False)[0]


def translated(image: Float[Tensor, "H W"], shift: Float[Tensor, "2"]) -> Float[Tensor, "H W"]:
    """The image moved by so many px to the right and down."""
    height, width = image.shape
    y, x = torch.meshgrid(*(torch.arange(n, device=image.device).double() + 0.5 for n in image.shape), indexing="ij")
    places = torch.stack([2 * (x - shift[0]) / width - 1, 2 * (y - shift[1]) / height - 1], -1)
    return grid_sample(image[None, None], places[None], mode="bicubic", padding_mode="border", align_corners=False)[
        0, 0
    ]


def central(image: Float[Tensor, "H W"], axis: int) -> Float[Tensor, "H W"]:
    """Central differences along an axis."""
    return (image.roll(-1, axis) - image.roll(1, axis)) / 2


def interior(image: Float[Tensor, "H W"], shift: float) -> Bool[Tensor, "H W"]:
    """Pixels that are not near a border."""
    edge = BORDER + math.ceil(shift)
    out = torch.zeros_like(image, dtype=torch.bool)
    out[edge : image.shape[0] - edge, edge : image.shape[1] - edge] = True
    return out


def least_squares(
    columns: Float[Tensor, "C P"], wanted: Float[Tensor, "P"], weights: Float[Tensor, "P"]
) -> Float[Tensor, "C"] | None:
    """The factors that bring the sum of columns closest to what is wanted; None where the columns cannot tell them."""
    if columns.shape[1] < LEAST:
        return None
    scale = columns.square().mean(1).sqrt()
    if not bool((scale > 1e-6).all()):
        return None
    unit = columns / scale[:, None]
    system = (unit * weights) @ unit.T / weights.sum()
    if not bool(torch.linalg.eigvalsh(system)[0] > TELLING):
        return None
    return torch.linalg.solve(system, (unit * weights) @ wanted / weights.sum()) / scale
