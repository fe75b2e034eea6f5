"""Photographs taken by a camera that moved: their renders are blurred alike before they are compared.

Photographs that are less sharp than their neighbours are suspected (`core.quality.sharpness`). From what the model
shows in their places the movement of the camera is estimated (`modules.motion_blur`), a few times as it gets
better. The loss is that of the render as such a camera would have taken it, so that the model stays sharp where the
photograph is not. Test photographs play no part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.quality.sharpness import against_neighbours, fineness
from gsx.core.ranges import Range, Share
from gsx.core.shapes import Float
from gsx.modules.motion_blur import Movement
from gsx.modules.movement import blurred_to_learn
from gsx.modules.occasions import due_at, occasions, refuse_wrong


@dataclass(frozen=True, kw_only=True)
class BlurOptions:
    """Options; values in conf/config.yaml."""

    when: str = "never"
    """auto: where photographs that are less sharp than their neighbours are blurred; always: without asking."""
    start: Share = 0.2
    """Share of the steps after which movements are estimated first."""
    until: Share = 0.85
    """Share of the steps after which they are last."""
    times: Annotated[int, Range(1, 1000)] = 6
    """How often they are, at shares that grow by the same factor."""
    sharpness: Annotated[float, Range(0, 10)] = 0.9
    """`auto`: of the fine contrast of their neighbours; photographs that have less are asked."""
    length: Annotated[float, Range(0, 100)] = 1.0
    """Px; shorter movements blur nothing."""
    explained: Share = 0.01
    """Share of the squared difference from the model, at its best gains, that a movement has to explain in each half
    of a photograph that shows it."""

    def __post_init__(self) -> None:
        refuse_wrong("blur", self)


@dataclass(eq=False)
class Blur:
    """Of a run's training photographs. Renders stay as they are before `move`."""

    options: BlurOptions = field(default_factory=BlurOptions)
    iterations: int = 0
    movements: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Across and down, as shares of the frame's sides, by name, of photographs that are blurred."""
    asked: int = 0
    """The last step before which they were estimated: not again where that step is taken anew."""

    def steps(self) -> list[int]:
        """The steps before which movements are estimated."""
        return occasions(self.options, self.iterations)

    def due(self, number: int) -> bool:
        """Whether they are estimated before this step: after the first time only if there are any."""
        return due_at(number, self.steps(), self.asked, bool(self.movements))

    def suspects(self, views: Sequence[View]) -> list[View]:
        """The photographs that are asked: at first those less sharp than their neighbours by name, and all where one of
        these is blurred."""
        if self.options.when == "always" or self.movements:
            return list(views)
        ordered = sorted({view.name: view for view in views}.values(), key=lambda view: view.name)
        fine = torch.stack([fineness((view.image() * 255).round().byte()) for view in ordered])
        found = zip(ordered, against_neighbours(fine).tolist(), strict=True)
        return [view for view, sharpness in found if sharpness < self.options.sharpness]

    def counts(self, movement: Movement) -> bool:
        """Whether a photograph is blurred, by what was found of it."""
        return movement.length >= self.options.length and movement.explained >= self.options.explained

    def move(self, found: Mapping[View, Movement], number: int) -> list[float]:
        """These movements, px of their views, from a step on, as far as they count; returns the lengths of those."""
        kept = {view: one for view, one in found.items() if self.counts(one)}
        self.movements = {view.name: view.camera.frame.shares(one.across, one.down) for view, one in kept.items()}
        self.asked = number
        return [one.length for one in kept.values()]

    def applied(self, image: Float[Tensor, "C H W"], view: View) -> Float[Tensor, "C H W"]:
        """A render as the camera of a photograph would have taken it, at whatever size it is."""
        if view.name not in self.movements:
            return image
        (across, down), frame = self.movements[view.name], view.camera.frame
        return blurred_to_learn(image, across * frame.width, down * frame.height)

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint holds of them; nothing where there are none."""
        if not self.movements:
            return {}
        told = {f"of {name}": torch.tensor(movement, dtype=torch.float64) for name, movement in self.movements.items()}
        return {"asked": torch.tensor(self.asked)} | told

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a checkpoint's tensors; none: renders stay as they are."""
        names = [name for name in tensors if name != "asked"]
        self.movements = {name.removeprefix("of "): tuple(tensors[name].tolist()) for name in names}
        self.asked = int(tensors["asked"]) if tensors else 0
