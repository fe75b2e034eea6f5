"""The compiled path: the picture and gradient of composite.py through loops that are compiled once (kernels.py).

Two schedules of the same mathematics. `chunks`: front to back, one chunk of all groups of lists at a time; groups whose
pixels have all ended leave. For lists that are cut into pieces (lanes.py) light is computed first. `segments`: all
blocks of all tiles at once (segments.py).
"""

import functools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
from gsx.engine.direct_calls import direct
from gsx.engine.kernels import (
    TABLE,
    Rules,
    blend,
    compiled_loop,
    exp_polynomial,
    gradients,
    make_rows,
    transmit,
    weighted_picture,
)
from gsx.engine.lanes import LANES, Lanes, centres, from_lanes, lay_out, places_of, to_lanes
from gsx.engine.segments import SegmentComposite, cut, parts, segment_job

logger = logging.getLogger(__name__)

MOST_CHANNELS = 8
"""Most channels to unroll: beyond it compilation takes longer than it saves."""
CHECK_EVERY = 4
"""Chunks between checks which groups have ended."""
VALUES, VALUES_OF_A_GPU = 1 << 22, 1 << 26
"""Alpha values at once where `compiled_values` is 0: on a CPU, elsewhere."""
WORTH_LEAVING = 0.75
"""Largest share of groups still going for which they are picked out: picking costs a copy."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Job:
    """One picture to blend."""

    lanes: Lanes
    grid: TileGrid
    basis: Basis
    centre: Float[Tensor, "S 2 1 L"]
    rules: Rules
    precision: Precision
    batch: int
    """Groups processed at once."""
    learning: bool
    """True if a backward pass follows."""


def rules_of(settings: RasterSettings, channels: int, absolute: bool, evaluation: torch.dtype, device: str) -> Rules:
    """Returns the constants of the compiled code."""
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
    """Returns one row per splat with all that blending needs, and last a row that draws nothing."""
    table = torch.cat([means, conic_factors, log_opacities[:, None], channels], 1)
    nothing = table.new_zeros(1, table.shape[1])
    nothing[:, TABLE - 1].fill_(NOTHING)  # an assignment might copy the number from the host
    return torch.cat([table, nothing])


# -- chunks --------------------------------------------------------------------------------------------------------


Where: TypeAlias = range | Int[Tensor, "B"]
"""Consecutive rows, or indices once groups have left."""


@dataclass(frozen=True, eq=False)
class Stage:
    """One chunk of some groups of a batch."""

    blocks: Where
    groups: Where
    previous: Where | None
    """Blocks of the same groups one chunk before."""


class Rows:
    """A tensor whose slices of rows are cached: making a view takes as long as a small chunk."""

    def __init__(self, values: Float[Tensor, "N *rest"]) -> None:
        self.values, self.views = values, dict[range, Tensor]()

    def take(self, where: Where) -> Float[Tensor, "B *rest"]:
        """Returns rows as a view: torch compiles anew for arguments that are no views."""
        if not isinstance(where, range):
            return self.values[where][:]
        view = self.views.get(where)
        if view is None:
            view = self.views[where] = self.values[where.start : where.stop]
        return view


@dataclass(frozen=True, eq=False)
class Chunks:
    """Values that the backward pass of the chunk schedule needs."""

    stages: list[Stage]
    rows: Rows
    """Columns of every entry, [S K F L]."""
    front: Rows
    """Transmittance in front of every list, 0 at pixels of border tiles beyond the raster, [G P L]."""
    after: Rows
    """Transmittance behind every block, [S P L]."""
    pieces: tuple[Float[Tensor, "G P L"], list[Float[Tensor, "G P L"]]] | None
    """(transmittance of each list that another piece follows, what every list adds to channels and coverage); None: no
    list is cut."""

    def before(self, stage: Stage) -> Float[Tensor, "B P L"]:
        """Returns the transmittance in front of a stage's blocks."""
        return self.front.take(stage.groups) if stage.previous is None else self.after.take(stage.previous)


def stage_of(job: Job, number: int, batch: slice, left: Int[Tensor, "B"] | None) -> Stage | None:
    """Returns chunk `number` of a batch of groups, or of those of them that are `left`; None where no group has it."""
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
    """Returns the groups that go on; None where too few have ended to pick them out. At least two, for the compiler."""
    going = kept.after.take(stage.blocks).amax((1, 2)) >= job.rules.stop  # a pixel of theirs has not ended
    total = int(going.sum())
    if total > WORTH_LEAVING * len(going):
        return None
    going[: 2 if total else 0] = True
    groups = stage.groups
    if isinstance(groups, range):
        groups = torch.arange(groups.start, groups.stop, device=going.device)
    return groups[going]


def blend_stage(job: Job, loop: Callable[..., None], stage: Stage, accumulated: list[Rows], kept: Chunks) -> None:
    """Blends one stage by `loop` into `accumulated` and `kept.after`."""
    part, after = [channel.take(stage.groups) for channel in accumulated], kept.after.take(stage.blocks)
    loop(kept.rows.take(stage.blocks), job.basis.x, job.basis.y, kept.before(stage), after, part)
    if not isinstance(stage.groups, range):
        kept.after.values[stage.blocks] = after
        for channel, value in zip(accumulated, part, strict=True):
            channel.values[stage.groups] = value


def shares(job: Job, rows: Rows, like: Float[Tensor, "G P L"]) -> Float[Tensor, "G P L"]:
    """Returns the transmittance of each list that another piece follows, and of some others; 1 elsewhere."""
    loop, passed = direct(compiled_loop(transmit, job.rules)), Rows(torch.ones_like(like))
    followed = max(int(groups.max()) + 1 for _, (groups, _) in job.lanes.follows)  # the longest lists, hence first
    for part in parts(max(2, followed), job.batch):
        for base in job.lanes.bases:
            blocks = range(base + part.start, base + part.stop)
            loop(rows.take(blocks), job.basis.x, job.basis.y, passed.take(range(part.start, part.stop)))
    return passed.values


def in_front(lanes: Lanes, passed: Float[Tensor, "G P L"], inside: Float[Tensor, "G P L"]) -> Float[Tensor, "G P L"]:
    """Returns the transmittance in front of every list: that behind the piece before it."""
    front = inside.clone()
    before, passing = front.mT, passed.mT
    for later, earlier in lanes.follows:
        before[later] = before[earlier] * passing[earlier]
    return front


def behind_lists(job: Job, kept: Chunks, gradient: list[Float[Tensor, "G P L"]]) -> Float[Tensor, "G P L"]:
    """Returns the gradient-weighted picture behind every list: that of the pieces that follow it."""
    found = torch.zeros_like(gradient[0])
    if kept.pieces is None:
        return found
    behind, front, (passed, lights) = found.mT, kept.front.values.mT, kept.pieces
    for later, earlier in reversed(job.lanes.follows):
        light, weight = ([channel.mT[later] for channel in channels] for channels in (lights, gradient))
        own = weighted_picture(light, weight, front[later], job.rules)
        behind[earlier] = own + passed.mT[later] * behind[later]
    return found


def blend_chunks(
    job: Job, rows: Float[Tensor, "S K F L"], inside: Float[Tensor, "G P L"]
) -> tuple[list[Float[Tensor, "G P L"]], Chunks]:
    """Returns (what every list adds to the channels and the coverage, values for the backward pass)."""
    held, front, pieces = Rows(rows), inside, None
    accumulated = [Rows(torch.zeros_like(inside)) for _ in range(job.rules.channels + 1)]
    lights = [channel.values for channel in accumulated]
    if job.lanes.follows:
        passed = shares(job, held, inside)
        front, pieces = in_front(job.lanes, passed, inside), (passed, lights)
    kept = Chunks([], held, Rows(front), Rows(inside.new_empty(len(rows), *inside.shape[1:])), pieces)
    loop = direct(compiled_loop(blend, job.rules))
    for batch in parts(len(inside), job.batch):
        number, left = 0, None
        while (stage := stage_of(job, number, batch, left)) is not None:
            blend_stage(job, loop, stage, accumulated, kept)
            kept.stages.append(stage)
            number += 1
            if number % CHECK_EVERY == 0:
                fewer = leave(job, stage, kept)
                left = left if fewer is None else fewer
    return lights, kept


def room_for_gradients(kept: Chunks, width: int) -> Float[Tensor, "S K L V"]:
    """Allocates `width` numbers per entry, in the format of the rows; zero where no slice of blocks was blended."""
    rows, past = kept.rows.values, 0
    found = rows.new_empty(*rows.shape[:2], rows.shape[3], width)
    slices = sorted((s.blocks.start, s.blocks.stop) for s in kept.stages if isinstance(s.blocks, range))
    for begin, end in (*slices, (len(rows), len(rows))):
        if past < begin:
            found[past:begin].zero_()
        past = end
    return found


def chunk_gradients(job: Job, kept: Chunks, gradient: list[Float[Tensor, "G P L"]]) -> Float[Tensor, "S K L V"]:
    """Returns the gradient of every entry, back to front; zero for blocks that were not blended."""
    channels, behind, basis = [Rows(one) for one in gradient], Rows(behind_lists(job, kept, gradient)), job.basis
    found = Rows(room_for_gradients(kept, TABLE + job.rules.channels + 2 * job.rules.absolute))
    loop = direct(compiled_loop(gradients, job.rules))
    for stage in reversed(kept.stages):
        rest, part = behind.take(stage.groups), found.take(stage.blocks)
        weights = [channel.take(stage.groups) for channel in channels]
        rows = kept.rows.take(stage.blocks)
        loop(rows, basis.x, basis.y, basis.products, kept.before(stage), rest, weights, part)
        if not isinstance(stage.groups, range):
            behind.values[stage.groups], found.values[stage.blocks] = rest, part
    return found.values


# -- the autograd function -----------------------------------------------------------------------------------------


class CompiledComposite(torch.autograd.Function):
    """Blends splats by chunks; `job`: their lists, in lanes."""

    @staticmethod
    def forward(ctx, means, conic_factors, log_opacities, channels, absgrad, intersections, job):
        places = places_of(job.lanes, intersections) if job.learning else None  # while the lists are in the cache
        table = padded_table(means, conic_factors, log_opacities, channels).to(job.precision.exact)
        rows = compiled_loop(make_rows, job.rules)(table, job.lanes.entries, job.centre)
        inside = to_lanes(inside_of(job.grid, job.precision.accumulation, means.device), job.lanes)[0].clone()
        if job.learning and recording():  # later pictures may have lists that are cut
            compiled_loop(transmit, job.rules)(rows[:2], job.basis.x, job.basis.y, inside.clone()[:2])
        accumulated, kept = blend_chunks(job, rows, inside)
        if job.learning:
            owners, job = (intersections.order, intersections.counts), replace(job, lanes=job.lanes.without_entries())
            ctx.kept = (job, owners, places, len(means), kept, absgrad is not None, means.dtype)
        columns, lines = job.grid.shape
        return job.grid.to_raster(from_lanes(accumulated, job.lanes, columns * lines)).to(means.dtype)

    @staticmethod
    def backward(ctx, gradient):
        job, (order, counts), places, count, kept, absolute, dtype = ctx.kept
        in_lanes = to_lanes(job.grid.to_tiles(gradient.to(job.precision.accumulation)), job.lanes)
        values = chunk_gradients(job, kept, in_lanes).flatten(0, 2)
        total = sum_by_splat(values, places, order, counts, count).to(dtype)
        width = TABLE + job.rules.channels
        absgrad = total[:, width:] if absolute else None
        return (total[:, :2], total[:, 2:5], total[:, 5], total[:, 6:width], absgrad, None, None)


class CompiledCompositor:
    """A `Compositor` of compiled loops; the eager one where it alone can draw."""

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
        means, absgrad = screen.means, screen.absgrad
        precision = Precision.of(settings, means.dtype)
        rules = rules_of(settings, channels.shape[1], absgrad is not None, precision.evaluation, device)
        values = settings.compiled_values or (VALUES if device == "cpu" else VALUES_OF_A_GPU)
        inputs = means, screen.conic_factors, screen.log_opacities, channels
        if settings.schedule == "segments" or (settings.schedule == "auto" and device != "cpu"):
            segments = cut(intersections, len(means), settings.unrolled)
            work = segment_job(segments, grid, rules, precision, values, means.device)
            return SegmentComposite.apply(padded_table(*inputs), absgrad, intersections, work), None
        job = chunk_job(intersections, grid, rules, precision, values, (*inputs, absgrad))
        return CompiledComposite.apply(*inputs, absgrad, intersections, job), None


def chunk_job(
    intersections: TileIntersections,
    grid: TileGrid,
    rules: Rules,
    precision: Precision,
    values: int,
    inputs: Sequence[Tensor | None],
) -> Job:
    """Lays lists out in lanes; `values`: alphas at once; `inputs`: means first, then all else that gets a gradient."""
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
        rules=rules,
        precision=precision,
        batch=batch,
        learning=learning,
    )


@functools.lru_cache
def warn_once(device: str) -> None:
    """Logs why the eager compositor draws instead."""
    logger.warning(
        "rasterizer.path=compiled: nothing can be compiled here (%s); using the eager path, several times slower. "
        "Install a C++ compiler (g++ or clang++), or set rasterizer=eager",
        complaint(device),
    )
