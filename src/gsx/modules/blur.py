"""Motion blur of training photos: their renders are blurred equally before the loss compares them.

Photos less sharp than their neighbours are candidates (`core.quality.sharpness`). The movement of their camera is
estimated from the model's renders (`modules.motion_blur`), a few times as the model improves. So the model stays sharp
where photos are not. Test photos are not used.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.quality.sharpness import against_neighbours, fineness
from gsx.core.ranges import Range, Share
from gsx.core.training.module import ModuleContext
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.modules.corrections import Correction, CorrectionOptions, Times
from gsx.modules.derived_views import reduce_view
from gsx.modules.motion_blur import Movement, SharpenedBlur, movement_between
from gsx.modules.photo_pairs import match_brightness

logger = logging.getLogger(__name__)

MAX_PIXELS = 1 << 18
"""Most pixels of a view from which a movement is estimated."""


@dataclass(frozen=True, kw_only=True)
class BlurOptions(CorrectionOptions):
    """Options; values in conf/module/blur.yaml."""

    key: ClassVar[str] = "blur"
    until: Share = 0.85
    """Share of the steps before the last estimate."""
    times: Times = 6
    """Number of estimates, at shares that grow by the same factor."""
    sharpness: Annotated[float, Range(0, 10)] = 0.9
    """`auto`: photos with less than this share of their neighbours' fine contrast are candidates."""
    length: Annotated[float, Range(0, 100)] = 1.0
    """Shortest movement that blurs renders, px."""
    explained: Share = 0.01
    """Share of the squared difference from the model, at its best gains, that a movement must explain in each half of a
    photo that shows it."""


class Blur(Correction):
    """Camera movements during the exposure of training photos."""

    options: BlurOptions
    seconds_key = "blur_seconds"
    figures_key = "blur"
    count_key = "blurred"
    thresholds = ("sharpness", "length", "explained")

    def __init__(self, options: BlurOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        self.movements: dict[str, tuple[float, float]] = {}
        """Movement to the right and down, shares of the frame's sides, by the name of a blurred photo."""

    def restarted(self, context: ModuleContext) -> "Blur":
        """Returns a module with the present movements that estimates no others."""
        module = Blur(BlurOptions(), context)
        module.movements = dict(self.movements)
        return module

    def estimate(self, run: Run, step: int) -> dict[str, float]:
        """Estimates the camera's movement in each candidate."""
        candidates = self.candidates(run.train_views)
        lengths = self.move({view: self.estimate_movement(run, view) for view in candidates}, step)
        middle = {"blur_length": median(lengths)} if lengths else {}
        length = f", median movement {median(lengths):.1f} px" if lengths else ""
        logger.info(
            "step %d: %d of %d candidate photos (sharpness < %g) moved by >= %g px%s",
            *(step, len(lengths), len(candidates), self.options.sharpness, self.options.length, length),
        )
        return {"blurred": len(lengths), "blur_suspects": len(candidates)} | middle

    def candidates(self, views: Sequence[View]) -> list[View]:
        """Returns the photos to estimate: those less sharp than neighbours by name, or all if any is blurred."""
        if self.options.when == "always" or self.movements:
            return list(views)
        ordered = sorted({view.name: view for view in views}.values(), key=lambda view: view.name)
        fine = torch.stack([fineness((view.image() * 255).round().byte()) for view in ordered])
        relative = zip(ordered, against_neighbours(fine).tolist(), strict=True)
        return [view for view, sharpness in relative if sharpness < self.options.sharpness]

    def estimate_movement(self, run: Run, view: View) -> Movement:
        """Returns the movement of a photo's camera, px of the photo."""
        run.raise_if_stopping()
        small = reduced_to(view, run, MAX_PIXELS)
        photo, mask, image = small.image(), small.counted(), render(run, small.camera, supersample=1).image
        sharp = run.views.without(self).match_photo(image, None, small).detach().cpu()
        movement = movement_between(match_brightness(sharp, photo, mask), photo, mask)
        return movement.scaled(view.camera.focal / small.camera.focal)

    def move(self, estimates: Mapping[View, Movement], step: int) -> list[float]:
        """Keeps the movements, px of their views, that are long and explain enough; returns their lengths, px."""
        length, explained = self.options.length, self.options.explained
        kept = {view: m for view, m in estimates.items() if m.length >= length and m.explained >= explained}
        self.movements = {view.name: view.camera.frame.shares(m.across, m.down) for view, m in kept.items()}
        self.last_estimate = step
        return [movement.length for movement in kept.values()]

    def transform_render(
        self, image: Tensor, view: View, photo: Tensor | None, window: Window | None, learning: bool
    ) -> Tensor:
        """Returns the render blurred as its photo, at any size."""
        if view.name not in self.movements:
            return image
        (across, down), frame = self.movements[view.name], view.camera.frame
        return SharpenedBlur.apply(image, across * frame.width, down * frame.height)

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the movements; empty where there are none."""
        if not self.movements:
            return {}
        tensors = {
            f"of {name}": torch.tensor(movement, dtype=torch.float64) for name, movement in self.movements.items()
        }
        return {"asked": torch.tensor(self.last_estimate)} | tensors

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores a checkpoint; empty: no photo is blurred."""
        names = [name for name in tensors if name != "asked"]
        self.movements = {name.removeprefix("of "): tuple(tensors[name].tolist()) for name in names}
        self.last_estimate = int(tensors["asked"]) if tensors else 0

    @classmethod
    def figures(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the step of the first estimate, the counts of the last, and its median length, px."""
        first, last = lines[0], lines[-1]
        counts = {"step": first["step"], "blurred": last["blurred"], "asked": last["blur_suspects"]}
        return counts | {"length": last.get("blur_length", 0.0)}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Reports blurred photos."""
        figures = evaluation.get("blur") or {}
        if figures.get("blurred"):
            yield (
                f"the camera moved in {figures['blurred']} training photos, median {figures['length']:.1f} px: renders "
                f"are blurred alike before they are compared, from step {figures['step']:,} on"
            )


def reduced_to(view: View, run: Run, pixels: int) -> View:
    """Returns the view halved until it has at most `pixels` pixels, or cannot be halved."""
    if view.camera.width * view.camera.height <= pixels:
        return view
    halved = reduce_view(view, run.scene.reduction, 2)
    return view if halved is view else reduced_to(halved, run, pixels)
