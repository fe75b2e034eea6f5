"""Distractors: objects in front of the scene in a single training photo, which are masked.

A test on some photos decides if there are any (`modules.distractor_masks`). If so, all photos are searched, and again a
few times as the model improves. Pixels of distractors enter no loss, growth or figure from then on, as with a mask of
the user's; pseudo views made before stay. Test photos are not used.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.ranges import Range, Share
from gsx.core.shapes import Bool
from gsx.core.training.importance import Probe
from gsx.core.training.module import ModuleContext
from gsx.core.training.parameter_table import keep_rows
from gsx.core.training.run import Run
from gsx.modules.corrections import (
    Correction,
    CorrectionOptions,
    Times,
    ViewCache,
    ViewCount,
    log_test,
    percent,
    sample,
)
from gsx.modules.derived_views import mask_views, reduce_view
from gsx.modules.distractor_masks import Difference, difference_of, distractors_in
from gsx.modules.photo_pairs import REDUCTION, gains, match_brightness, render_reduced

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class DistractorOptions(CorrectionOptions):
    """Options; values in conf/module/distractors.yaml."""

    key: ClassVar[str] = "distractors"
    start: Share = 0.1
    """Share of the steps before the test and the first search."""
    until: Share = 0.8
    """Share of the steps before the last search."""
    times: Times = 6
    """Number of searches, at shares that grow by the same factor."""
    share: Annotated[float, Range(0, 1)] = 0.03
    """`auto`: share of distractors in the tested pixels above which photos are masked."""
    views: ViewCount = 24
    """Most photos that the test uses."""


class Distractors(Correction):
    """Masks of distractors in training photos."""

    options: DistractorOptions
    seconds_key = "distractor_seconds"
    figures_key = "distractors"
    count_key = "distractors"
    thresholds = ("share",)
    in_views = True

    def __init__(self, options: DistractorOptions, context: ModuleContext) -> None:
        super().__init__(options, context)
        self.masks: Sequence[Bool[Tensor, "h w"]] | None = None
        """Pixels of distractors, by photo in order; None: no photo is masked."""
        self.cache = ViewCache()

    def transform_views(self, views: Sequence[View], step: int | None) -> Sequence[View]:
        """Returns the views without their distractors."""
        if self.masks is None:
            return views
        masks = self.masks
        return self.cache.get(views, lambda: mask_views(views, masks))

    # -- estimates -----------------------------------------------------------------------------------------------------

    def estimate(self, run: Run, step: int) -> dict[str, float]:
        """Tests if photos show distractors, at first, and masks those of all photos if so.

        Removes primitives that are mostly visible in masked pixels, from which they were learnt.
        """
        views, metrics, needed = run.views.without(self).full_size, dict[str, float](), True
        differences = dict[View, Difference]()
        if step == self.milestones()[0]:
            differences = measure_differences(run, sample(views, self.options.views, "distractors"))
            share = mean_share(distractors_in(list(differences.values())))
            needed = self.options.when == "always" or share > self.options.share
            metrics["distractor_share"] = share
            action = "masking photos" if needed else "all pixels count"
            log_test(step, "distractors", share, self.options.share, percent, action)
        if needed:
            differences |= measure_differences(run, [view for view in views if view not in differences])
        masks = distractors_in([differences[view] for view in views]) if needed else None
        removed = None if masks is None else rows_of_distractors(run, mask_views(views, masks))
        metrics["distractors"] = self.mask(masks, step)  # nothing can fail between masks and removal
        if removed is not None:
            metrics["forgotten"] = remove_rows(run, removed)
            logger.info(
                "step %d: %.1f %% of pixels masked, %d primitives that show them removed",
                *(step, 100 * metrics["distractors"], metrics["forgotten"]),
            )
        return metrics

    def mask(self, masks: Sequence[Bool[Tensor, "h w"]] | None, step: int) -> float:
        """Uses these masks from a step on; returns their mean share of the pixels."""
        self.masks, self.last_estimate, self.cache = masks, step, ViewCache()
        return mean_share(masks or [])

    # -- files ---------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the masks; empty without any."""
        if self.masks is None:
            return {}
        masks = {str(index): mask for index, mask in enumerate(self.masks)}
        return {"looked": torch.tensor(self.last_estimate)} | masks

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores a checkpoint; empty: all pixels count."""
        masks = [tensors[str(index)].clone() for index in range(len(tensors) - 1)] if tensors else None
        self.mask(masks, int(tensors["looked"]) if tensors else 0)

    @classmethod
    def figures(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns the step and the share of the test, and the masked shares since."""
        masked = [line["distractors"] for line in lines] if any(line["distractors"] for line in lines) else []
        shares = [line["distractor_share"] for line in lines if "distractor_share" in line]
        return {"step": lines[0]["step"], "share": (shares or [None])[0], "marked": masked}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        """Reports masked parts of training photos."""
        figures = evaluation.get("distractors") or {}
        if figures.get("marked"):
            yield (
                f"{figures['marked'][-1]:.1%} of the pixels of training photos show distractors and do not count from "
                f"step {figures['step']:,} on"
            )


def measure_differences(run: Run, views: Sequence[View]) -> dict[View, Difference]:
    """Returns the difference of each reduced photo from its render."""
    return {view: measure_difference(run, view) for view in views}


def measure_difference(run: Run, view: View) -> Difference:
    """Returns the difference of a reduced photo from its render."""
    small, rendering = render_reduced(run, view)
    assert rendering.depth is not None
    photo, mask = small.image(), small.counted()
    brightness = gains(rendering.image, photo, mask)
    image = match_brightness(run.views.match_photo(rendering.image, None, small).detach().cpu(), photo, mask)
    return difference_of(small.camera, image, rendering.depth, rendering.alpha, photo, mask, brightness)


def rows_of_distractors(run: Run, views: Sequence[View]) -> Bool[Tensor, "N"]:
    """Returns the primitives that are mostly visible in masked pixels."""
    probe = Probe(model=run.backbone, views=run.views, step=run.model_step)
    hidden, total = run.background.new_zeros(2, len(run.backbone.table))
    for view in views:
        run.raise_if_stopping()
        small = reduce_view(view, run.scene.reduction, REDUCTION)
        masked, everywhere = probe.render(small.camera).blending_weights(small.counted())
        hidden, total = hidden + masked, total + everywhere
    return hidden > total / 2


def remove_rows(run: Run, rows: Bool[Tensor, "N"]) -> int:
    """Removes primitives, unless it is all of them; returns their number."""
    if bool(rows.all()):
        return 0
    keep_rows(run.backbone.table, ~rows)
    return int(rows.sum())


def mean_share(masks: Sequence[Bool[Tensor, "h w"]]) -> float:
    """Returns the masked share of the pixels, in the mean over photos."""
    return sum(float(mask.float().mean()) for mask in masks) / max(1, len(masks))
