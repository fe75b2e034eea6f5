"""Steps on a GPU as one launch: a render, its loss and its gradients are recorded once and then replayed.

A step consists of hundreds of small kernels, which take the host longer to launch than the GPU to run. Between two
density events they are the same at every step but for what they read: the pose of a camera, its photograph, the
background. A CUDA graph holds them; what changes is copied to where it reads. Sizes of lists, which differ from view
to view, are given with room to spare (`FixedLists`); the step hears afterwards whether it was enough, which is all that
its host waits for, and is taken again if not. Pictures and gradients are those of steps that are not recorded.
"""

import logging
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, PlacedCamera, on_device
from gsx.core.device import uploaded
from gsx.core.errors import first_line
from gsx.core.gaussians.splats import Splats
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import (
    FixedLists,
    ListSizes,
    Needed,
    RasterSettings,
    Rendering,
    checked_lens,
    dilations_of,
    rasterize_fixed,
)
from gsx.core.rasterizer.intersections import raster_numbers
from gsx.core.shapes import Float, Int, UInt8
from gsx.core.training.backbone import Backbone, DrawnSplats
from gsx.core.training.parameter_table import ParameterTable, gradients, named_parameters, zero_grad
from gsx.core.training.photographs import numbers_of

logger = logging.getLogger(__name__)

SPARE, LEAST_ROOM = 1.25, 1024
"""Lists are given so much more room than one of them has needed, and at least so much."""
ATTEMPTS = 6
"""At finding how much room a picture needs: what one list lacks hides what the next does."""
MOST_KINDS = 2
"""Of pictures with a record each, which holds the memory of a step: upright and across, say. Steps of other sizes are
launched one by one: to record one takes longer."""


@runtime_checkable
class Recordable(Protocol):
    """A backbone that draws all its rows for every camera, by the same operations for a while, and learns from a render
    what `DrawnSplats` tells."""

    def drawn_alike(self, step: int) -> Hashable:
        """Equal for steps that are drawn by the same operations on the same tensors of the table; None: this step is
        not to be recorded."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Inputs:
    """Where a recorded step reads what differs from step to step."""

    pose: Float[Tensor, "31"]
    """float64: the camera's `Lens`, rotation, translation and centre."""
    photograph: UInt8[Tensor, "3 H W"]
    background: Float[Tensor, "3"]
    raster: Int[Tensor, "2 5"]
    """`raster_numbers` of the kind of picture: the same at every step, and held as long as it is read."""

    def camera(self, like: Camera) -> tuple[PlacedCamera, Float[Tensor, "16"]]:
        """(a camera whose pose is read from here, its lens)."""
        lens, rotation, translation, centre = self.pose.split([16, 9, 3, 3])
        return on_device(like, rotation.view(3, 3), translation, centre), lens


class Told(NamedTuple):
    """What the host has heard of a step's gradients."""

    loss: float
    sums: dict[str, float]
    """Of the gradient of each parameter that has one."""


def loss_and_sums(loss: Float[Tensor, ""], found: Mapping[str, Tensor]) -> Float[Tensor, "G_1"]:
    """The numbers of `Told` in order, for gradients by name: a GPU is waited for once to hear them."""
    return torch.stack([loss, *(gradient.sum() for gradient in found.values())])


def told_of(numbers: Sequence[float], found: Mapping[str, Tensor]) -> Told:
    """What `loss_and_sums` of these gradients says."""
    loss, *sums = numbers
    return Told(loss, dict(zip(found, sums, strict=True)))


NEEDED = len(Needed._fields)


@dataclass(frozen=True, eq=False, kw_only=True)
class ToLearn:
    """A view to be learnt at a step, on the device of the model."""

    camera: Camera
    photograph: UInt8[Tensor, "3 H W"]
    background: Float[Tensor, "3"]
    raster: RasterSettings
    step: int

    def pose(self) -> Float[Tensor, "31"]:
        """What `Inputs.pose` is for its camera.

        Raises:
            InputError: no picture can be taken with the camera's numbers.
        """
        camera = self.camera
        host = (checked_lens(camera, self.raster), camera.rotation, camera.translation, camera.centre)
        return uploaded(torch.cat([numbers.double().flatten() for numbers in host]), self.photograph.device)


@dataclass(frozen=True, eq=False, kw_only=True)
class Learnt:
    """A render and its loss, sent back: gradients lie where parameters have them, and nothing here has a graph."""

    drawn: DrawnSplats
    rendering: Rendering
    loss: Float[Tensor, ""]
    facts: Float[Tensor, "F"]
    """The numbers of `Needed`, the loss, and the sum of each gradient, float64: what the host is told at once."""
    told: Told | None = None


@runtime_checkable
class Graph(Protocol):
    """Work that was recorded."""

    def replay(self) -> None:
        """Do it again, on what its inputs hold now."""
        ...


Recording = Callable[[Callable[[], Learnt]], tuple[Learnt, Graph]]
"""(what the work has made, whose values come with the first replay; the record)."""


def cuda_graph(work: Callable[[], Learnt]) -> tuple[Learnt, Graph]:
    """By CUDA's own graphs. What other threads do meanwhile, a viewer's say, is not looked at."""
    graph, before = torch.cuda.CUDAGraph(), torch.cuda.current_stream()
    try:
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            made = work()
    except BaseException:
        torch.cuda.set_stream(before)  # torch leaves it where ending the capture fails
        raise
    return made, graph


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """One recorded step."""

    inputs: Inputs
    made: Learnt
    graph: Graph
    gradients: dict[str, Tensor]


@dataclass(eq=False, kw_only=True)
class Recorder:
    """Takes the steps of a run that can be recorded."""

    backbone: Backbone[Any]
    ssim_weight: float
    record: Recording = cuda_graph
    room: ListSizes = ListSizes(rows=LEAST_ROOM, pairs=LEAST_ROOM, blocks=LEAST_ROOM, longest=1)
    done: set[Hashable] = field(default_factory=set)
    """What has been done before without being recorded: nothing may be compiled, or copied there once and for all,
    while a step is recorded."""
    model: Hashable = None
    """What all steps that are recorded now have in common."""
    held: Sequence[Tensor] = ()
    """Tensors of the table that these read: as long as they are held, no others get their identity."""
    records: dict[Hashable, Recorded] = field(default_factory=dict)
    """By kind of picture."""
    most: int = MOST_KINDS
    """Kinds that are recorded: as many as there were where recording one more has failed."""

    def forget(self) -> None:
        """Let go of what is recorded, and its memory."""
        self.records, self.model, self.held = {}, None, ()

    def alike(self, step: int) -> Hashable:
        """What steps have in common that may be recorded together with this one; None: it is not to be recorded."""
        if self.most == 0 or not isinstance(self.backbone, Recordable):
            return None
        drawn = self.backbone.drawn_alike(step)
        return None if drawn is None else (drawn, self.backbone.absolute_gradient)

    def learn(self, view: ToLearn) -> Learnt | None:
        """Render a view, compare it with its photograph and send the loss back; None where that cannot be recorded.
        Parameters must have no gradients.

        Raises:
            InputError: no picture can be taken with the camera's numbers.
        """
        for _ in range(ATTEMPTS if self.alike(view.step) is not None else 0):
            found = self.attempt(view)
            if found is None:
                break
            facts = found.facts.tolist()
            needed = Needed(*map(int, facts[:NEEDED]))
            if self.room.hold(needed):
                return learnt_now(found, needed, told_of(facts[NEEDED:], gradients(self.backbone.table)))
            if max(needed.rows, needed.pairs) > view.raster.max_pairs:  # refused by name elsewhere
                break
            self.make_room(needed)
        zero_grad(self.backbone.table)
        return None

    def attempt(self, view: ToLearn) -> Learnt | None:
        """Replay what is recorded, record it, or, the first time and where too much is recorded, only do it; None where
        it cannot be recorded."""
        table, pose = self.backbone.table, view.pose()
        zero_grad(table)
        rules = (self.alike(view.step), view.raster, self.room)
        self.keep_for(rules)
        kind = (view.camera.size, view.camera.frame, dilations_of(view.camera, None, view.raster))
        if kind in self.records:
            return replayed(self.records[kind], table, pose, view)
        inputs = Inputs(
            pose=pose,
            photograph=view.photograph.clone(),
            background=view.background.clone(),
            raster=raster_numbers(view.camera, view.raster, view.photograph.device),
        )

        def work() -> Learnt:
            return self.work(inputs, view)

        way = (rules, kind)
        if way not in self.done or len(self.records) == self.most:
            found = work()
            self.done.add(way)
            return found
        record = self.recorded(inputs, work)
        if record is None:
            return None
        self.records[kind] = record
        return replayed(record, table, pose, view)

    def keep_for(self, rules: Hashable) -> None:
        """Keep what was recorded by these rules on the tensors that the table has now; forget all else."""
        table = self.backbone.table
        held = [*(parameter for _, parameter in named_parameters(table)), *table.columns.values()]
        model = (rules, *(id(tensor) for tensor in held))
        if model != self.model:
            self.forget()
            self.model, self.held = model, held

    def recorded(self, inputs: Inputs, work: Callable[[], Learnt]) -> Recorded | None:
        """A record of the work, which has not been done then; None where that fails."""
        try:
            made, graph = self.record(work)
        except RuntimeError as error:
            self.most = len(self.records)
            if not self.most:
                self.forget()
            which = "steps of other sizes" if self.most else "steps"
            logger.warning("%s are launched one by one: they cannot be recorded here (%s)", which, first_line(error))
            return None
        found = gradients(self.backbone.table)
        return Recorded(inputs=inputs, made=made, graph=graph, gradients=found)

    def work(self, inputs: Inputs, view: ToLearn) -> Learnt:
        """What is recorded; of what differs from view to view it reads the inputs alone."""
        camera, lens = inputs.camera(view.camera)
        fixed = FixedLists(lens=lens, raster=inputs.raster, **vars(self.room))
        drawn = self.backbone.draw(camera, view.step)
        colour, absolute = inputs.background, self.backbone.absolute_gradient
        rendering = rasterize_fixed(
            drawn.splats, camera, view.raster, fixed, background=colour, absolute_gradient=absolute
        )
        target = numbers_of(inputs.photograph)
        loss = photometric(rendering.image, target, self.ssim_weight, compiled=True)
        extra = self.backbone.regulariser(drawn)
        loss = loss if extra is None else loss + extra
        loss.backward()
        assert rendering.needed is not None
        sums = loss_and_sums(loss.detach(), gradients(self.backbone.table))
        return Learnt(
            drawn=DrawnSplats(splats=without_graph(drawn.splats), rows=drawn.rows),
            rendering=replace(rendering, image=rendering.image.detach(), alpha=rendering.alpha.detach()),
            loss=loss.detach(),
            facts=torch.cat([rendering.needed.double(), sums.double()]),
        )

    def make_room(self, needed: Needed) -> None:
        """For as much, and some more."""
        rows, pairs, blocks = (int(SPARE * number) + LEAST_ROOM for number in needed[1:4])
        now, longest = self.room, 1 << needed.longest.bit_length()
        self.room = ListSizes(
            rows=max(now.rows, rows),
            pairs=max(now.pairs, pairs),
            blocks=max(now.blocks, blocks),
            longest=max(now.longest, longest),
        )


def replayed(record: Recorded, table: ParameterTable, pose: Float[Tensor, "31"], view: ToLearn) -> Learnt:
    """A recorded step on this view."""
    places = record.inputs.pose, record.inputs.photograph, record.inputs.background
    for place, value in zip(places, (pose, view.photograph, view.background), strict=True):
        place.copy_(value)
    record.graph.replay()
    for name, parameter in named_parameters(table):
        parameter.grad = record.gradients.get(name)
    return record.made


def learnt_now(found: Learnt, needed: Needed, told: Told) -> Learnt:
    """What a step has made, with what the host has heard of it. What may be kept longer than it is copied: the next
    replay writes to the same places."""
    rendering = replace(
        found.rendering,
        image=found.rendering.image.clone(),
        alpha=found.rendering.alpha.clone(),
        intersections=needed.pairs,
        dropped=needed.dropped,
    )
    return replace(found, rendering=rendering, loss=found.loss.clone(), told=told)


def without_graph(splats: Splats) -> Splats:
    """The same splats; what they were made from is not kept."""
    return Splats(**{name: value.detach() for name, value in vars(splats).items()})
