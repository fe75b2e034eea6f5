"""Steps on a GPU as one launch: a render, its loss and its gradients are recorded once and then replayed.

A step consists of hundreds of small kernels, which take the host longer to launch than the GPU to run. Between two
density events they are the same at every step but for what they read: the pose of a camera, its photograph, the
background. A CUDA graph holds them; what changes is copied to where it reads. Sizes of lists, which differ from view
to view, are given with room to spare (`FixedLists`); the step hears afterwards whether it was enough, which is all that
its host waits for, and is taken again if not. Pictures and gradients are those of steps that are not recorded.
"""

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, PlacedCamera, placed
from gsx.core.device import uploaded
from gsx.core.errors import first_line
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import FixedLists, Needed, RasterSettings, Rendering, checked_lens, rasterize_fixed
from gsx.core.shapes import Float, UInt8
from gsx.core.training.backbone import Backbone, Drawn
from gsx.core.training.parameter_table import gradients, named_parameters, zero_grad

logger = logging.getLogger(__name__)

SPARE, LEAST_ROOM = 1.25, 1024
"""Lists are given so much more room than one of them has needed, and at least so much."""
ATTEMPTS = 6
"""At finding how much room a picture needs: what one list lacks hides what the next does."""


@runtime_checkable
class Recordable(Protocol):
    """A backbone that draws all its rows for every camera, by the same operations for a while."""

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

    def camera(self, like: Camera) -> tuple[PlacedCamera, Float[Tensor, "16"]]:
        """(a camera whose pose is read from here, its lens)."""
        lens, rotation, translation, centre = self.pose.split([16, 9, 3, 3])
        return placed(like, rotation.view(3, 3), translation, centre), lens


class Told(NamedTuple):
    """What the host has heard of a step's gradients."""

    loss: float
    sums: dict[str, float]
    """Of the gradient of each parameter that has one."""


NEEDED = len(Needed._fields)


@dataclass(frozen=True, eq=False, kw_only=True)
class Learnt:
    """A render and its loss, sent back: gradients lie where parameters have them."""

    drawn: Drawn
    rendering: Rendering
    loss: Float[Tensor, ""]
    facts: Float[Tensor, "F"]
    """The numbers of `Needed`, the loss, and the sum of each gradient, float64: what the host is told at once."""
    told: Told | None = None


class Graph(Protocol):
    """Work that was recorded."""

    def replay(self) -> None:
        """Do it again, on what its inputs hold now."""
        ...


Recording = Callable[[Callable[[], Learnt]], tuple[Learnt, Graph]]
"""(what the work has made, whose values come with the first replay; the record)."""


def cuda_graph(work: Callable[[], Learnt]) -> tuple[Learnt, Graph]:
    """By CUDA's own graphs. What other threads do meanwhile, a viewer's say, is not looked at."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        made = work()
    return made, graph


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """One recorded step."""

    key: Hashable
    inputs: Inputs
    fixed: FixedLists
    made: Learnt
    graph: Graph
    gradients: dict[str, Tensor]
    held: Sequence[Tensor]
    """Tensors of the table that it reads: as long as they are held, no others get their identity."""


@dataclass(eq=False, kw_only=True)
class Recorder:
    """Takes the steps of a run that can be recorded."""

    backbone: Backbone[Any]
    raster: RasterSettings
    ssim_weight: float
    record: Recording = cuda_graph
    room: Needed = Needed(0, LEAST_ROOM, LEAST_ROOM, LEAST_ROOM, 1)
    compiled: set[Hashable] = field(default_factory=set)
    """Ways of drawing whose operations have run before: nothing may be compiled while a step is recorded."""
    last: Recorded | None = None
    broken: bool = False
    """Recording has failed: steps are launched one by one from there on."""

    def learn(
        self, camera: Camera, photograph: UInt8[Tensor, "3 H W"], background: Float[Tensor, "3"], step: int
    ) -> Learnt | None:
        """Render a view, compare it with its photograph and send the loss back; None where that cannot be recorded.

        Parameters must have no gradients. `photograph` and `background` lie where the model does.
        """
        alike = self.backbone.drawn_alike(step) if isinstance(self.backbone, Recordable) else None
        if self.broken or alike is None:
            return None
        way = (alike, self.backbone.absolute_gradient)
        for _ in range(ATTEMPTS):
            found = self.attempt(way, camera, photograph, background, step)
            if self.broken:
                return None
            facts = found.facts.tolist()
            needed, (loss, *sums) = Needed(*map(int, facts[:NEEDED])), facts[NEEDED:]
            if self.fits(needed):
                exact = replace(found.rendering, intersections=needed.pairs, dropped=needed.dropped)
                told = Told(loss, dict(zip(gradients(self.backbone.table), sums, strict=True)))
                return replace(found, rendering=exact, loss=found.loss.clone(), told=told)
            self.make_room(needed)
        zero_grad(self.backbone.table)
        return None

    def attempt(
        self,
        way: Hashable,
        camera: Camera,
        photograph: UInt8[Tensor, "3 H W"],
        background: Float[Tensor, "3"],
        step: int,
    ) -> Learnt:
        """Replay what is recorded, record it, or, the first time, only do it."""
        zero_grad(self.backbone.table)
        lens = checked_lens(camera, self.raster)
        host = [lens, *(x.double().flatten() for x in (camera.rotation, camera.translation, camera.centre))]
        pose = uploaded(torch.cat(host), photograph.device)
        table = self.backbone.table
        tensors = [*(parameter for _, parameter in named_parameters(table)), *table.columns.values()]
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.size, camera.frame, camera.near)
        key = (way, numbers, self.room, *(id(tensor) for tensor in tensors))
        if self.last is None or self.last.key != key:
            inputs = Inputs(pose=pose, photograph=photograph.clone(), background=background.clone())
            fixed = self.lists(inputs.camera(camera)[1])
            if way not in self.compiled:
                self.compiled.add(way)
                return self.work(inputs, camera, fixed, step)
            self.begin(key, inputs, camera, fixed, step, tensors)
        return self.replayed(pose, photograph, background)

    def begin(
        self, key: Hashable, inputs: Inputs, camera: Camera, fixed: FixedLists, step: int, held: Sequence[Tensor]
    ) -> None:
        """Record a step; it has not been taken then."""
        self.last = None  # its memory goes first
        try:
            made, graph = self.record(lambda: self.work(inputs, camera, fixed, step))
        except RuntimeError as error:
            self.broken = True
            logger.warning("steps are launched one by one: they cannot be recorded here (%s)", first_line(error))
            zero_grad(self.backbone.table)
            return
        self.last = Recorded(
            key=key,
            inputs=inputs,
            fixed=fixed,
            made=made,
            graph=graph,
            gradients=gradients(self.backbone.table),
            held=held,
        )

    def replayed(
        self, pose: Float[Tensor, "31"], photograph: UInt8[Tensor, "3 H W"], background: Float[Tensor, "3"]
    ) -> Learnt:
        """The recorded step on these inputs."""
        assert self.last is not None
        inputs = self.last.inputs
        for place, value in ((inputs.pose, pose), (inputs.photograph, photograph), (inputs.background, background)):
            place.copy_(value)
        self.last.graph.replay()
        for name, parameter in named_parameters(self.backbone.table):
            parameter.grad = self.last.gradients.get(name)
        return self.last.made

    def work(self, inputs: Inputs, camera: Camera, fixed: FixedLists, step: int) -> Learnt:
        """What is recorded."""
        seen_by, _ = inputs.camera(camera)
        drawn = self.backbone.draw(seen_by, step)
        absolute, colour = self.backbone.absolute_gradient, inputs.background
        rendering = rasterize_fixed(
            drawn.splats, seen_by, self.raster, fixed, background=colour, absolute_gradient=absolute
        )
        target = inputs.photograph.float() / 255.0
        loss = photometric(rendering.image, target, self.ssim_weight, compiled=True)
        extra = self.backbone.regulariser(drawn)
        loss = loss if extra is None else loss + extra
        loss.backward()
        assert rendering.needed is not None
        sums = torch.stack([loss.detach(), *(slope.sum() for slope in gradients(self.backbone.table).values())])
        facts = torch.cat([rendering.needed.double(), sums.double()])
        return Learnt(drawn=drawn, rendering=rendering, loss=loss.detach(), facts=facts)

    def lists(self, lens: Float[Tensor, "16"]) -> FixedLists:
        """Lists with the room of the moment."""
        _, rows, pairs, blocks, longest = self.room
        return FixedLists(lens=lens, rows=rows, pairs=pairs, blocks=blocks, longest=longest)

    def fits(self, needed: Needed) -> bool:
        """Whether there was room for that."""
        return self.lists(torch.empty(0)).hold(needed)

    def make_room(self, needed: Needed) -> None:
        """For as much, and some more."""
        rows, pairs, blocks = (int(SPARE * number) + LEAST_ROOM for number in needed[1:4])
        now, longest = self.room, 1 << needed.longest.bit_length()
        self.room = Needed(
            0, max(now.rows, rows), max(now.pairs, pairs), max(now.blocks, blocks), max(now.longest, longest)
        )
