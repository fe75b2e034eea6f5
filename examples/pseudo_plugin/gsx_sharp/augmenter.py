"""An augmenter: from some step on, the middle of every training view at twice its density, at every step."""

from dataclasses import dataclass
from typing import Any

from gsx.augmenters.checked_regenerator import CheckedRegenerator, Redrawing
from gsx.core.data.resize import to_uint8
from gsx.core.ranges import Share, Weight
from gsx.core.training.augmenter import AugmenterContext
from gsx.core.training.pseudo_views import PseudoView, Term
from gsx.core.training.regenerator import Request
from gsx.core.training.run import Run


@dataclass(frozen=True, kw_only=True)
class SteadyOptions:
    name: str
    start: Share
    """Fraction of the run after which it begins."""
    weight: Weight


class SteadyZoom(Redrawing):
    def __init__(self, options: SteadyOptions, context: AugmenterContext) -> None:
        self.options, self.context = options, context
        self.regenerator = CheckedRegenerator.of_role(context, "upscale")
        self.regenerator.refuse(context.scene.train, [2], moved=False)
        self.views: dict[int, list[PseudoView]] = {}

    def begins(self) -> int:
        return round(self.options.start * self.context.iterations)

    def plan(self) -> dict[str, Any]:
        return {"from": self.begins()}

    def term(self, run: Run, step: int, view: int) -> Term | None:
        if step <= self.begins():
            return None
        if not self.views:
            self.regenerator.prepare(run, self.context)
        if view not in self.views:
            self.views[view] = self.zoomed(view)
        parts = [(pseudo, self.options.weight) for pseudo in self.views[view]]
        return Term(name=self.context.name, parts=parts, replaces=0.0, observed=False, shared=True)

    def zoomed(self, number: int) -> list[PseudoView]:
        """The middle half of a photograph, redrawn; it depends on nothing else, so a resumed run makes it again.

        Nothing where the picture is dropped: whatever a regenerator returns has been checked and counted.
        """
        view = self.context.scene.train[number]
        camera = view.camera.narrow(0.5)
        request = Request(
            image=view.source.image(camera).float() / 255, scale=2, camera=camera, view=view, number=number,
            photo=True, seed=self.context.seed, strength=0.0, strongest=0.0, prompt="", step=0,
        )  # fmt: skip
        (redrawn,) = self.regenerator.redraw([request])
        if redrawn.image is None:
            return []
        return [PseudoView(camera=camera.zoom(2), target=to_uint8(redrawn.image.clamp(0, 1)), parent=number)]
