"""Motion blur of photos: the mean of an image over a line, its gradient, and an estimate of the line.

A turn of the camera moves the whole image equally, at any depth, and in a short time about evenly along a line: the
photo is the mean of the sharp image over that line, the movement.

The estimate compares a photo with a sharp image. With spectra R of the sharp image, P of the photo and H of a movement,
P is near G H R. The gain G, one per size of frequency, stands for a sharp image that is not sharp enough: a model that
learns from blurred photos is blurred in all directions, and without G movements would come out too short. The best
gains of a movement have a closed form; the estimate is the movement with the least difference. A model that is blurred
along one line, with photos that are not, looks like photos moved across that line.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd import Function
from torch.nn.functional import avg_pool2d, max_pool2d, pad

from gsx.core.shapes import Bool, Float, Int

Image: TypeAlias = Float[Tensor, "C H W"]
Grey: TypeAlias = Float[Tensor, "H W"]
Spectrum: TypeAlias = Float[Tensor, "h w"]
"""Half of all frequencies, [rows, columns], as `torch.fft.rfft2` has them."""

SAMPLES = 4
"""Points on a movement per px."""
DAMPING = 0.05
"""Damping of sharpened gradients: suppresses frequencies that blur reduces below the root of it."""
REACH = 4
"""Padding of a sharpened gradient, in sizes of the kernel."""
DIRECTIONS, LENGTHS = 8, (2.0, 5.0, 12.0)
"""Movements that the search starts from: directions, lengths in px."""
FIRST_STEP, LAST_STEP = 1.0, 0.25
"""Smallest first step of the descent, and last step, px."""
LONGEST = 24.0
"""Longest movement along an axis, px."""
RINGS = 64
"""Rings of frequencies by size, per cycle per px."""
EDGE = 6
"""Images fade out towards their edges over one in this many pixels."""
MARGIN, ROUNDS = 8, 2
"""Width of the zone around masked pixels that is ignored at first, px; rounds that then fill masked pixels in with the
sharp image, moved."""
MIN_SIDE = 32
"""Smallest side of an image that is searched, px: smaller ones have too few frequencies."""
VISIBLE = 0.1
"""Least share of a movement's effect that a half of the image must have to count: plain walls, sky and masked parts
hardly change."""


# -- blur --------------------------------------------------------------------------------------------------------------


def line_kernel(across: float, down: float) -> Float[Tensor, "K K"]:
    """Returns the weights of the mean over a movement, centred, float64: points on it, each bilinear in four pixels."""
    count = max(1, math.ceil(SAMPLES * math.hypot(across, down)))
    along = (torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5
    radius = math.ceil(max(abs(across), abs(down)) / 2)
    places = torch.stack([down * along, across * along], 1) + radius
    first = places.floor()
    (up, left), (low, right) = (part.unbind(1) for part in (1 - (places - first), places - first))
    kernel = torch.zeros(2 * radius + 2, 2 * radius + 2, dtype=torch.float64)
    row, column = first.long().unbind(1)
    for rows, of_row in ((0, up), (1, low)):
        for columns, of_column in ((0, left), (1, right)):
            kernel.index_put_((row + rows, column + columns), of_row * of_column / count, accumulate=True)
    return kernel[: 2 * radius + 1, : 2 * radius + 1]


def motion_blurred(image: Image, across: float, down: float) -> Image:
    """Returns the mean of an image over a movement, px; edge pixels continue beyond its edges."""
    kernel = line_kernel(across, down)
    side, (height, width) = len(kernel) // 2, image.shape[1:]
    if side == 0:
        return image
    around, total = pad(image[None], (side, side, side, side), mode="replicate")[0], torch.zeros_like(image)
    for row, column in kernel.nonzero().tolist():
        weight = float(kernel[row, column])
        total = torch.add(total, around[:, row : row + height, column : column + width], alpha=weight)
    return total


class SharpenedBlur(Function):
    """`motion_blurred` with the gradient of `sharpened`.

    With K the mean over the movement, the slope of a loss with gradient g is K^T g: blur weights details down twice,
    and they are learnt last. The gradient here is (1 + d) (K^T K + d)^-1 K^T g, the Gauss-Newton direction for the
    sharp image, damped by d (Levenberg 1944). Away from the edges it descends, too; without blur it is the slope; it is
    at most (1 + d) / (2 sqrt d) times as large as g.
    """

    @staticmethod
    def forward(ctx: Any, image: Image, across: float, down: float) -> Image:
        ctx.movement = across, down
        return motion_blurred(image, across, down)

    @staticmethod
    def backward(ctx: Any, gradient: Image) -> tuple[Image, None, None]:
        return sharpened(gradient, *ctx.movement), None, None


def sharpened(gradient: Image, across: float, down: float) -> Image:
    """Returns (1 + d) (K^T K + d)^-1 K^T of a gradient, by its spectrum; zero beyond its edges."""
    kernel, (height, width) = line_kernel(across, down).to(gradient), gradient.shape[1:]
    side, beyond = len(kernel) // 2, REACH * len(kernel)
    size = height + beyond, width + beyond
    around = pad(kernel, (0, size[1] - len(kernel), 0, size[0] - len(kernel))).roll((-side, -side), (0, 1))
    share = torch.fft.rfft2(around).real  # transfer function; real, since movements have no direction
    factor = (1 + DAMPING) * share / (share.square() + DAMPING)
    return torch.fft.irfft2(factor * torch.fft.rfft2(gradient, s=size), s=size)[:, :height, :width].contiguous()


# -- estimate ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Movement:
    """A camera's movement during an exposure, and how well it explains the photo."""

    across: float
    """To the right, px."""
    down: float
    """Px; both negated are the same movement."""
    explained: float
    """Share of the squared difference between photo and sharp image, at best gains, that the movement removes, in the
    half of the image with the smaller share: a camera moves both. 0: no movement."""

    @property
    def length(self) -> float:
        """Length, px."""
        return math.hypot(self.across, self.down)

    def scaled(self, factor: float) -> "Movement":
        """Returns the movement times a factor."""
        return Movement(self.across * factor, self.down * factor, self.explained)


@dataclass(frozen=True, eq=False, kw_only=True)
class Spectra:
    """Spectra of a sharp image R and a photo P."""

    across: Float[Tensor, "w"]
    """Frequencies along rows, cycles per px."""
    down: Float[Tensor, "h"]
    """Frequencies along columns, cycles per px."""
    ring: Int[Tensor, "h w"]
    """Ring of each frequency."""
    sharp: Spectrum
    """|R|^2 times the number of frequencies that each stands for; 0 above half a cycle per px."""
    shared: Spectrum
    """Re P R*, likewise."""
    photo: float
    """Sum of |P|^2, likewise."""


def movement_between(
    sharp: Float[Tensor, "3 H W"], photo: Float[Tensor, "3 H W"], mask: Bool[Tensor, "H W"] | None = None
) -> Movement:
    """Estimates the movement from a sharp image to a photo of equal exposure, over pixels that count.

    Returns no movement for small images.
    """
    if min(sharp.shape[1:]) < MIN_SIDE:
        return Movement(0.0, 0.0, explained=0.0)
    source, target, weight = sharp.mean(0), photo.mean(0), None if mask is None else interior_weights(mask)
    spectra = spectra_of(source, target, weight)
    turns = [math.pi * turn / DIRECTIONS for turn in range(DIRECTIONS)]
    first = [(length * math.cos(turn), length * math.sin(turn)) for length in LENGTHS for turn in turns]
    movement = descend(best([(0.0, 0.0), *first], spectra), spectra)
    if mask is not None:
        for _ in range(ROUNDS):
            filled = torch.where(mask, target, motion_blurred(source[None], *movement)[0])
            movement = descend(movement, spectra_of(source, filled, None))
    parts = [spectra] if max(source.shape) < 2 * MIN_SIDE else spectra_of_halves(source, target, weight)
    return Movement(*movement, explained=least_explained(movement, parts))


def least_explained(movement: tuple[float, float], parts: Sequence[Spectra]) -> float:
    """Returns the smallest explained share of the parts in which a movement, px, is visible; at least 0."""
    effects = [effect(movement, part) for part in parts]
    shares = [explained(movement, p) for p, size in zip(parts, effects, strict=True) if size > VISIBLE * sum(effects)]
    return max(0.0, min(shares, default=0.0))


def effect(movement: tuple[float, float], spectra: Spectra) -> float:
    """Returns the squared difference between the sharp image after a movement, px, and before it, at best gains."""
    factor = kernel_spectrum(movement, spectra)
    photo = float((spectra.sharp * factor.square()).sum())
    return error_after((0.0, 0.0), replace(spectra, shared=spectra.sharp * factor, photo=photo))


def explained(movement: tuple[float, float], spectra: Spectra) -> float:
    """Returns the share of the squared difference that a movement, px, removes; negative where it adds."""
    still = error_after((0.0, 0.0), spectra)
    return 1 - error_after(movement, spectra) / still if still > 0 else 0.0


# -- spectra -----------------------------------------------------------------------------------------------------------


def spectra_of(sharp: Grey, photo: Grey, weight: Grey | None) -> Spectra:
    """Returns the spectra of two images less their means, with weights of their pixels; float64."""
    height, width = sharp.shape
    window = tukey_window(height)[:, None] * tukey_window(width)
    window = window if weight is None else window * weight
    r, p = (windowed_spectrum(values.double(), window) for values in (sharp, photo))
    across, down = torch.fft.rfftfreq(width, dtype=torch.float64), torch.fft.fftfreq(height, dtype=torch.float64)
    size = torch.hypot(across, down[:, None])
    times = torch.where((across == 0) | (across == 0.5), 1, 2) * (size <= 0.5)  # rfft leaves out the other half
    return Spectra(
        across=across,
        down=down,
        ring=(RINGS * size).round().long(),
        sharp=times * (r * r.conj()).real,
        shared=times * (p * r.conj()).real,
        photo=float((times * (p * p.conj()).real).sum()),
    )


def spectra_of_halves(sharp: Grey, photo: Grey, weight: Grey | None) -> list[Spectra]:
    """Returns the spectra of the halves of two images along their longer sides."""
    axis = int(sharp.shape[1] >= sharp.shape[0])
    weights = [None, None] if weight is None else list(weight.tensor_split(2, axis))
    halves = zip(sharp.tensor_split(2, axis), photo.tensor_split(2, axis), weights, strict=True)
    return [spectra_of(*half) for half in halves]


def interior_weights(mask: Bool[Tensor, "H W"]) -> Grey:
    """Returns weights that fade out before masked pixels: an edge there is sharp in both images and hides movements."""
    weight, side = mask[None].double(), MARGIN + 1
    weight = -max_pool2d(-weight, 2 * MARGIN + 1, 1, MARGIN)
    for _ in range(2):
        weight = avg_pool2d(weight, side, 1, side // 2)
    return weight[0]


def tukey_window(count: int) -> Float[Tensor, "count"]:
    """Returns 1, falling to 0 at both ends, float64."""
    end = max(1, count // EDGE)
    rise = 0.5 - 0.5 * torch.cos(math.pi * (torch.arange(end, dtype=torch.float64) + 0.5) / end)
    return torch.cat([rise, torch.ones(count - 2 * end, dtype=torch.float64), rise.flip(0)])


def windowed_spectrum(values: Grey, window: Grey) -> Tensor:
    """Returns the complex spectrum of values less their mean in a window, times the window."""
    mean = (values * window).sum() / window.sum().clamp_min(1e-12)
    return torch.fft.rfft2((values - mean) * window)


def kernel_spectrum(movement: tuple[float, float], spectra: Spectra) -> Spectrum:
    """Returns the transfer function of the mean over a movement; real, as it has no direction."""
    kernel = line_kernel(*movement)
    offsets = 2 * math.pi * (torch.arange(len(kernel), dtype=torch.float64) - len(kernel) // 2)
    x, y = (along[:, None] * offsets for along in (spectra.across, spectra.down))
    return y.cos() @ kernel @ x.cos().T - y.sin() @ kernel @ x.sin().T


def error_after(movement: tuple[float, float], spectra: Spectra) -> float:
    """Returns the squared difference after a movement, px, at the best gain of each ring."""
    factor = kernel_spectrum(movement, spectra)
    ring = spectra.ring.flatten()
    shared = torch.bincount(ring, (spectra.shared * factor).flatten())
    sharp = torch.bincount(ring, (spectra.sharp * factor.square()).flatten())
    removed = shared.clamp_min(0).square() / sharp.clamp_min(torch.finfo(sharp.dtype).tiny)
    return max(0.0, spectra.photo - float(removed.sum()))


# -- search ------------------------------------------------------------------------------------------------------------


def best(movements: Sequence[tuple[float, float]], spectra: Spectra) -> tuple[float, float]:
    """Returns the first of the movements with the least difference."""
    return min(movements, key=lambda movement: error_after(movement, spectra))


def descend(start: tuple[float, float], spectra: Spectra) -> tuple[float, float]:
    """Descends from a movement by ever smaller steps."""
    where, step = start, max(FIRST_STEP, math.hypot(*start) / 4)
    while step >= LAST_STEP:
        better = best([where, *neighbours(where, step)], spectra)
        step = step / 2 if better == where else step
        where = better
    return where


def neighbours(where: tuple[float, float], step: float) -> list[tuple[float, float]]:
    """Returns the movements one step around another, up to LONGEST along an axis."""
    moves = [(where[0] + x * step, where[1] + y * step) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]
    return [move for move in moves if max(map(abs, move)) <= LONGEST]
