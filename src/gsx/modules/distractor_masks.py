"""Masks of distractors: objects in front of the scene in a single photo, such as passers-by.

A model of a static scene shows what photos agree on. A block of a photo is a distractor if it differs from the render
by more than fine detail, and other photos that see the same place agree on another colour. Blocks that half of the
others confirm are errors of the model; blocks on which the others disagree are shiny or have a wrong depth. Sources:
RobustNeRF (Sabour et al. 2023), SpotLessSplats (Sabour et al. 2024), which uses features of a large network; here depth
finds the places. As its clusters of features, plain parts (a coat) are masked as a whole, since a model that has learnt
some of them differs little; so are colours that, over all photos, mostly distractors have.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d

from gsx.core.data.camera import Camera, centres_of
from gsx.core.shapes import Bool, Float, Int

Blocks: TypeAlias = Bool[Tensor, "h w"]
"""A set of blocks of a photo."""
Values: TypeAlias = Float[Tensor, "h w"]
"""A number of each block."""
Numbers: TypeAlias = Int[Tensor, "h w"]
"""An integer of each block."""

BLOCK = 2
"""Side of a block, px: finer differences are detail that the model has yet to learn."""
LEAST, TIMES = 0.06, 6.0
"""A difference is large if it exceeds LEAST, display values, and TIMES the median."""
ALIKE = 0.03
"""Differences below it, display values at one exposure, are none."""
MIDDLE = 4
"""Index of a block among the 3 x 3 around it, by rows."""
COVERED = 0.5
"""Least alpha of a block that has a depth."""
WITNESSES = 2
"""Fewest other photos that see a place."""
NEAREST = 12
"""Most other photos to compare with: those of the nearest cameras."""
HIDDEN = 1.05
"""A place is hidden from a camera beyond this many times the depth there."""
FAR = 100.0
"""Distance of the background, in times the largest depth."""
FEWEST = 3
"""Fewest blocks of a distractor among the 3 x 3 around each of its blocks."""
GROWTH = 3
"""Rounds in which neighbours join that differ by half as much."""
PLAIN = 0.02
"""Adjacent blocks whose colours differ by less, display values, belong to one part."""
SHARE = 0.3
"""Marked share of a plain part above which all of it is marked."""
COLOURS, MOSTLY = 32, 0.5
"""Bins of each channel; marked share of a bin's blocks, over all photos, above which its blocks are marked where most
neighbours are."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Difference:
    """A photo compared with its render, in blocks."""

    camera: Camera
    """Its pixels are the blocks."""
    off: Float[Tensor, "3 h w"]
    """Absolute mean differences, display values; 0 in masked blocks."""
    depth: Values
    """Camera z, scene units; inf for background."""
    counted: Blocks
    """Blocks of which all pixels count."""
    colours: Float[Tensor, "3 h w"]
    """Mean colours of the photo."""
    gains: Float[Tensor, "3"]
    """Brightness of the photo relative to the model."""

    @cached_property
    def size(self) -> Values:
        """Largest difference over channels."""
        return self.off.amax(0)

    @cached_property
    def evened_size(self) -> Values:
        """The same at the model's exposure."""
        return (self.off / self.gains[:, None, None]).amax(0)

    @cached_property
    def evened(self) -> Float[Tensor, "3 h w"]:
        """Colours at the model's exposure."""
        return self.colours / self.gains[:, None, None]


def difference_of(
    camera: Camera,
    image: Float[Tensor, "3 H W"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    photo: Float[Tensor, "3 H W"],
    mask: Bool[Tensor, "H W"] | None = None,
    gains: Float[Tensor, "3"] | None = None,
) -> Difference:
    """Compares a photo with a render of equal brightness.

    depth: blending-weighted sum of camera z, scene units. gains: brightness of the photo relative to the model.
    """
    width, height = (max(1, side // BLOCK) for side in camera.size)

    def by_block(values: Float[Tensor, "C H W"]) -> Float[Tensor, "C h w"]:
        return adaptive_avg_pool2d(values[None], (height, width))[0]

    off, weight, z = by_block(photo - image), by_block(alpha[None])[0], by_block(depth[None])[0]
    everything = torch.ones(height, width, dtype=torch.bool)
    whole = everything if mask is None else by_block(mask[None].float())[0] == 1
    return Difference(
        camera=camera.resize(width, height),
        off=off.abs() * whole,
        depth=torch.where(weight > COVERED, z / weight.clamp_min(COVERED), torch.inf),
        counted=whole,
        colours=by_block(photo),
        gains=torch.ones(3) if gains is None else gains,
    )


def distractors_in(differences: Sequence[Difference]) -> list[Blocks]:
    """Returns the blocks of each photo that show a distractor; none for too few photos."""
    if len(differences) <= WITNESSES:
        return [torch.zeros_like(one.counted) for one in differences]
    counted = torch.cat([one.size[one.counted] for one in differences])
    least = max(LEAST, TIMES * float(counted.median())) if len(counted) else LEAST
    centres = centres_of([one.camera for one in differences])
    found = []
    for number, own in enumerate(differences):
        order = (centres - centres[number]).norm(dim=1).argsort(stable=True)
        others = [differences[other] for other in order[order != number][:NEAREST].tolist()]
        there = witnesses(own, others)
        least_evened = own.evened_size.clamp_min(least / float(own.gains.mean()))
        open_blocks = ~(there.confirmed | there.disputed(least_evened))
        marked = whole_of(there.alone(own.evened_size) & (own.size > least), (own.size > least / 2) & open_blocks)
        found.append(with_plain_parts(marked, plain_parts(own.colours)) & open_blocks)
    return with_their_colours(found, [colour_bins(one.colours, one.counted) for one in differences])


@dataclass(frozen=True, eq=False, kw_only=True)
class Witnesses:
    """Colours of K other photos in the places that the blocks of one photo show."""

    sees: Bool[Tensor, "K h w"]
    """Places that are visible in each."""
    apart: Float[Tensor, "K h w"]
    """Difference of the photo's colour from the most similar of theirs, there or one block away; display values, the
    largest over channels."""
    off_middle: Float[Tensor, "K h w"]
    """Difference of theirs from the median of those that see the place, likewise; nan for others."""

    @cached_property
    def known(self) -> Blocks:
        """Places that at least WITNESSES of them see."""
        return self.sees.sum(0) >= WITNESSES

    @cached_property
    def confirmed(self) -> Blocks:
        """Known places where at least half of those that see them show the same colour."""
        return self.known & ~self.few(self.apart < ALIKE)

    def disputed(self, size: Values) -> Blocks:
        """Returns known places where at least half of those that see them differ from their median by `size`."""
        return self.known & ~self.few(self.off_middle >= size)

    def few(self, of: Bool[Tensor, "K h w"]) -> Blocks:
        """Returns the places where fewer than half of those that see them are in a set."""
        return (self.sees & of).sum(0) < self.sees.sum(0) / 2

    def alone(self, size: Values) -> Blocks:
        """Returns known places where most of them agree to `size` / 2, and few show the photo's colour to that."""
        return self.known & self.few(self.apart < size / 2) & self.few(self.off_middle >= size / 2)


def witnesses(own: Difference, others: Sequence[Difference]) -> Witnesses:
    """Looks up the places of one photo in others, at least one."""
    points, colours = places(own), own.evened.flatten(1)
    sees, apart, there = list[Tensor](), list[Tensor](), list[Tensor]()
    for other in others:
        visible, around = look_up(other, points)
        sees.append(visible)
        apart.append((colours[:, None] - around).abs().amax(0).amin(0))
        there.append(torch.where(visible, around[:, MIDDLE], torch.nan))
    middles = torch.stack(there)
    off_middle = (middles - middles.nanmedian(0).values).abs().amax(1)
    parts = [values.unflatten(1, own.size.shape) for values in (torch.stack(sees), torch.stack(apart), off_middle)]
    return Witnesses(sees=parts[0], apart=parts[1], off_middle=parts[2])


def places(own: Difference) -> Float[Tensor, "P 3"]:
    """Returns the world points of blocks; far away for background."""
    y, x = torch.meshgrid(*(torch.arange(side) + 0.5 for side in own.depth.shape), indexing="ij")
    known = own.depth[own.depth.isfinite()]
    far = FAR * (float(known.max()) if len(known) else own.camera.near)
    depth = torch.where(own.depth.isfinite(), own.depth, far)
    return own.camera.unproject(torch.stack([x, y], -1).flatten(0, 1), depth.flatten())


def look_up(other: Difference, points: Float[Tensor, "P 3"]) -> tuple[Bool[Tensor, "P"], Float[Tensor, "3 9 P"]]:
    """Returns (points visible in a photo; its colours in the 3 x 3 blocks around them, inf where masked)."""
    pixels, depths = other.camera.project(points)
    inside = other.camera.shows(pixels, depths)
    x, y = torch.where(inside[:, None], pixels, 0).long().unbind(1)
    sees = inside & other.counted[y, x] & (depths < HIDDEN * other.depth[y, x])
    height, width = other.size.shape
    rows = (y + torch.arange(-1, 2).repeat_interleave(3)[:, None]).clamp(0, height - 1)
    columns = (x + torch.arange(-1, 2).repeat(3)[:, None]).clamp(0, width - 1)
    return sees, torch.where(other.counted[rows, columns], other.evened[:, rows, columns], torch.inf)


def whole_of(marked: Blocks, weak: Blocks) -> Blocks:
    """Returns marked blocks that have marked neighbours, with the weak blocks that they touch."""
    kept = with_company(marked, FEWEST - 0.5)
    for _ in range(GROWTH):
        kept = kept | ((max_pool2d(kept[None].float(), 3, 1, 1)[0] > 0) & weak)
    return kept


def with_company(marked: Blocks, fewest: float) -> Blocks:
    """Returns marked blocks with more than `fewest` marked among the 3 x 3 around."""
    return marked & (9 * avg_pool2d(marked[None].float(), 3, 1, 1)[0] > fewest)


# -- plain parts -------------------------------------------------------------------------------------------------------


def plain_parts(colours: Float[Tensor, "3 h w"]) -> Numbers:
    """Labels connected parts in which colours change little between adjacent blocks by the number of their first."""
    height, width = colours.shape[1:]
    labels = torch.arange(height * width).reshape(height, width)
    every, first, rest = slice(None), slice(None, -1), slice(1, None)
    pairs = [((first, every), (rest, every)), ((every, first), (every, rest))]
    alike = [(colours[:, *one] - colours[:, *other]).abs().amax(0) < PLAIN for one, other in pairs]
    while True:
        before = labels.clone()
        for same, (one, other) in zip(alike, pairs, strict=True):
            for here, there in ((one, other), (other, one)):
                labels[here] = torch.where(same, torch.minimum(labels[here], labels[there]), labels[here])
        labels = labels.flatten()[labels]
        if torch.equal(labels, before):
            return labels


def with_plain_parts(marked: Blocks, parts: Numbers) -> Blocks:
    """Returns marked blocks and all parts that are marked by more than SHARE."""
    numbers = parts.flatten()
    count = numbers.bincount(minlength=len(numbers))
    hits = numbers.bincount(marked.flatten().double(), minlength=len(numbers))
    return marked | (hits > SHARE * count)[parts]


# -- colours of distractors --------------------------------------------------------------------------------------------


def colour_bins(colours: Float[Tensor, "3 h w"], counted: Blocks) -> Numbers:
    """Returns the bin of each colour; one more for all masked blocks."""
    red, green, blue = (colours * COLOURS).long().clamp(0, COLOURS - 1)
    return torch.where(counted, (red * COLOURS + green) * COLOURS + blue, COLOURS**3)


def with_their_colours(marked: Sequence[Blocks], colours: Sequence[Numbers]) -> list[Blocks]:
    """Returns marked blocks and, where most neighbours are marked, blocks of colours that mostly marked blocks have.

    A passer-by wears the same in several photos; a model that has learnt him in one differs little there.
    """
    bins, pairs = COLOURS**3 + 1, list(zip(marked, colours, strict=True))
    count = sum((own.flatten().bincount(minlength=bins) for own in colours), torch.zeros(bins))
    hits = sum((own[mark].bincount(minlength=bins) for mark, own in pairs), torch.zeros(bins))
    theirs = hits > MOSTLY * count
    return [mark | with_company(mark | theirs[own], 9 * MOSTLY) for mark, own in pairs]
