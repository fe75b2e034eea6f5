"""The compiled path: the picture and gradient of composite.py through loops that are compiled once (kernels.py).

Two schedules of the same mathematics. `chunks`: front to back, one chunk of all groups of lists at a time, and groups
whose pixels have all ended leave; light is found first in lists that are cut into pieces (lanes.py). `segments`: all
blocks of all tiles at once (segments.py).
"""

import functools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.rasterizer.composite import composite_eager
from gsx.core.rasterizer.grid import Basis, TileGrid, basis_of, inside_of
from gsx.core.rasterizer.intersections import TileIntersections, sum_by_splat
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.rasterizer.settings import NOTHING, Precision, RasterSettings
from gsx.core.shapes import Float, Int
from gsx.engine.backend import COMPILED
from gsx.engine.compile_cache import recording
from gsx.engine.compiling import available, complaint
from gsx.engine.kernels import TABLE, Kernels, Rules, exp_polynomial, kernels, seen_from_front
from gsx.engine.lanes import LANES, Lanes, centres, from_lanes, lay_out, places_of, to_lanes
from gsx.engine.segments import SegmentComposite, cut, parts, segment_job

logger = logging.getLogger(__name__)

MOST_CHANNELS = 8
"""Channels are unrolled: beyond this number compilation takes longer than it saves."""
CHECK_EVERY = 4
"""Chunks between looks at which groups have ended."""
VALUES, VALUES_OF_A_GPU = 1 << 22, 1 << 26
"""Alpha values at once where `compiled_values` leaves it to the device, a CPU or not."""
WORTH_LEAVING = 0.75
"""Groups are picked out when at most this share of them is still going: picking costs a copy."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Job:
    """One picture to blend."""

    lanes: Lanes
    grid: TileGrid
    basis: Basis
    centre: Float[Tensor, "S 2 1 L"]
    loops: Kernels
    rules: Rules
    precision: Precision
    batch: int
    """Groups worked on at once."""
    learning: bool
    """Whether there will be a way back."""


def rules_of(settings: RasterSettings, channels: int, absolute: bool, evaluation: torch.dtype, device: str) -> Rules:
    """What the compiled code depends on."""
    powers, squarings = exp_polynomial(math.log(settings.alpha_min))
    return Rules(
        tile_size=settings.tile_size,
        chunk=settings.unrolled,
        channels=channels,
        alpha_min=settings.alpha_min,
        alpha_max=settings.alpha_max,
        stop=settings.transmittance_stop,
        evaluation=evaluation,
        absolute=absolute,
        device=device,
        powers=powers,
        squarings=squarings,
    )


def padded_table(
    means: Tensor, conic_factors: Tensor, log_opacities: Tensor, channels: Tensor
) -> Float[Tensor, "M_1 F"]:
    """Everything blending needs of each splat in one row, and last a row that draws nothing."""
    table = torch.cat([means, conic_factors, log_opacities[:, None], channels], 1)
    nothing = table.new_zeros(1, table.shape[1])
    nothing[:, TABLE - 1].fill_(NOTHING)  # an assignment might copy the number from the host
    return torch.cat([table, nothing])


# -- chunks --------------------------------------------------------------------------------------------------------


Where: TypeAlias = range | Int[Tensor, "B"]
"""Rows that follow each other, or indices once groups have left."""


@dataclass(frozen=True, eq=False)
class Stage:
    """One chunk of some groups of a batch."""

    blocks: Where
    groups: Where
    previous: Where | None
    """Blocks of the same groups one chunk before."""


class Rows:
    """A tensor by its rows, of which the same are wanted again and again: a view takes as long as a small chunk."""

    def __init__(self, values: Float[Tensor, "N *rest"]) -> None:
        self.values, self.views = values, dict[range, Tensor]()

    def take(self, where: Where) -> Float[Tensor, "B *rest"]:
        """Rows as a view of something: torch compiles anew for arguments that are no views."""
        if not isinstance(where, range):
            return self.values[where][:]
        view = self.views.get(where)
        if view is None:
            view = self.views[where] = self.values[where.start : where.stop]
        return view


@dataclass(frozen=True, eq=False)
class Chunks:
    """What the chunk schedule keeps for its way back."""

    stages: list[Stage]
    rows: Rows
    """What blending reads of every entry, [S K F L]."""
    front: Rows
    """Transmittance in front of every list, 0 at pixels of border tiles beyond the raster, [G P L]."""
    after: Rows
    """Transmittance behind every block, [S P L]."""
    pieces: tuple[Float[Tensor, "G P L"], list[Float[Tensor, "G P L"]]] | None
    """(share of the light that passes each list which another piece follows, what every list adds to the channels and
    the coverage); None where no list is cut."""

    def before(self, stage: Stage) -> Float[Tensor, "B P L"]:
        """Transmittance in front of a stage's blocks."""
        return self.front.take(stage.groups) if stage.previous is None else self.after.take(stage.previous)


def stage_of(job: Job, number: int, batch: slice, left: Int[Tensor, "B"] | None) -> Stage | None:
    """Chunk `number` of a batch of groups, or of those of them that are `left`; None where no group has it."""
    lanes, begin = job.lanes, batch.start
    if number >= len(lanes.active) or lanes.active[number] <= begin:
        return None
    end, base = min(lanes.active[number], batch.stop), lanes.bases[number]
    last = lanes.bases[number - 1] if number else 0
    if left is None:
        previous = range(last + begin, last + end) if number else None
        return Stage(range(base + begin, base + end), range(begin, end), previous)
    groups = left[left < end]
    return Stage(base + groups, groups, last + groups) if len(groups) else None


def leave(job: Job, stage: Stage, kept: Chunks) -> Int[Tensor, "B"] | None:
    """Groups that go on, where enough have ended for the others to be picked out; at least two, for the compiler."""
    going = kept.after.take(stage.blocks).amax((1, 2)) >= job.rules.stop  # a pixel of theirs has not ended
    total = int(going.sum())
    if total > WORTH_LEAVING * len(going):
        return None
    going[: 2 if total else 0] = True
    groups = stage.groups
    if isinstance(groups, range):
        groups = torch.arange(groups.start, groups.stop, device=going.device)
    return groups[going]


def blend_stage(job: Job, blend: Callable[..., None], stage: Stage, accumulated: list[Rows], kept: Chunks) -> None:
    """Blend one stage by `blend` into `accumulated` and `kept.after`."""
    part, after = [channel.take(stage.groups) for channel in accumulated], kept.after.take(stage.blocks)
    blend(kept.rows.take(stage.blocks), job.basis.x, job.basis.y, kept.before(stage), after, part)
    if not isinstance(stage.groups, range):
        kept.after.values[stage.blocks] = after
        for channel, value in zip(accumulated, part, strict=True):
            channel.values[stage.groups] = value


def shares(job: Job, rows: Rows, like: Float[Tensor, "G P L"]) -> Float[Tensor, "G P L"]:
    """Share of the light that passes each list which another piece follows, and some others; 1 elsewhere."""
    transmit, passed = job.loops.transmit, Rows(torch.ones_like(like))
    followed = max(int(groups.max()) + 1 for _, (groups, _) in job.lanes.follows)  # the longest lists, hence first
    for part in parts(max(2, followed), job.batch):
        for base in job.lanes.bases:
            blocks = range(base + part.start, base + part.stop)
            transmit(rows.take(blocks), job.basis.x, job.basis.y, passed.take(range(part.start, part.stop)))
    return passed.values


def in_front(lanes: Lanes, passed: Float[Tensor, "G P L"], inside: Float[Tensor, "G P L"]) -> Float[Tensor, "G P L"]:
    """Transmittance in front of every list: that behind the piece before it."""
    front = inside.clone()
    before, passing = front.mT, passed.mT
    for later, earlier in lanes.follows:
        before[later] = before[earlier] * passing[earlier]
    return front


def behind_lists(job: Job, kept: Chunks, gradient: list[Float[Tensor, "G P L"]]) -> Float[Tensor, "G P L"]:
    """The picture behind every list as seen from there, weighted by the gradient: what the pieces that follow show, by
    the transmittance in front of them."""
    found = torch.zeros_like(gradient[0])
    if kept.pieces is None:
        return found
    behind, front, (passed, lights) = found.mT, kept.front.values.mT, kept.pieces
    for later, earlier in reversed(job.lanes.follows):
        shown, seen = ([channel.mT[later] for channel in channels] for channels in (lights, gradient))
        own = seen_from_front(shown, seen, front[later], job.rules)
        behind[earlier] = own + passed.mT[later] * behind[later]
    return found


def blend_chunks(
    job: Job, rows: Float[Tensor, "S K F L"], inside: Float[Tensor, "G P L"]
) -> tuple[list[Float[Tensor, "G P L"]], Chunks]:
    """What every list adds to the channels and the coverage, front to back."""
    held, front, pieces = Rows(rows), inside, None
    accumulated = [Rows(torch.zeros_like(inside)) for _ in range(job.rules.channels + 1)]
    lights = [channel.values for channel in accumulated]
    if job.lanes.follows:
        passed = shares(job, held, inside)
        front, pieces = in_front(job.lanes, passed, inside), (passed, lights)
    kept = Chunks([], held, Rows(front), Rows(inside.new_empty(len(rows), *inside.shape[1:])), pieces)
    blend = job.loops.blend
    for batch in parts(len(inside), job.batch):
        number, left = 0, None
        while (stage := stage_of(job, number, batch, left)) is not None:
            blend_stage(job, blend, stage, accumulated, kept)
            kept.stages.append(stage)
            number += 1
            if number % CHECK_EVERY == 0:
                fewer = leave(job, stage, kept)
                left = left if fewer is None else fewer
    return lights, kept


def room_for_gradients(kept: Chunks, width: int) -> Float[Tensor, "S K L V"]:
    """Room for `width` numbers of every entry, in the format of the rows; zero but where slices of blocks were
    blended."""
    rows, past = kept.rows.values, 0
    found = rows.new_empty(*rows.shape[:2], rows.shape[3], width)
    slices = sorted((s.blocks.start, s.blocks.stop) for s in kept.stages if isinstance(s.blocks, range))
    for begin, end in (*slices, (len(rows), len(rows))):
        if past < begin:
            found[past:begin].zero_()
        past = end
    return found


def chunk_gradients(job: Job, kept: Chunks, gradient: list[Float[Tensor, "G P L"]]) -> Float[Tensor, "S K L V"]:
    """Gradient of every entry, back to front; zero for blocks that were not blended."""
    seen, behind, basis = [Rows(channel) for channel in gradient], Rows(behind_lists(job, kept, gradient)), job.basis
    found = Rows(room_for_gradients(kept, TABLE + job.rules.channels + 2 * job.rules.absolute))
    gradients = job.loops.gradients
    for stage in reversed(kept.stages):
        rest, part = behind.take(stage.groups), found.take(stage.blocks)
        given = kept.before(stage), rest, [channel.take(stage.groups) for channel in seen], part
        gradients(kept.rows.take(stage.blocks), basis.x, basis.y, basis.products, *given)
        if not isinstance(stage.groups, range):
            behind.values[stage.groups], found.values[stage.blocks] = rest, part
    return found.values


# -- the autograd function -----------------------------------------------------------------------------------------


class CompiledComposite(torch.autograd.Function):
    """See `composite_compiled` for the arguments."""

    @staticmethod
    def forward(ctx, means, conic_factors, log_opacities, channels, absgrad, intersections, job):
        places = places_of(job.lanes, intersections) if job.learning else None  # while the lists are in the cache
        table = padded_table(means, conic_factors, log_opacities, channels).to(job.precision.exact)
        rows = job.loops.make_rows(table, job.lanes.entries, job.centre)
        inside = to_lanes(inside_of(job.grid, job.precision.accumulation, means.device), job.lanes)[0].clone()
        if job.learning and recording():  # later pictures may have lists that are cut
            job.loops.transmit(rows[:2], job.basis.x, job.basis.y, inside.clone()[:2])
        accumulated, kept = blend_chunks(job, rows, inside)
        if job.learning:
            ctx.kept = (job, intersections, places, len(means), kept, absgrad is not None, means.dtype)
        columns, lines = job.grid.shape
        return job.grid.to_raster(from_lanes(accumulated, job.lanes, columns * lines)).to(means.dtype)

    @staticmethod
    def backward(ctx, gradient):
        job, intersections, places, count, kept, absolute, dtype = ctx.kept
        seen = to_lanes(job.grid.to_tiles(gradient.to(job.precision.accumulation)), job.lanes)
        values = chunk_gradients(job, kept, seen).flatten(0, 2)
        total = sum_by_splat(values, intersections, places, count).to(dtype)
        width = TABLE + job.rules.channels
        absgrad = total[:, width:] if absolute else None
        return (total[:, :2], total[:, 2:5], total[:, 5], total[:, 6:width], absgrad, None, None)


class CompiledCompositor:
    """Blends through compiled loops, or as the eager compositor where only that one can; a `Compositor`."""

    backend = COMPILED

    def __call__(
        self,
        screen: ScreenSplats,
        channels: Float[Tensor, "M C"],
        intersections: TileIntersections,
        grid: TileGrid,
        settings: RasterSettings,
    ) -> tuple[Float[Tensor, "C_plus_1 H W"], Float[Tensor, "M"] | None]:
        if channels.shape[1] > MOST_CHANNELS or screen.weigh or not len(intersections.splats):
            return composite_eager(screen, channels, intersections, grid, settings)
        device = screen.means.device.type
        if not available(device):
            warn_once(device)
            return composite_eager(screen, channels, intersections, grid, settings)
        return composite_compiled(screen, channels, intersections, grid, settings), None


def composite_compiled(
    screen: ScreenSplats,
    channels: Float[Tensor, "M C"],
    intersections: TileIntersections,
    grid: TileGrid,
    settings: RasterSettings,
) -> Float[Tensor, "C_plus_1 H W"]:
    """Blends like `composite`, through compiled loops. There must be a pair."""
    means, absgrad = screen.means, screen.absgrad
    precision = Precision.of(settings, means.dtype)
    rules = rules_of(settings, channels.shape[1], absgrad is not None, precision.evaluation, means.device.type)
    values = settings.compiled_values or (VALUES if means.device.type == "cpu" else VALUES_OF_A_GPU)
    inputs = means, screen.conic_factors, screen.log_opacities, channels
    if settings.schedule == "segments" or (settings.schedule == "auto" and means.device.type != "cpu"):
        segments = cut(intersections, len(means), settings.unrolled)
        work = segment_job(segments, grid, rules, precision, values, means.device)
        return SegmentComposite.apply(padded_table(*inputs), absgrad, intersections, work)
    job = chunk_job(intersections, grid, rules, precision, values, (*inputs, absgrad))
    return CompiledComposite.apply(*inputs, absgrad, intersections, job)


def chunk_job(
    intersections: TileIntersections,
    grid: TileGrid,
    rules: Rules,
    precision: Precision,
    values: int,
    inputs: Sequence[Tensor | None],
) -> Job:
    """Lays lists out in lanes; `values`: alphas at once; `inputs`: means first, and what else gets a gradient."""
    means = inputs[0]
    assert means is not None
    batch = max(2, values // (rules.chunk * rules.tile_size**2 * LANES))
    learning = torch.is_grad_enabled() and any(value is not None and value.requires_grad for value in inputs)
    cut_long = learning and means.device.type == "cpu"  # elsewhere the host would wait for sizes
    lanes = lay_out(intersections, len(means), rules.chunk, batch, cut_long=cut_long)
    exact = means.detach().to(precision.exact)
    return Job(
        lanes=lanes,
        grid=grid,
        basis=basis_of(rules.tile_size, exact.dtype, exact.device),
        centre=centres(lanes, grid, exact),
        loops=kernels(rules),
        rules=rules,
        precision=precision,
        batch=batch,
        learning=learning,
    )


@functools.lru_cache
def warn_once(device: str) -> None:
    """Logs why the eager compositor draws instead."""
    logger.warning(
        "rasterizer.path=compiled: nothing can be compiled here (%s); going on with the eager path, which is several "
        "times slower. Install a C++ compiler (g++ or clang++), or choose rasterizer=eager",
        complaint(device),
    )
