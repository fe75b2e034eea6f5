"""What stands before the scene in one photograph alone: who passes by, what moves.

A model of a static scene shows what photographs agree on. Where one of them differs from it by more than fine detail,
and the photographs that see the same place agree on another colour there, something was in the way (distractors:
RobustNeRF, Sabour et al. 2023; SpotLessSplats, Sabour et al. 2024, which tell them by features of a large network; here
by the places that depth tells). Where others show the same colour there it is the model that is wrong; where they show
many, what is there shines, or its depth is wrong. What is plain, a coat for example, goes as a whole (as clusters of
features do there): a model that has learnt a piece of it differs little there. So do colours that photographs show
mostly where something was in the way: somebody wears the same in all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d

from gsx.core.data.camera import Camera
from gsx.core.shapes import Bool, Float, Int

BLOCK = 2
"""Px of a picture that are looked at as one: finer differences are detail that the model has yet to learn."""
LEAST, TIMES = 0.06, 6.0
"""A difference, display values, that stands out: at least so much, and so many times the usual."""
ALIKE = 0.03
"""Colours that differ by less, display values at one exposure, are the same."""
MIDDLE = 4
"""Of a block and the eight around it, by rows."""
COVERED = 0.5
"""Alpha of a block that has a depth."""
WITNESSES = 2
"""Other photographs, at least, that have to see a place."""
NEAREST = 12
"""Other photographs, at most, that are asked: of the nearest cameras."""
HIDDEN = 1.05
"""A place farther than so many times the depth that a camera is shown there is hidden from it."""
FAR = 100.0
"""What lies behind everything is so many times as far as the farthest of it."""
FEWEST = 3
"""Blocks of a distractor, of the nine around each of its own."""
GROWTH = 3
"""Rounds in which neighbours join that differ by half as much."""
PLAIN = 0.02
"""Blocks side by side whose colours differ by less, display values, are of one thing."""
SHARE = 0.3
"""Of a thing that is marked, from which on all of it is."""
COLOURS, MOSTLY = 32, 0.5
"""Bins of each channel; share of all blocks of a bin, over photographs, from which on, where so many are marked, all of
them are."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Difference:
    """A photograph against the model's render of it, in blocks."""

    camera: Camera
    """Whose pixels are the blocks."""
    off: Float[Tensor, "3 h w"]
    """Sizes of mean differences; display values; 0 in blocks that do not count."""
    depth: Float[Tensor, "h w"]
    """Camera z, scene units; inf where nothing is."""
    counted: Bool[Tensor, "h w"]
    """Blocks of which all pixels count."""
    colours: Float[Tensor, "3 h w"]
    """Means of the photograph."""
    gains: Float[Tensor, "3"]
    """How many times as bright as the model the photograph is."""

    @cached_property
    def size(self) -> Float[Tensor, "h w"]:
        """Of the difference, largest over channels."""
        return self.off.amax(0)

    @cached_property
    def evened_size(self) -> Float[Tensor, "h w"]:
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
    photograph: Float[Tensor, "3 H W"],
    counted: Bool[Tensor, "H W"] | None = None,
    gains: Float[Tensor, "3"] | None = None,
) -> Difference:
    """A photograph against a render that is as bright; depth: blending-weighted sum of camera z, scene units, as the
    rasterizer has it; gains: how many times as bright as the model the photograph is (None: as bright)."""
    width, height = (max(1, side // BLOCK) for side in camera.size)

    def by_block(values: Float[Tensor, "C H W"]) -> Float[Tensor, "C h w"]:
        return adaptive_avg_pool2d(values[None], (height, width))[0]

    off, weight, z = by_block(photograph - image), by_block(alpha[None])[0], by_block(depth[None])[0]
    everything = torch.ones(height, width, dtype=torch.bool)
    whole = everything if counted is None else by_block(counted[None].float())[0] == 1
    return Difference(
        camera=camera.resize(width, height),
        off=off.abs() * whole,
        depth=torch.where(weight > COVERED, z / weight.clamp_min(COVERED), torch.inf),
        counted=whole,
        colours=by_block(photograph),
        gains=torch.ones(3) if gains is None else gains,
    )


def distractors_in(differences: Sequence[Difference]) -> list[Bool[Tensor, "h w"]]:
    """Which blocks of each photograph show a distractor; none where there are too few others to tell by."""
    if len(differences) <= WITNESSES:
        return [torch.zeros_like(one.counted) for one in differences]
    counted = torch.cat([one.size[one.counted] for one in differences])
    least = max(LEAST, TIMES * float(counted.median())) if len(counted) else LEAST
    centres = torch.stack([one.camera.centre.double() for one in differences])
    found = []
    for number, own in enumerate(differences):
        order = (centres - centres[number]).norm(dim=1).argsort(stable=True)
        others = [differences[other] for other in order[order != number][:NEAREST].tolist()]
        told = witnesses(own, others)
        least_evened = own.evened_size.clamp_min(least / float(own.gains.mean()))
        unsettled = ~(told.confirmed | told.disputed(least_evened))
        marked = whole_of(told.alone(own.evened_size) & (own.size > least), (own.size > least / 2) & unsettled)
        found.append(with_plain_parts(marked, plain_parts(own.colours)) & unsettled)
    return with_their_colours(found, [colour_bins(one.colours, one.counted) for one in differences])


@dataclass(frozen=True, eq=False, kw_only=True)
class Witnesses:
    """What up to K other photographs show in the places that the blocks of one show."""

    sees: Bool[Tensor, "K h w"]
    """Whether a place is in their sight."""
    apart: Float[Tensor, "K h w"]
    """By how much the one's colour differs from the most alike of theirs there or in a block beside; display values,
    the largest over channels."""
    off_middle: Float[Tensor, "K h w"]
    """By how much each of theirs differs from the median of those that see the place, likewise; nan for others."""

    @cached_property
    def known(self) -> Bool[Tensor, "h w"]:
        """Where at least WITNESSES of them see the place."""
        return self.sees.sum(0) >= WITNESSES

    @cached_property
    def confirmed(self) -> Bool[Tensor, "h w"]:
        """Where enough see the place, and at least half of those show the same."""
        return self.known & ~self.few(self.apart < ALIKE)

    def disputed(self, size: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
        """Where enough see the place, and half of those differ by that size from the middle of them, or more."""
        return self.known & ~self.few(self.off_middle >= size)

    def few(self, of: Bool[Tensor, "K h w"]) -> Bool[Tensor, "h w"]:
        """Where fewer than half of those that see it are of these."""
        return (self.sees & of).sum(0) < self.sees.sum(0) / 2

    def alone(self, size: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
        """Where most of them agree to half of that size, and few show the one's colour to half of it; display values
        at the model's exposure."""
        return self.known & self.few(self.apart < size / 2) & self.few(self.off_middle >= size / 2)


def witnesses(own: Difference, others: Sequence[Difference]) -> Witnesses:
    """What other photographs, at least one, show in the places of one."""
    points, colours = places(own), own.evened.flatten(1)
    sees, apart, there = list[Tensor](), list[Tensor](), list[Tensor]()
    for other in others:
        seen, around = looked_up(other, points)
        sees.append(seen)
        apart.append((colours[:, None] - around).abs().amax(0).amin(0))
        there.append(torch.where(seen, around[:, MIDDLE], torch.nan))
    shown = torch.stack(there)
    told = {"sees": torch.stack(sees), "apart": torch.stack(apart)}
    told["off_middle"] = (shown - shown.nanmedian(0).values).abs().amax(1)
    return Witnesses(**{name: values.unflatten(1, own.size.shape) for name, values in told.items()})


def places(own: Difference) -> Float[Tensor, "P 3"]:
    """World points that blocks show; far away where nothing is."""
    y, x = torch.meshgrid(*(torch.arange(side) + 0.5 for side in own.depth.shape), indexing="ij")
    known = own.depth[own.depth.isfinite()]
    far = FAR * (float(known.max()) if len(known) else own.camera.near)
    depth = torch.where(own.depth.isfinite(), own.depth, far)
    return own.camera.unproject(torch.stack([x, y], -1).flatten(0, 1), depth.flatten())


def looked_up(other: Difference, points: Float[Tensor, "P 3"]) -> tuple[Bool[Tensor, "P"], Float[Tensor, "3 9 P"]]:
    """(which points a photograph sees, in front of or on what the model shows it; its colours there (MIDDLE) and in the
    blocks around, inf where these do not count)."""
    pixels, depths = other.camera.project(points)
    inside = other.camera.shows(pixels, depths)
    x, y = torch.where(inside[:, None], pixels, 0).long().unbind(1)
    sees = inside & other.counted[y, x] & (depths < HIDDEN * other.depth[y, x])
    height, width = other.size.shape
    rows = (y + torch.arange(-1, 2).repeat_interleave(3)[:, None]).clamp(0, height - 1)
    columns = (x + torch.arange(-1, 2).repeat(3)[:, None]).clamp(0, width - 1)
    return sees, torch.where(other.counted[rows, columns], other.evened[:, rows, columns], torch.inf)


def whole_of(marked: Bool[Tensor, "h w"], weak: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Marked blocks that have company, with the weak ones that they touch."""
    kept = with_company(marked, FEWEST - 0.5)
    for _ in range(GROWTH):
        kept = kept | ((spread(kept.float()) > 0) & weak)
    return kept


def with_company(marked: Bool[Tensor, "h w"], fewest: float) -> Bool[Tensor, "h w"]:
    """Marked blocks of which more than so many of the nine around are marked."""
    return marked & (9 * avg_pool2d(marked[None].float(), 3, 1, 1)[0] > fewest)


def spread(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The largest of each block and those around it."""
    return max_pool2d(values[None], 3, 1, 1)[0]


# -- plain things ------------------------------------------------------------------------------------------------------


def plain_parts(colours: Float[Tensor, "3 h w"]) -> Int[Tensor, "h w"]:
    """A number for each part of a picture in which colours change little from block to block: that of its first."""
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


def with_plain_parts(marked: Bool[Tensor, "h w"], parts: Int[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Marked blocks, and parts of the picture of which so many are marked that all of them are meant."""
    numbers = parts.flatten()
    count = numbers.bincount(minlength=len(numbers))
    hits = numbers.bincount(marked.flatten().double(), minlength=len(numbers))
    return marked | (hits > SHARE * count)[parts]


# -- colours that distractors have -------------------------------------------------------------------------------------


def colour_bins(colours: Float[Tensor, "3 h w"], counted: Bool[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """The bin of each colour; one of its own for all blocks that do not count."""
    red, green, blue = (colours * COLOURS).long().clamp(0, COLOURS - 1)
    return torch.where(counted, (red * COLOURS + green) * COLOURS + blue, COLOURS**3)


def with_their_colours(
    marked: Sequence[Bool[Tensor, "_ _"]], colours: Sequence[Int[Tensor, "_ _"]]
) -> list[Bool[Tensor, "_ _"]]:
    """Marked blocks, and those of colours that, over all photographs, are mostly those of marked blocks, if most around
    them are marked as well: who walks through several photographs wears the same in all, and a model that has learnt
    them in one tells them in others."""
    everywhere, there = COLOURS**3 + 1, list(zip(marked, colours, strict=True))
    count = sum((own.flatten().bincount(minlength=everywhere) for own in colours), torch.zeros(everywhere))
    hits = sum((own[mark].bincount(minlength=everywhere) for mark, own in there), torch.zeros(everywhere))
    theirs = hits > MOSTLY * count
    return [mark | with_company(mark | theirs[own], 9 * MOSTLY) for mark, own in there]
