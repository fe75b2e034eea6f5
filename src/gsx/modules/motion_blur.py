"""By how much a camera moved while a photograph was exposed, by a sharp picture beside it (`modules.movement`).

With R and P the spectra of both and H that of a movement, P is near G H R. G, a gain by the size of the frequency,
stands for a sharp picture that is not as sharp as it should be: a model that learns from blurred photographs is blurred
itself, in all directions, and without G movements would be found too short. The best gains of a movement are known;
several movements are tried, and the one that leaves the least difference is taken. A model that is blurred along one
line, and photographs that are not, look as if these were moved across it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from gsx.core.shapes import Bool, Float, Int
from gsx.modules.movement import line_kernel, motion_blurred

DIRECTIONS, LENGTHS = 8, (2.0, 5.0, 12.0)
"""Movements that are tried at first, px."""
FIRST, FINEST = 1.0, 0.25
"""The first change that is tried along each axis from the best of them on, at least, and the last, px."""
MOST = 24.0
"""Longest movement along an axis, px."""
RINGS = 64
"""Of frequencies by their size, a cycle per px."""
EDGE = 6
"""Pictures fade out towards their edges, over one in so many of their pixels."""
MARGIN, ROUNDS = 8, 2
"""Px around what does not count that say nothing at first; how often it is filled in after that, by the sharp picture
after the movement that was found so far."""
SMALLEST = 32
"""Px of a side; smaller pictures have too few frequencies to tell anything by."""
SEEN = 0.1
"""Of how much a movement shows in a picture, the share that it has to show in a half of it, for that to say whether it
took place: it hardly shows on a plain wall, in the sky, or where little counts."""


@dataclass(frozen=True)
class Movement:
    """Of a camera during an exposure, and how well it explains the photograph."""

    across: float
    """Px to the right."""
    down: float
    """Px; both with the other sign are the same movement."""
    explained: float
    """Share of the squared difference between photograph and sharp picture at its best gains that is gone after it, in
    the half of the picture where it is least: a camera moves all of it. 0 where none is."""

    @property
    def length(self) -> float:
        """Px."""
        return math.hypot(self.across, self.down)

    def times(self, factor: float) -> "Movement":
        """In px so many times as small."""
        return Movement(self.across * factor, self.down * factor, self.explained)


@dataclass(frozen=True, eq=False, kw_only=True)
class Spectra:
    """Of a sharp picture R and a photograph P, [rows, columns] of half of all frequencies."""

    across: Float[Tensor, "w"]
    """Frequencies along rows, cycles per px."""
    down: Float[Tensor, "h"]
    """Along columns."""
    ring: Int[Tensor, "h w"]
    """By the frequency's size."""
    sharp: Float[Tensor, "h w"]
    """|R|^2, once for each frequency that it stands for; 0 of those above half a cycle per px."""
    shared: Float[Tensor, "h w"]
    """Re P R*, likewise."""
    photograph: float
    """|P|^2, likewise, summed."""


def movement_between(
    sharp: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None = None
) -> Movement:
    """The movement by which a sharp picture comes nearest to a photograph of the same exposure, over pixels that count;
    its gains by the size of the frequency are free. None where pictures are small."""
    if min(sharp.shape[1:]) < SMALLEST:
        return Movement(0.0, 0.0, explained=0.0)
    shown, taken, weight = sharp.mean(0), photograph.mean(0), None if counted is None else well_within(counted)
    telling = spectra_of(shown, taken, weight)
    found = descended(nearest([(0.0, 0.0), *fan()], telling), telling)
    if counted is not None:
        for _ in range(ROUNDS):
            filled = torch.where(counted, taken, motion_blurred(shown[None], *found)[0])
            found = descended(found, spectra_of(shown, filled, None))
    parts = [telling] if max(shown.shape) < 2 * SMALLEST else spectra_of_halves(shown, taken, weight)
    return Movement(*found, explained=explained_throughout(found, parts))


def explained_throughout(movement: tuple[float, float], parts: Sequence[Spectra]) -> float:
    """Share of the squared difference that is gone after a movement, px, in that of the parts of a picture where it is
    least, of those that it could be seen in; 0 where there is no less."""
    shown = [shown_by(movement, part) for part in parts]
    shares = [explained_by(movement, p) for p, share in zip(parts, shown, strict=True) if share > SEEN * sum(shown)]
    return max(0.0, min(shares, default=0.0))


def shown_by(movement: tuple[float, float], spectra: Spectra) -> float:
    """By how much a movement, px, shows: squared difference between the sharp picture after it and that at its best
    gains."""
    left = left_by(movement, spectra)
    photograph = float((spectra.sharp * left.square()).sum())
    return error_after((0.0, 0.0), replace(spectra, shared=spectra.sharp * left, photograph=photograph))


def explained_by(movement: tuple[float, float], spectra: Spectra) -> float:
    """Share of the squared difference that is gone after a movement, px; negative where there is more."""
    still = error_after((0.0, 0.0), spectra)
    return 1 - error_after(movement, spectra) / still if still > 0 else 0.0


# -- spectra -----------------------------------------------------------------------------------------------------------


def spectra_of(
    sharp: Float[Tensor, "H W"], photograph: Float[Tensor, "H W"], weight: Float[Tensor, "H W"] | None
) -> Spectra:
    """Of two pictures less their means, by a weight of their pixels; float64."""
    height, width = sharp.shape
    window = fading(height)[:, None] * fading(width)
    window = window if weight is None else window * weight
    r, p = (spectrum(values.double(), window) for values in (sharp, photograph))
    across, down = torch.fft.rfftfreq(width, dtype=torch.float64), torch.fft.fftfreq(height, dtype=torch.float64)
    size = torch.hypot(across, down[:, None])
    times = torch.where((across == 0) | (across == 0.5), 1, 2) * (size <= 0.5)  # rfft leaves out the other half
    return Spectra(
        across=across,
        down=down,
        ring=(RINGS * size).round().long(),
        sharp=times * (r * r.conj()).real,
        shared=times * (p * r.conj()).real,
        photograph=float((times * (p * p.conj()).real).sum()),
    )


def spectra_of_halves(
    sharp: Float[Tensor, "H W"], photograph: Float[Tensor, "H W"], weight: Float[Tensor, "H W"] | None
) -> list[Spectra]:
    """Of the halves of two pictures along their longer sides."""
    axis = int(sharp.shape[1] >= sharp.shape[0])
    weights = [None, None] if weight is None else list(weight.tensor_split(2, axis))
    halves = zip(sharp.tensor_split(2, axis), photograph.tensor_split(2, axis), weights, strict=True)
    return [spectra_of(shown, taken, part) for shown, taken, part in halves]


def well_within(counted: Bool[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Weights of pixels that fade out a margin before what does not count: an edge there would look as sharp in both
    pictures, and speak against every movement."""
    weight, side = counted[None].double(), MARGIN + 1
    weight = -max_pool2d(-weight, 2 * MARGIN + 1, 1, MARGIN)
    for _ in range(2):
        weight = avg_pool2d(weight, side, 1, side // 2)
    return weight[0]


def fading(count: int) -> Float[Tensor, "count"]:
    """One, down to zero at both ends (Tukey's window), float64."""
    end = max(1, count // EDGE)
    rise = 0.5 - 0.5 * torch.cos(math.pi * (torch.arange(end, dtype=torch.float64) + 0.5) / end)
    return torch.cat([rise, torch.ones(count - 2 * end, dtype=torch.float64), rise.flip(0)])


def spectrum(values: Float[Tensor, "H W"], window: Float[Tensor, "H W"]) -> Tensor:
    """Of values less their mean in a window, in it; complex."""
    mean = (values * window).sum() / window.sum().clamp_min(1e-12)
    return torch.fft.rfft2((values - mean) * window)


def left_by(movement: tuple[float, float], spectra: Spectra) -> Float[Tensor, "h w"]:
    """What the mean over a movement leaves of each frequency: its kernel's spectrum, real, as it has no direction."""
    kernel = line_kernel(*movement)
    offsets = 2 * math.pi * (torch.arange(len(kernel), dtype=torch.float64) - len(kernel) // 2)
    x, y = (along[:, None] * offsets for along in (spectra.across, spectra.down))
    return y.cos() @ kernel @ x.cos().T - y.sin() @ kernel @ x.sin().T


def error_after(movement: tuple[float, float], spectra: Spectra) -> float:
    """Squared difference that a movement, px, leaves, with the best gain of each ring."""
    left = left_by(movement, spectra)
    ring = spectra.ring.flatten()
    shared = torch.bincount(ring, (spectra.shared * left).flatten())
    sharp = torch.bincount(ring, (spectra.sharp * left.square()).flatten())
    explained = shared.clamp_min(0).square() / sharp.clamp_min(torch.finfo(sharp.dtype).tiny)
    return max(0.0, spectra.photograph - float(explained.sum()))


# -- movements ---------------------------------------------------------------------------------------------------------


def nearest(movements: Sequence[tuple[float, float]], spectra: Spectra) -> tuple[float, float]:
    """The first of the movements after which the difference is least."""
    return min(movements, key=lambda movement: error_after(movement, spectra))


def descended(start: tuple[float, float], spectra: Spectra) -> tuple[float, float]:
    """From one movement to ever better ones beside it, by ever smaller steps."""
    where, step = start, max(FIRST, math.hypot(*start) / 4)
    while step >= FINEST:
        better = nearest([where, *around(where, step)], spectra)
        step = step / 2 if better == where else step
        where = better
    return where


def fan() -> list[tuple[float, float]]:
    """Movements in all directions."""
    turns = [math.pi * turn / DIRECTIONS for turn in range(DIRECTIONS)]
    return [(length * math.cos(turn), length * math.sin(turn)) for length in LENGTHS for turn in turns]


def around(where: tuple[float, float], step: float) -> list[tuple[float, float]]:
    """Movements beside one, none longer than MOST along an axis."""
    beside = [(where[0] + x * step, where[1] + y * step) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]
    return [there for there in beside if max(map(abs, there)) <= MOST]
