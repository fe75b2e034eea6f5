"""Pseudo details from training views: zoomed in and redrawn (upscale), moved aside and redrawn (bootstrap).

Both are one procedure (spec 1.1-1.7): take windows of training cameras, some of them moved at random; zoom in; have a
regenerator redraw what is cut from the photograph or rendered there; compare with that for a while.
"""

import hashlib
import logging
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.augmenters.cameras import (
    KEPT,
    NOISES,
    WINDOWS,
    centred_window,
    grid_window,
    moved,
    noise,
    random_window,
    window_size,
    worst_window,
)
from gsx.augmenters.consistency import consistent_pixels, exactly_consistent
from gsx.augmenters.pixel_weights import WeightMap, agreeing, in_bytes, sampled_better, seen_alike
from gsx.augmenters.timing import SPLITS, Timing, event_at, events_of, progress, ramp, span_of, stepped
from gsx.core.data.camera import Camera
from gsx.core.data.images import write_image
from gsx.core.data.reduction import Reduction, as_blocks, projected
from gsx.core.data.resize import to_uint8
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError, InputError, TrainingError
from gsx.core.run_folder.checkpoint import sidecars, step_of
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float, UInt8
from gsx.core.training.augmenter import AugmenterContext
from gsx.core.training.pseudo_views import PseudoView, Term, load_views, picture_name, save_views
from gsx.core.training.regenerator import (
    Checked,
    Checks,
    Request,
    colour_matched,
    strayed,
    unusable,
)
from gsx.core.training.regenerator_context import regenerator_context
from gsx.core.training.render import render, splats_for
from gsx.core.training.run import Run
from gsx.core.training.schedule import Schedule

logger = logging.getLogger(__name__)

BATCH = 64
"""Pictures redrawn between two lines of progress."""
LEAST_WINDOW = 4
"""Narrowest window that shows anything, px."""
MOST_DROPPED = 0.5
"""An event that loses more than this share of its pictures at one scale is an error (spec 6.4)."""
MOST_TRIES = 10
"""Times that a place is drawn for a window until it shows enough of the scene (spec 1.7)."""
SHOWN = 3
"""Training views of an event whose pictures are kept to be looked at."""
ZOOMS = ("intrinsics", "none")
MODES = ("auto", "hybrid", "direct")
SOURCES = ("photo", "render")
LOSSES = ("l1", "l2")
REDUCTIONS = ("all", "per_scale")
FROZEN = ("none", "half", "active")
SEEDS = ("fixed", "per_view")
PROJECTIONS = ("none", "exact")
WEIGHT_MAPS: dict[str, WeightMap | None] = {"none": None, "splatsure": seen_alike, "finer": sampled_better}
CHOICES = {
    "window": WINDOWS,
    "noise": NOISES,
    "kept": KEPT,
    "zoom": ZOOMS,
    "mode": MODES,
    "base_source": SOURCES,
    "loss": LOSSES,
    "reduce": REDUCTIONS,
    "weight_split": SPLITS,
    "freeze_shared": FROZEN,
    "seeds": SEEDS,
    "project": PROJECTIONS,
    "weight_map": WEIGHT_MAPS,
}


@dataclass(frozen=True, kw_only=True)
class PseudoOptions:
    """Options; values in conf/augmenter, with their sources. Row numbers are those of the specification, 1.10."""

    name: str
    role: str
    """Regenerator: upscale or restore."""
    timing: Timing
    scales: list[int]
    """Zoom factors a; [1]: none."""
    base: bool
    """Whether the training camera itself is zoomed in."""
    base_source: str
    """photo: its window of the photograph is redrawn; render: what the model shows there (row 2)."""
    variants: int
    """Cameras moved at random per training camera and scale."""
    first_cameras: int
    """Training cameras, in order, that pseudo views are made from; 0: all (row 22)."""
    narrow: float
    """Width of the window in training as a fraction of the raster; 1: uncropped."""
    window: str
    """center, random, grid (one after the other over the events), or error (where the model is worst)."""
    zoom: str
    """intrinsics: the result is seen at a times the focal length; none: rendered at 1/a of the density and compared at
    the training density, the other reading of the paper (row 3)."""
    rotation_noise: float
    translation_noise: float
    translation_unit: str
    """world, or extent: of the scene (row 10)."""
    noise: str
    """uniform or normal (row 8)."""
    kept: str
    """What a turned camera keeps: t, or its center (row 9)."""
    relative_noise: bool
    """Turn less where the field of view is small: times min(1, 2 FOV'/FOV) (row 11)."""
    mode: str
    """hybrid: the term takes its share of the backbone's loss; direct: it is added; auto: hybrid with shared
    parameters, such as colour networks, direct without (spec 1.4)."""
    weights: list[float]
    """lambda: first and last."""
    weight_split: str
    """window: the first weight holds for half of each window; run: for half of the run; linear: in between (row 4)."""
    direct_weight: float
    """In direct mode, in place of lambda (row 25)."""
    loss: str
    """l1: mean |difference|, as in the paper; l2: mean square. Squares weigh the gaps that open between small splats;
    |difference| weighs a softer enlargement everywhere as much."""
    gain: float
    """Of the pseudo loss, before it is weighted (row 29)."""
    per_pixel: bool
    """Ours: weigh a pixel of a window like one of a whole picture, so that small windows do not outweigh the photos."""
    reduce: str
    """all: mean over all cameras; per_scale: mean over scales of the sum over cameras (row 6)."""
    densify: bool
    """Renders of pseudo views count in density control (row 28)."""
    freeze_shared: str
    """none; half, active: pseudo views do not move shared parameters, in the first half of a window or all of it
    (de-MLP, row 26)."""
    strength: list[float]
    """How much may change: at the first event and at the last."""
    prompt: str
    """For regenerators that read; {scene} is the name of the scene."""
    seeds: str
    """fixed: `seed` for every picture; per_view: another for each (row 21)."""
    seed: int
    samples: int
    """Results averaged for each picture (row 34)."""
    context: int
    """Pixels around the window that the regenerator also sees."""
    least_alpha: float
    """Windows at random places, or of cameras moved at random, are drawn again, ten times at most, while the model's
    mean alpha in them is lower: objects fill little of their pictures (spec 1.7). 0: the first is taken."""
    project: str
    """exact: the nearest picture that reduces to its input as the scene's pictures do, of photographs in 8 bits: every
    pixel where they are box averages, else nearly every one; the share is logged (spec 5.3)."""
    weight_map: str
    """none; splatsure: surfaces count that no photograph shows more finely than another (spec 6.1); finer, ours: those
    that no photograph shows as finely as the pseudo view does."""
    gate: float
    """Blocks do not count that reduce to what is further than this from the known photograph, in 8-bit levels; 0: all
    count."""
    coarse_weight: float
    """Of the mean difference between the reduced render and the known photograph, beside that of the pixels."""
    progressive: bool
    """The scales one after the other over the events, instead of all at once."""
    checks: Checks
    """Of redrawn pictures against what they were made from; those of the regenerator's role unless said otherwise."""
    coarser: list[int] = field(default_factory=list)
    """Training cameras also count at these fractions of their size: photographs as the scene reduces them, renders by
    box averages (Mipmap-GS)."""

    def __post_init__(self) -> None:
        where = f"augmenter.{self.name}"
        for key, allowed in CHOICES.items():
            if getattr(self, key) not in allowed:
                raise ValueError(f"{where}.{key} is '{getattr(self, key)}'; choose from {', '.join(allowed)}")
        if self.translation_unit not in ("world", "extent"):
            raise ValueError(f"{where}.translation_unit is '{self.translation_unit}'; choose world or extent")
        if not self.scales or min(self.scales) < 1:
            raise ValueError(f"{where}.scales is {list(self.scales)}; give factors of 1 or more")
        if any(factor < 2 for factor in self.coarser):
            raise ValueError(f"{where}.coarser is {list(self.coarser)}; give factors of 2 or more")
        if not 0 < self.narrow <= 1:
            raise ValueError(f"{where}.narrow is {self.narrow}; give a fraction above 0, at most 1")
        for key in ("weights", "strength"):
            if len(getattr(self, key)) != 2 or not all(0 <= value <= 1 for value in getattr(self, key)):
                raise ValueError(f"{where}.{key} is {list(getattr(self, key))}; give two values from 0 to 1")
        if self.variants < 0 or self.first_cameras < 0 or self.samples < 1 or self.context < 0:
            raise ValueError(f"{where}: variants, first_cameras and context must be at least 0, samples at least 1")
        if not 0 <= self.least_alpha <= 1:
            raise ValueError(f"{where}.least_alpha is {self.least_alpha}; give a coverage from 0 to 1")
        if min(self.gate, self.coarse_weight, self.gain, self.direct_weight) < 0:
            raise ValueError(f"{where}: gate, coarse_weight, gain and direct_weight must be at least 0")
        if not self.base and self.variants == 0:
            raise ValueError(f"{where}.base is false and variants is 0: there would be no pseudo view")

    def begins(self, iterations: int) -> int:
        """First event of a run of that length."""
        published = self.timing.published_iterations
        schedule = Schedule(iterations=iterations, published_iterations=published, views=1)  # no view decides it
        return min(events_of(self.timing, schedule), default=iterations)


@dataclass(frozen=True, eq=False, kw_only=True)
class PseudoViewSpec:
    """A pseudo view before its picture is drawn."""

    parent: int
    scale: int
    kind: str
    """base or random."""
    seen: Camera
    """What is redrawn, with context around it."""
    inside: Window
    """Of `seen`: what is kept."""
    outer: Window | None
    """Of the photograph, where `seen` is cut from it; None: it is rendered."""
    camera: Camera
    """Of the result."""
    seed: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Drawn:
    """What has become of a sketch."""

    scale: int
    view: PseudoView | None
    """None: its picture is dropped."""
    problem: str
    """Why it is dropped."""
    warnings: dict[str, str]
    """By check, what is told of a picture that is kept."""


class PseudoDetails:
    """Pseudo views of one kind and their share in the loss."""

    def __init__(self, options: PseudoOptions, context: AugmenterContext) -> None:
        self.options, self.context = options, context
        self.schedule = Schedule(
            iterations=context.iterations,
            published_iterations=options.timing.published_iterations,
            views=len(context.scene.train),
        )
        self.events, self.span = events_of(options.timing, self.schedule), span_of(options.timing, self.schedule)
        self.refuse_impossible()
        self.event = 0
        self.views: dict[int, list[PseudoView]] = {}
        self.facts: dict[str, Any] = {}

    def refuse_impossible(self) -> None:
        """Now, not when half of the run is over.

        Raises:
            ConfigError, InputError: windows would be too small, or the regenerator cannot do what it will be asked for.
        """
        options, name = self.options, self.context.name
        for view in self.context.scene.train:
            if options.coarser and min(view.camera.size) < LEAST_WINDOW * max(options.coarser):
                raise ConfigError(
                    f"augmenter.{name}.coarser: '{view.name}' reduced by {max(options.coarser)} is less than "
                    f"{LEAST_WINDOW} px wide or high: give smaller factors"
                )
            for scale in options.scales:
                width, height = size = window_size(*view.camera.size, options.narrow, scale)
                if min(size) < LEAST_WINDOW:
                    raise ConfigError(
                        f"augmenter.{name}: at scale {scale} and narrow {options.narrow:g} windows of '{view.name}' "
                        f"are {width} x {height} px; {LEAST_WINDOW} px are the least: lower scales or raise narrow"
                    )
        regenerator = self.context.regenerator(options.role)
        if isinstance(regenerator, Checked):
            regenerator.check(self.context.scene.train, options.scales, options.variants > 0)
        if not self.events:
            logger.warning("augmenter %s has no event in a run of %d steps", name, self.context.iterations)

    # -- what the trainer asks -------------------------------------------------------------------------------------

    def begins(self) -> int:
        """The first event."""
        return self.options.begins(self.context.iterations)

    def plan(self) -> dict[str, Any]:
        """Events and windows in steps of this run."""
        share = 0.0 if self.options.mode == "direct" else max(self.options.weights)
        return {"events": self.events, "span": self.span, "share": share}

    def term(self, run: Run, step: int, view: int) -> Term | None:
        """The pseudo views of the training view picked at this step, with their weights (spec 1.3)."""
        event = event_at(step, self.events, self.span)
        if event is None:
            self.views, self.event, self.facts = {}, 0, {}
            return None
        if event != self.event:
            found, self.facts = self.of_event(run, event, view)
            self.views, self.event = by_parent(found), event
        split = self.options.weight_split
        inside, place = (progress(step, event, self.events, self.span, kind) for kind in ("window", split))
        return self.weighted(run, self.views.get(view, []), place, inside)

    def weighted(self, run: Run, views: Sequence[PseudoView], place: float, inside: float) -> Term | None:
        """The term of these views, so far along the weights and inside the window; None for none.

        A view weighs the same whether others of its training view were dropped or not; what these would have taken of
        the backbone's own loss stays there.
        """
        options = self.options
        if not views:
            return None
        share = stepped(options.weights, place, options.weight_split)
        direct = options.mode == "direct" or (options.mode == "auto" and not list(run.backbone.shared()))
        each = options.gain * (options.direct_weight if direct else share)
        scales, pictures = self.planned()
        count = pictures if options.reduce == "all" else scales
        frozen = options.freeze_shared == "active" or (options.freeze_shared == "half" and inside < 0.5)
        whole = run.scene.train[views[0].parent].camera
        return Term(
            name=self.context.name,
            parts=[(view, each / count * (area_share(view, whole) if options.per_pixel else 1.0)) for view in views],
            replaces=0.0 if direct else share * len(views) / pictures,
            observed=options.densify,
            shared=not frozen,
            squared=options.loss == "l2",
        )

    def planned(self) -> tuple[int, int]:
        """(scales, pictures) of each training view at the event at hand, if none is dropped."""
        options, scales = self.options, len(self.scales_of(self.event))
        coarser = len(options.coarser)
        return scales + coarser, scales * (options.variants + options.base) + coarser

    def told(self, step: int) -> dict[str, Any]:
        """Pictures asked for, dropped and warned of by scale, at the first step that asks for them; else nothing."""
        if not self.facts or step != self.event + 1:
            return {}
        return {key: self.facts[key] for key in ("event", "asked", "dropped", "warned")}

    # -- events ----------------------------------------------------------------------------------------------------

    def of_event(self, run: Run, event: int, view: int) -> tuple[list[PseudoView], dict[str, Any]]:
        """(pseudo views, facts) of an event: made now, or as the run made them before it was interrupted.

        Only those that steps of its window will ask for, the first of them for `view` and the rest of its batch: the
        others are never looked at. Of several processes the first makes them all.

        Raises:
            InputError: the run is past the event, and the file of its pseudo views is gone.
        """
        fresh = run.step == event
        made = self.written(run, event, view) if fresh and run.ranks.first else None
        if fresh:
            run.ranks.all_gather(None)  # the others wait for the file
        return self.recalled(run, event) if made is None else made

    def written(self, run: Run, event: int, view: int) -> tuple[list[PseudoView], dict[str, Any]]:
        """(pseudo views, facts) of an event that begins with this step, made and written to its file."""
        steps = min(self.span, run.iterations - event)
        views, facts = self.made(run, event, {view, *run.sampler.taken} | run.sampler.coming(steps - 1))
        path = self.path(run, event)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_views(path, views, facts)
        self.forget(run, event)
        return views, facts

    def path(self, run: Run, event: int) -> Path:
        """Where the pseudo views of an event are kept while a checkpoint may need them."""
        return run.folder / "pseudo" / f"{self.context.name}_{event:07d}.safetensors"

    def files(self, run: Run) -> list[Path]:
        """Those that there are, oldest first."""
        return sorted((run.folder / "pseudo").glob(f"{self.context.name}_{'[0-9]' * 7}.safetensors"))

    def forget(self, run: Run, event: int) -> None:
        """Remove the files of events in whose windows no checkpoint lies, but for that of the current one."""
        steps = map(step_of, sidecars(run.folder / "checkpoints"))
        needed = {event} | {event_at(step + 1, self.events, self.span) for step in steps}
        kept = {self.path(run, number) for number in needed if number is not None}
        for path in self.files(run):
            if path not in kept:
                path.unlink()

    def recalled(self, run: Run, event: int) -> tuple[list[PseudoView], dict[str, Any]]:
        """(pseudo views, facts) that the run had made before it was interrupted.

        None where it was made longer since, so that its events and windows lie elsewhere: the next one goes on.

        Raises:
            InputError: the file is gone or damaged.
        """
        path = self.path(run, event)
        latest = [path] if path.is_file() else self.files(run)[-1:]
        try:
            if latest and (found := load_views(latest[0]))[1]["iterations"] != self.context.iterations:
                logger.info("%s rests until its next event: the run has become longer", self.context.name)
                return [], {}
            return found if latest == [path] else load_views(path)
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path} cannot be read ({error}): it holds the pseudo views of step {event}, without which the run "
                f"cannot go on at step {run.step}; restore the file, or train anew"
            ) from error

    def made(self, run: Run, event: int, parents: Set[int]) -> tuple[list[PseudoView], dict[str, Any]]:
        """(pseudo views of some training views, facts) of an event, from the model as it is now.

        Raises:
            TrainingError: more than half of the pictures of a scale could not be used.
        """
        regenerator = self.context.regenerator(self.options.role)
        learnt = regenerator.prepare(regenerator_context(run, self.context.seed))
        if learnt:
            told = ", ".join(f"{name} {value:.3g}" for name, value in learnt.items())
            logger.info("%s, regenerator at step %d: %s", self.context.name, event, told)
        specs = list(self.specs(run, event, parents))
        drawn = self.all_drawn(run, event, specs)
        views = [one.view for one in drawn if one.view is not None]
        views += [
            self.coarser_view(run, event, parent, factor)
            for parent in sorted({spec.parent for spec in specs})
            for factor in self.options.coarser
        ]
        facts: dict[str, Any] = {
            "event": event,
            "iterations": self.context.iterations,
            "made": len(views),
            "learnt": learnt,
            **self.judged(event, drawn),
        }
        trusted = [float(view.pixel_weight.float().mean()) / 255 for view in views if view.pixel_weight is not None]
        kept = [view.provenance["consistent"] for view in views if "consistent" in view.provenance]
        if kept:
            share = sum(kept) / len(kept)
            facts["consistent"] = share
            logger.info("%s: %.1f%% consistent pixels", self.context.name, 100 * share)
        if trusted:
            masked = 1 - (sum(trusted) + len(views) - len(trusted)) / len(views)
            facts["masked"] = masked
            logger.info("%s: %.1f%% of the pixels do not count", self.context.name, 100 * masked)
        return views, facts

    def all_drawn(self, run: Run, event: int, specs: Sequence[PseudoViewSpec]) -> list[Drawn]:
        """What has become of each sketch, told batch by batch."""
        drawn: list[Drawn] = []
        shown = sorted({spec.parent for spec in specs})[:SHOWN]
        for first in range(0, len(specs), BATCH):
            drawn += self.drawn(run, event, specs[first : first + BATCH], shown)
            logger.info("%s at step %d: %d of %d pictures", self.context.name, event, len(drawn), len(specs))
        return drawn

    def judged(self, event: int, drawn: Sequence[Drawn]) -> dict[str, Any]:
        """Pictures asked for, dropped, and by check warned of, by scale; said in the log where there are any.

        Raises:
            TrainingError: more than half of the pictures of a scale could not be used.
        """
        name = self.context.name
        asked, dropped = by_scale(drawn), by_scale([one for one in drawn if one.view is None])
        warned: dict[str, dict[str, int]] = {}
        for scale, count in dropped.items():
            reason = next(one.problem for one in drawn if one.problem and str(one.scale) == scale)
            logger.warning("%s: %d of %d x%s pictures dropped: %s", name, count, asked[scale], scale, reason)
            if count > MOST_DROPPED * asked[scale]:
                raise TrainingError(
                    f"augmenter {name} lost {count} of {asked[scale]} pictures at x{scale}, step {event}: {reason}; "
                    f"choose another regenerator/{self.options.role}, or loosen augmenter.{name}.checks{self.remedy}"
                )
        for check in dict.fromkeys(check for one in drawn for check in one.warnings):
            strays = [one for one in drawn if check in one.warnings]
            warned[check] = by_scale(strays)
            first = strays[0].warnings[check]
            logger.warning("%s: %d of %d pictures kept although %s", name, len(strays), len(drawn), first)
        return {"asked": asked, "dropped": dropped, "warned": warned}

    def specs(self, run: Run, event: int, parents: Set[int]) -> Iterator[PseudoViewSpec]:
        """Cameras of an event beside some training views, in the order of these, base before random."""
        options = self.options
        for parent in sorted(parents):
            if options.first_cameras and parent >= options.first_cameras:
                continue
            for scale in self.scales_of(event):
                variants = range(0 if options.base else 1, options.variants + 1)
                yield from (self.spec(run, event, parent, scale, variant) for variant in variants)

    def scales_of(self, event: int) -> list[int]:
        """All of them, or the one whose turn it is."""
        scales = list(self.options.scales)
        if not self.options.progressive:
            return scales
        return [scales[self.events.index(event) * len(scales) // len(self.events)]]

    def spec(self, run: Run, event: int, parent: int, scale: int, variant: int) -> PseudoViewSpec:
        """One camera; variant 0 is the training camera's own."""
        options, own = self.options, run.scene.train[parent].camera
        generator = torch.Generator().manual_seed(
            derived_seed(self.context.seed, self.context.name, event, parent, scale, variant)
        )
        zoom = scale if options.zoom == "intrinsics" else 1
        size = window_size(own.width, own.height, options.narrow, zoom)
        pose, window = self.looking(run, event, parent, scale, variant, size, generator)
        outer = window.grown(options.context, own.width, own.height)
        inside = Window(
            left=window.left - outer.left, top=window.top - outer.top, width=window.width, height=window.height
        )
        result = window.of(pose)
        seen = outer.of(pose)
        if zoom > 1:
            result = result.zoom(zoom)
        elif scale > 1:  # the other reading: fewer pixels are redrawn to as many
            inside, seen, result = reduced(window, pose, scale)
        return PseudoViewSpec(
            parent=parent,
            scale=scale,
            kind="base" if variant == 0 else "random",
            seen=seen,
            inside=inside,
            outer=outer if variant == 0 and options.base_source == "photo" and (zoom > 1 or scale == 1) else None,
            camera=result,
            seed=options.seed
            if options.seeds == "fixed"
            else derived_seed(self.context.seed, "noise", event, parent, scale, variant),
        )

    def looking(
        self,
        run: Run,
        event: int,
        parent: int,
        scale: int,
        variant: int,
        size: tuple[int, int],
        generator: torch.Generator,
    ) -> tuple[Camera, Window]:
        """(camera, window) of a pseudo view; of those drawn at random the first that shows enough of the scene."""
        own, options = run.scene.train[parent].camera, self.options
        checked = options.least_alpha > 0 and (variant > 0 or (options.window == "random" and size != own.size))
        for _ in range(MOST_TRIES if checked else 1):
            pose = own if variant == 0 else self.beside(own, scale, generator)
            window = self.placed(run, parent, pose, size, event, variant, generator)
            if not checked or float(render(run, window.of(pose)).alpha.mean()) >= options.least_alpha:
                break
        return pose, window

    def beside(self, camera: Camera, scale: int, generator: torch.Generator) -> Camera:
        """A camera near a training camera."""
        options = self.options
        turn = options.rotation_noise
        if options.relative_noise:
            turn *= min(1.0, 2 * options.narrow / scale)
        unit = self.context.scene.extent if options.translation_unit == "extent" else 1.0
        return moved(
            camera,
            noise((3, 3), options.noise, turn, generator),
            noise((3,), options.noise, options.translation_noise * unit, generator),
            options.kept,
        )

    def placed(
        self,
        run: Run,
        parent: int,
        pose: Camera,
        size: tuple[int, int],
        event: int,
        variant: int,
        generator: torch.Generator,
    ) -> Window:
        """Where the window lies on the raster (spec 1.7)."""
        width, height = pose.size
        kind = self.options.window
        if kind == "random" or (kind == "error" and variant > 0):
            return random_window(width, height, size, generator)
        if kind == "grid":
            turn = self.events.index(event) * (self.options.variants + 1) + variant + parent
            return grid_window(width, height, size, turn)
        if kind == "error":
            view = run.scene.train[parent]
            return worst_window((render(run, pose).image - view.image()).abs().mean(0), size)
        return centred_window(width, height, size)

    def drawn(self, run: Run, event: int, specs: Sequence[PseudoViewSpec], shown: Sequence[int]) -> list[Drawn]:
        """What becomes of each sketch; pictures of the training views `shown` are kept to be looked at."""
        regenerator = self.context.regenerator(self.options.role)
        requests = [self.request(run, event, spec) for spec in specs]
        samples = [regenerator.regenerate([again(r, n) for r in requests]) for n in range(self.options.samples)]
        out: list[Drawn] = []
        for spec, request, *results in zip(specs, requests, *samples, strict=True):
            result = torch.stack([result.detach().cpu().float() for result in results]).mean(0)
            one = self.checked(run, event, spec, request, result)
            if one.view is not None and spec.parent in shown:
                self.show(run.folder / "pseudo", spec, request, one.view)
            out.append(one)
        return out

    def checked(self, run: Run, event: int, spec: PseudoViewSpec, request: Request, result: Tensor) -> Drawn:
        """The pseudo view of a result, if it may be used."""
        problem, found = unusable(request, result), dict[str, str]()
        if not problem:
            result = colour_matched(request, result)
            if self.options.project == "exact" and request.scale > 1:
                result = projected(result, request.image.cpu(), request.scale, request.reduction)
            found = strayed(request, result, self.options.checks)
            dropped = [told for check, told in found.items() if getattr(self.options.checks, check).action == "drop"]
            problem = "; ".join(dropped)
        named = problem and f"{request.view.name}: {problem}"
        view = None if problem else self.view(run, event, spec, request, result)
        warnings = {} if problem else {check: f"{request.view.name}: {told}" for check, told in found.items()}
        return Drawn(scale=spec.scale, view=view, problem=named, warnings=warnings)

    def request(self, run: Run, event: int, spec: PseudoViewSpec) -> Request:
        """What the regenerator is asked for."""
        view = run.scene.train[spec.parent]
        image = render(run, spec.seen).image if spec.outer is None else spec.outer.cut(view.image())
        return Request(
            image=image,
            scale=spec.scale,
            reduction=run.scene.reduction,
            camera=spec.seen,
            view=view,
            number=spec.parent,
            photo=spec.outer is not None,
            seed=spec.seed,
            strength=ramp(self.options.strength, event, self.options.timing, self.schedule),
            strongest=self.options.strength[0],
            prompt=self.options.prompt.replace("{scene}", run.scene.name),
            step=event,
        )

    @property
    def remedy(self) -> str:
        """What else helps where a regenerator strays too far."""
        enlarging = max(self.options.scales) > 1 and self.options.project == "none"
        return f", or augmenter.{self.context.name}.project=exact" if enlarging else ""

    def view(
        self, run: Run, event: int, spec: PseudoViewSpec, request: Request, result: Float[Tensor, "3 H W"]
    ) -> PseudoView:
        """The pseudo view of a result: its window, in 8 bits."""
        a, inside = spec.scale, spec.inside
        target = to_uint8(result.clamp(0, 1))
        if self.options.project == "exact" and a > 1 and request.photo:
            target = exactly_consistent(result, to_uint8(request.image), a, request.reduction)
        window = Window(left=a * inside.left, top=a * inside.top, width=a * inside.width, height=a * inside.height)
        kept = window.cut(target).contiguous()
        shares = {}
        if request.photo and a > 1:
            same = consistent_pixels(target, to_uint8(request.image), a, request.reduction)
            shares = {"consistent": float(inside.cut(same[None].float()).mean())}
        known = request.photo and a > 1 and self.options.coarse_weight > 0
        return PseudoView(
            camera=spec.camera,
            target=kept,
            parent=spec.parent,
            pixel_weight=self.pixel_weight(run, spec, request, target.float() / 255, window),
            coarse=to_uint8(inside.cut(request.image)).contiguous() if known else None,
            coarse_weight=self.options.coarse_weight if known else 0.0,
            reduction=request.reduction,
            provenance={
                "event": event,
                "view": request.view.name,
                "kind": spec.kind,
                "scale": a,
                "source": "photo" if request.photo else "render",
                "seed": request.seed,
                "strength": request.strength,
                **shares,
                "sha256": hashlib.sha256(kept.numpy().tobytes()).hexdigest(),
            },
        )

    def coarser_view(self, run: Run, event: int, parent: int, factor: int) -> PseudoView:
        """The training camera at a fraction of its size, without what fills no block at the right and below."""
        view = run.scene.train[parent]
        width, height = view.camera.size
        whole = Window(left=0, top=0, width=width, height=height)
        _, camera, covered = reduced(whole, view.camera, factor)
        photo = self.options.base_source == "photo"
        picture = view.image() if photo else render(run, view.camera).image
        reduction = run.scene.reduction if photo else Reduction()  # Mipmap-GS: bilinear, which is the mean of four
        target = to_uint8(reduction.reduce(Window(0, 0, *covered.size).cut(picture), factor))
        return PseudoView(
            camera=camera,
            target=target,
            parent=parent,
            provenance={
                "event": event,
                "view": view.name,
                "kind": "coarser",
                "scale": 1 / factor,
                "source": "photo" if photo else "render",
                "sha256": hashlib.sha256(target.numpy().tobytes()).hexdigest(),
            },
        )

    def pixel_weight(
        self, run: Run, spec: PseudoViewSpec, request: Request, result: Float[Tensor, "3 H W"], window: Window
    ) -> UInt8[Tensor, "h w"] | None:
        """How much each pixel of a window of the result counts; None where all count whole."""
        options, pixel_weight = self.options, torch.ones(window.height, window.width)
        weights = WEIGHT_MAPS[options.weight_map]
        if weights is not None:
            photographs = [view.camera for view in run.scene.train]
            pixel_weight = (
                pixel_weight * weights(splats_for(run, spec.camera), spec.camera, photographs, run.raster).cpu()
            )
        if options.gate > 0 and request.photo and spec.scale > 1:
            agreed = agreeing(result, request.image, spec.scale, request.reduction, options.gate)
            pixel_weight = pixel_weight * window.cut(agreed[None])[0]
        return None if bool((pixel_weight == 1).all()) else in_bytes(pixel_weight)

    def show(self, folder: Path, spec: PseudoViewSpec, request: Request, view: PseudoView) -> None:
        """Keep a picture to be looked at: what was redrawn, enlarged, the result, and their difference."""
        given = as_blocks(spec.inside.cut(request.image), spec.scale)
        result = view.target.float() / 255
        difference = (0.5 + 4 * (result - given)).clamp(0, 1)
        folder.mkdir(parents=True, exist_ok=True)
        write_image(folder / picture_name(self.context.name, view), torch.cat([given, result, difference], 2))


def again(request: Request, number: int) -> Request:
    """The request for its n-th sample."""
    return replace(request, seed=request.seed + number)


def reduced(window: Window, pose: Camera, scale: int) -> tuple[Window, Camera, Camera]:
    """(all of it, camera of 1/scale the density, camera of the result) for a window whose sides are made divisible."""
    width, height = max(1, window.width // scale), max(1, window.height // scale)
    whole = Window(left=window.left, top=window.top, width=width * scale, height=height * scale).of(pose)
    return Window(left=0, top=0, width=width, height=height), whole.resize(width, height), whole


def by_scale(drawn: Sequence[Drawn]) -> dict[str, int]:
    """How many there are at each scale; keys as JSON has them."""
    counts = Counter(one.scale for one in drawn)
    return {str(scale): counts[scale] for scale in sorted(counts)}


def by_parent(views: Sequence[PseudoView]) -> dict[int, list[PseudoView]]:
    """Pseudo views by the training view they were made from."""
    found: dict[int, list[PseudoView]] = {}
    for view in views:
        found.setdefault(view.parent, []).append(view)
    return found


def area_share(view: PseudoView, whole: Camera) -> float:
    """Pixels of a pseudo view per pixel of a training view."""
    return view.camera.width * view.camera.height / (whole.width * whole.height)
