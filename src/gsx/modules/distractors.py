"""Distractors: what stands before the scene in one training photograph alone does not count.

Whether there are any is judged once, from some photographs (`modules.distractor_masks`). If so, those of all
photographs are found, and again a few times as the model learns more; pixels that show one count in no loss, no
growth and no figure from there on, as if a mask had left them out, but in pseudo views that were made before. Test
photographs play no part.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.coarser import CoarseSource
from gsx.core.data.scene import CutOut, DerivedSource, View
from gsx.core.ranges import Range, Share
from gsx.core.shapes import Bool, Int
from gsx.modules.occasions import MadeOf, due_at, occasions, refuse_wrong, some_photographs


@dataclass(frozen=True, kw_only=True)
class DistractorOptions:
    """Options; values in conf/config.yaml."""

    when: str = "never"
    """auto: where photographs show what others do not."""
    start: Share = 0.1
    """Share of the steps after which that is judged, and distractors are found first."""
    until: Share = 0.8
    """Share of the steps after which they are found last."""
    times: Annotated[int, Range(1, 1000)] = 6
    """How often they are, at shares that grow by the same factor."""
    share: Annotated[float, Range(0, 1)] = 0.03
    """`auto`: of the pictures that are judged by, from which on what shows a distractor does not count."""
    views: Annotated[int, Range(3, 10**6)] = 24
    """Photographs that are judged by, at most."""

    def __post_init__(self) -> None:
        refuse_wrong("distractors", self)


@dataclass(frozen=True, eq=False, kw_only=True)
class MaskedSource(DerivedSource):
    """A photograph of which the blocks that show a distractor do not count."""

    marked: Bool[Tensor, "h w"]
    """Blocks of whole pixels of the photograph that show one; the last row and column take what is left over."""
    size: tuple[int, int]
    """(width, height) of the photograph, px."""

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"]:
        """Return which pixels count in the other source and show no distractor."""
        (height, width), frame = self.marked.shape, camera.frame
        down = block_of(frame.top, camera.height, frame.height, self.size[1], height)
        across = block_of(frame.left, camera.width, frame.width, self.size[0], width)
        free, counted = ~self.marked[down[:, None], across], super().counted(camera)
        return free if counted is None else free & counted

    def transparent(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Return which pixels of the other source show the background alone."""
        return self.source.transparent(camera) if isinstance(self.source, CutOut) else None


def block_of(first: int, count: int, frame: int, size: int, blocks: int) -> Int[Tensor, "P"]:
    """In which of so many blocks along an axis of a photograph of that size pixels lie: `count` from the `first` of a
    frame on, which is the photograph in so many pixels."""
    places = (torch.arange(count) + 0.5 + first) / frame * size
    return (places / max(1, size // blocks)).long().clamp(0, blocks - 1)


def without_marked(views: Sequence[View], marked: Sequence[Bool[Tensor, "h w"]]) -> list[View]:
    """Views without what is marked in their photographs."""
    return [mask_view(view, one) for view, one in zip(views, marked, strict=True)]


def mask_view(view: View, marked: Bool[Tensor, "h w"]) -> View:
    """The view without what is marked in its photograph; itself where nothing is. Of a coarse pixel nothing may be."""
    if not bool(marked.any()):
        return view
    if isinstance(view.source, CoarseSource):
        return replace(view, source=view.source.of(mask_view(view.source.view, marked)))
    frame = view.camera.frame
    return replace(view, source=MaskedSource(source=view.source, marked=marked, size=(frame.width, frame.height)))


@dataclass(eq=False)
class Distractors:
    """Of a run's training photographs. All pixels count before `mark`."""

    options: DistractorOptions = field(default_factory=DistractorOptions)
    iterations: int = 0
    marked: Sequence[Bool[Tensor, "h w"]] | None = None
    """Of each photograph, in order; None: they were not needed."""
    looked: int = 0
    """The last step before which they were found: not again where that step is taken anew."""
    seen: MadeOf = field(default_factory=MadeOf)
    """Views that were asked for, and what they are without distractors."""

    def steps(self) -> list[int]:
        """The steps before which they are found, if there are any, the first of them after that is judged."""
        return occasions(self.options, self.iterations)

    @property
    def first(self) -> int:
        """The step before which it is judged whether there are any."""
        return self.steps()[0]

    def due(self, number: int) -> bool:
        """Whether they are judged or found before this step."""
        return due_at(number, self.steps(), self.looked, self.marked is not None)

    def judged_by(self, views: Sequence[View]) -> list[View]:
        """The photographs that it is judged by: the same in every run."""
        return some_photographs(views, self.options.views, "distractors")

    def needed(self, share: float) -> bool:
        """Whether a share of pictures that shows distractors asks for masks."""
        return self.options.when == "always" or share > self.options.share

    def views(self, views: Sequence[View]) -> Sequence[View]:
        """The training views, in order, without their distractors; the same ones until others are found."""
        if self.marked is None:
            return views
        marked = self.marked
        return self.seen.views(views, lambda: without_marked(views, marked))

    def mark(self, marked: Sequence[Bool[Tensor, "h w"]] | None, number: int) -> float:
        """These from a step on; returns their share of the pictures."""
        self.marked, self.looked, self.seen = marked, number, MadeOf()
        return share_of(marked or [])

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint holds of them; nothing where there are none."""
        if self.marked is None:
            return {}
        return {"looked": torch.tensor(self.looked)} | {str(n): marked for n, marked in enumerate(self.marked)}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's tensors; none: all pixels count."""
        marked = [tensors[str(number)].clone() for number in range(len(tensors) - 1)] if tensors else None
        self.mark(marked, int(tensors["looked"]) if tensors else 0)


def share_of(marked: Sequence[Bool[Tensor, "h w"]]) -> float:
    """Of pictures, in the mean over them."""
    return sum(float(one.float().mean()) for one in marked) / max(1, len(marked))
