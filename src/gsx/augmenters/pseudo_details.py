"""Pseudo details: training views that are zoomed in (upscale) or moved (bootstrap), and redrawn.

Both take windows of training cameras, some moved at random, zoom in, let a regenerator redraw the photo or the render
there, and compare the model with the result for a while.
"""

import logging
import math
from collections import defaultdict
from collections.abc import Set
from dataclasses import replace
from typing import Any

from gsx.augmenters.checked_regenerator import CheckedRegenerator, Redrawing, gain_over_filter
from gsx.augmenters.planner import Planner
from gsx.augmenters.pseudo_options import WEIGHT_MAPS, PseudoOptions, event_at, events_of, progress, span_of, stepped
from gsx.augmenters.redraw import Redrawer
from gsx.augmenters.store import Store
from gsx.core.errors import ConfigError
from gsx.core.training.augmenter import AugmenterContext
from gsx.core.training.parameter_table import shared_colour
from gsx.core.training.pseudo_views import PseudoView, Term
from gsx.core.training.run import Run
from gsx.core.training.schedule import Schedule

logger = logging.getLogger(__name__)

LEAST_WINDOW = 4
"""Least side of a window, px."""
LARGE = 2.0
"""Size of an event's pictures above which a warning names remedies, 1e9 bytes."""
WINDOWS = ("window=random", "timing.stop=39500", "timing.every=500", "timing.span=500")
"""Options that replace whole pictures by random windows, which change over the run."""


class PseudoDetails(Redrawing):
    """Pseudo views of one kind and their term of the loss."""

    def __init__(self, options: PseudoOptions, context: AugmenterContext) -> None:
        self.options, self.context = options, context
        self.schedule = Schedule(
            iterations=context.iterations,
            published_iterations=options.timing.published_iterations,
            views=len(context.scene.train),
        )
        self.events, self.span = events_of(options.timing, self.schedule), span_of(options.timing, self.schedule)
        self.regenerator = CheckedRegenerator.of_role(context, options.role, options.checks)
        if max(options.scales) > 1 and options.project == "none":
            self.regenerator.tally.remedies.append(f"augmenter.{context.name}.project=exact")
        self.refuse_impossible()
        self.planner = Planner(
            name=context.name, options=options, seed=context.seed, extent=context.scene.extent, events=self.events
        )
        self.store = Store(name=context.name, iterations=context.iterations, events=self.events, span=self.span)
        self.redrawer = Redrawer(
            name=context.name,
            options=options,
            regenerator=self.regenerator,
            schedule=self.schedule,
            weight_map=WEIGHT_MAPS[options.weight_map](),
        )
        self.event = 0
        self.views: dict[int, list[PseudoView]] = {}

    def refuse_impossible(self) -> None:
        """Raises errors of impossible options before training."""
        options, name = self.options, self.context.name
        for view in self.context.scene.train:
            if options.coarser and min(view.camera.size) < LEAST_WINDOW * max(options.coarser):
                raise ConfigError(
                    f"augmenter.{name}.coarser: '{view.name}' reduced by {max(options.coarser)} is less than "
                    f"{LEAST_WINDOW} px wide or high: give smaller factors"
                )
            for scale in options.scales:
                width, height = size = options.window_size(view.camera, scale)
                if min(size) < LEAST_WINDOW:
                    raise ConfigError(
                        f"augmenter.{name}: at scale {scale} and narrow {options.narrow:g} windows of '{view.name}' "
                        f"are {width} x {height} px; {LEAST_WINDOW} px are the least: lower scales or raise narrow"
                    )
        self.regenerator.refuse(self.context.scene.train, options.scales, options.variants > 0)
        if not self.events:
            logger.warning("augmenter %s has no event in a run of %d steps", name, self.context.iterations)
        if options.window == "whole" and (gigabytes := self.gigabytes()) > LARGE:
            logger.warning(
                "augmenter %s keeps %.1f GB of pictures in memory: set a larger scene.downscale, or windows: %s",
                *(name, gigabytes, " ".join(f"augmenter.{name}.{word}" for word in WINDOWS)),
            )

    def gigabytes(self) -> float:
        """Returns the size of the pseudo views of an event that makes them for all training views, 1e9 bytes."""
        cameras, scales = [view.camera for view in self.context.scene.train], self.options.scales
        windows = [(scale, self.options.window_size(camera, scale)) for camera in cameras for scale in scales]
        return 3e-9 * sum(scale**2 * math.prod(size) for scale, size in windows)

    def begins(self) -> int:
        """Returns the first event."""
        return self.options.begins(self.context.iterations)

    def plan(self) -> dict[str, Any]:
        """Returns events and windows in steps of this run."""
        return {"events": self.events, "span": self.span, "share": self.share()}

    def share(self) -> float:
        """Returns the largest share of the photo loss that its terms replace."""
        return 0.0 if self.options.mode == "direct" else max(self.options.weights)

    def term(self, run: Run, step: int, view: int) -> Term | None:
        """Returns the weighted pseudo views of this step's training view."""
        event = event_at(step, self.events, self.span)
        if event is None:
            self.views, self.event = {}, 0
            return None
        made: list[PseudoView] = []
        if event != self.event:
            views, fresh = self.of_event(run, event, view)
            self.views, self.event = defaultdict(list), event
            for pseudo in views:
                self.views[pseudo.parent].append(pseudo)
            made = views if fresh else []
        split = self.options.weight_split
        inside, place = (progress(step, event, self.events, self.span, kind) for kind in ("window", split))
        if view not in self.views and not made:
            return None
        return replace(self.weighted(run, view, place, inside), made=made)

    def weighted(self, run: Run, view: int, place: float, inside: float) -> Term:
        """Weights the pseudo views of a training view, at places along the weights and the window, 0 to 1.

        Dropped views do not change the weights of the others; their share stays with the backbone's own loss.
        """
        options, views = self.options, self.views.get(view, [])
        share = stepped(options.weights, place, options.weight_split)
        direct = options.mode == "direct" or (options.mode == "auto" and not shared_colour(run.backbone.table))
        each = options.gain * (options.direct_weight if direct else share)
        scales, pictures = self.planned()
        count = pictures if options.reduce == "all" else scales
        frozen = options.freeze_shared == "active" or (options.freeze_shared == "half" and inside < 0.5)
        width, height = run.scene.train[view].camera.size
        areas = [pseudo.camera.width * pseudo.camera.height / (width * height) for pseudo in views]
        sizes = areas if options.per_pixel else [1.0] * len(views)
        return Term(
            name=self.context.name,
            parts=[(at_current_pose(run, one), each / count * size) for one, size in zip(views, sizes, strict=True)],
            replaces=0.0 if direct else share * len(views) / pictures,
            observed=options.densify,
            shared=not frozen,
            squared=options.loss == "l2",
            ssim_weight=run.training.ssim_weight if options.loss == "photometric" else 0.0,
        )

    def planned(self) -> tuple[int, int]:
        """Returns (scales, pictures) of each training view at this event, dropped ones included."""
        options, scales = self.options, len(self.planner.scales_of(self.event))
        coarser = len(options.coarser)
        return scales + coarser, scales * (options.variants + options.base) + coarser

    def of_event(self, run: Run, event: int, view: int) -> tuple[list[PseudoView], bool]:
        """Returns (pseudo views of an event, whether they are new), new ones made and stored by rank 0.

        Only training views that steps of the event's window use get pseudo views: `view`, the rest of its batch, and
        the coming ones.

        Raises:
            InputError: the run was interrupted after the event, and the file of its pseudo views is missing.
        """
        made: list[PseudoView] | None = None
        fresh = all(run.skipped(step) for step in range(event + 1, run.step + 1))
        if fresh and run.ranks.first:
            steps = min(event + self.span, run.iterations) - run.step
            made, facts = self.made(run, event, {view, *run.sampler.current} | run.sampler.coming(steps - 1))
            self.store.write(run, event, made, facts)
        if fresh:
            run.ranks.all_gather(None)  # the others wait for the file
        return (self.store.recalled(run, event) if made is None else made), fresh

    def trust(self, run: Run, event: int) -> tuple[float, bool]:
        """Measures the regenerator on the scene's own photos; returns (its gain in dB, whether to use it)."""
        least, name = self.options.least_gain, self.context.name
        if not least:
            return 0.0, True
        gain = gain_over_filter(run, self.regenerator, max(2, *self.options.scales), event)
        trusted = gain >= least
        remedy = f"no pseudo views: augmenter.{name}.least_gain=0 makes them all the same"
        logger.log(
            logging.INFO if trusted else logging.WARNING,
            "step %d: reduced photos are enlarged %.1f dB better than by Lanczos' filter %s %.1f dB, %s",
            *(event, gain, ">=" if trusted else "<", least, f"{name} is used" if trusted else remedy),
        )
        return gain, trusted

    def made(self, run: Run, event: int, parents: Set[int]) -> tuple[list[PseudoView], dict[str, Any]]:
        """Makes (pseudo views of some training views, facts) of an event with the current model."""
        learnt = self.regenerator.prepare(run, self.context)
        if learnt:
            figures = ", ".join(f"{name} {value:.3g}" for name, value in learnt.items())
            logger.info("%s, regenerator at step %d: %s", self.context.name, event, figures)
        gain, trusted = self.trust(run, event)
        specs = list(self.planner.specs(run, event, parents)) if trusted else []
        views = self.redrawer.redraw_all(run, event, specs)
        views += [
            self.redrawer.coarser_view(run, event, parent, factor)
            for parent in sorted({spec.parent for spec in specs})
            for factor in self.options.coarser
        ]
        facts: dict[str, Any] = {
            **self.regenerator.tally.account(run.step),  # after which they are made: late if steps were skipped
            "event": event,
            "iterations": self.context.iterations,
            "made": len(views),
            "learnt": learnt,
            **({"gain": gain} if self.options.least_gain else {}),
        }
        weights = [float(view.pixel_weight.float().mean()) / 255 for view in views if view.pixel_weight is not None]
        shares = [view.provenance["consistent"] for view in views if "consistent" in view.provenance]
        if shares:
            facts["consistent"] = sum(shares) / len(shares)
            logger.info(
                "step %d, %s: enlarged photos, reduced again, equal the photo in %.1f %% of its pixels",
                *(event, self.context.name, 100 * facts["consistent"]),
            )
        if weights:
            facts["masked"] = 1 - (sum(weights) + len(views) - len(weights)) / len(views)
            logger.info(
                "step %d, %s: pixel weights take %.1f %% of the pseudo views out of the loss",
                *(event, self.context.name, 100 * facts["masked"]),
            )
        return views, facts


def at_current_pose(run: Run, view: PseudoView) -> PseudoView:
    """Returns a pseudo view; if it shows a photo, at the pose that the photo has now."""
    camera = run.train_views[view.parent].camera
    if view.provenance.get("source") != "photo" or view.camera.has_pose_of(camera):
        return view
    return replace(view, camera=view.camera.with_pose_of(camera))
