"""Options of pseudo details, checked."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

from gsx.augmenters.cameras import window_size
from gsx.augmenters.checks import Checks
from gsx.augmenters.pixel_weights import MUCH_BETTER, SplatSuRe, WeightMap, sampled_better
from gsx.core.data.camera import Camera
from gsx.core.ranges import Interval, Range, Seed, Share, Steps, Weight
from gsx.core.training.schedule import Schedule

WEIGHT_MAPS: dict[str, Callable[[], WeightMap | None]] = {
    "none": lambda: None,
    "splatsure": SplatSuRe,
    "splatsure_1.7": partial(SplatSuRe, MUCH_BETTER),
    "finer": lambda: sampled_better,
}
"""Makers of weight maps; None: all pixels count."""
CHOICES = {
    "window": ("center", "random", "grid", "error", "whole"),
    "noise": ("uniform", "normal"),
    "kept": ("t", "center"),
    "zoom": ("intrinsics", "none"),
    "mode": ("auto", "hybrid", "direct"),
    "base_source": ("photo", "render"),
    "translation_unit": ("world", "extent"),
    "loss": ("l1", "l2", "photometric"),
    "reduce": ("all", "per_scale"),
    "weight_split": ("window", "run", "linear"),
    "freeze_shared": ("none", "half", "active"),
    "seeds": ("fixed", "per_view"),
    "project": ("none", "exact"),
    "weight_map": tuple(WEIGHT_MAPS),
}


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Events of a published run and the windows after them, in its steps."""

    published_iterations: Interval
    start: Steps
    """Step after which pseudo views are first made."""
    stop: Steps
    every: Interval
    span: Interval
    """Length of the window after an event, in which its pseudo views count."""
    stop_inclusive: bool

    def __post_init__(self) -> None:
        if self.start > self.stop:
            raise ValueError(f"timing: start is {self.start} and stop {self.stop}; give start <= stop")
        if self.span > self.every:
            raise ValueError(f"timing: span is {self.span}, longer than every, {self.every}: windows would overlap")


def events_of(timing: Timing, schedule: Schedule) -> list[int]:
    """Returns the steps of this run after which pseudo views are made, without duplicates in very short runs."""
    last = timing.stop + 1 if timing.stop_inclusive else timing.stop
    published = range(timing.start, last, timing.every)
    steps = {max(1, schedule.step(step)) for step in published}
    return sorted(step for step in steps if step < schedule.iterations)


def span_of(timing: Timing, schedule: Schedule) -> int:
    """Returns the length of a window in steps of this run."""
    return max(1, schedule.step(timing.span))


def event_at(step: int, events: Sequence[int], span: int) -> int | None:
    """Returns the event whose window contains a step (1-based), if any."""
    earlier = [event for event in events if event < step]
    return earlier[-1] if earlier and step <= earlier[-1] + span else None


def progress(step: int, event: int, events: Sequence[int], span: int, split: str) -> float:
    """Returns the place of a step, 0 to 1: in its window, or (run) from the first event to the last window's end."""
    if split == "run":
        return (step - events[0] - 1) / max(1, events[-1] + span - events[0] - 1)
    return (step - event - 1) / max(1, span - 1)


def stepped(values: list[float], place: float, split: str) -> float:
    """Returns a weight that changes half-way (window, run) or linearly (linear) between two values."""
    first, last = values
    if split == "linear":
        return first + (last - first) * place
    return first if place < 0.5 else last


def ramp(values: list[float], event: int, timing: Timing, schedule: Schedule) -> float:
    """Interpolates a value linearly from `start` to `stop`."""
    first, last = values
    start, stop = schedule.step(timing.start), schedule.step(timing.stop)
    return first + (last - first) * min(1.0, max(0, event - start) / max(1, stop - start))


@dataclass(frozen=True, kw_only=True)
class PseudoOptions:
    """Options of pseudo details; values in conf/augmenter, with their sources."""

    name: str
    role: str
    """Regenerator: upscale or restore."""
    timing: Timing
    scales: Annotated[list[int], Range(1, 64)]
    """Zoom factors a; [1]: none."""
    base: bool
    """True: also zoom in the training camera itself."""
    base_source: str
    """Input of its pseudo view, photo: the window of the photo; render: of the model's render."""
    variants: Annotated[int, Range(0, 1000)]
    """Randomly moved cameras per training camera and scale."""
    first_cameras: Steps
    """Number of first training cameras with pseudo views; 0: all."""
    narrow: Share
    """Width of the window in training as a fraction of the raster; 1: uncropped."""
    window: str
    """center, random, grid (in turn over the events), error (the largest mean error of the model), or whole: the whole
    picture, `narrow` does not count."""
    zoom: str
    """intrinsics: a times the focal length; none: input at 1/a of the density and result at the training density, the
    other reading of the paper."""
    rotation_noise: Annotated[float, Range(0, 10)]
    translation_noise: Annotated[float, Range(0, 1e6)]
    translation_unit: str
    """world, or extent (of the scene)."""
    noise: str
    """uniform or normal."""
    kept: str
    """Invariant of a turned camera: t (translation), or center."""
    relative_noise: bool
    """True: multiply rotation noise by min(1, 2 FOV'/FOV)."""
    mode: str
    """hybrid: the term replaces a share of the photo loss; direct: it is added; auto: hybrid with shared parameters,
    such as colour networks, else direct (the paper, Further Details)."""
    weights: Annotated[list[float], Range(0, 1)]
    """lambda: first and last."""
    weight_split: str
    """Change of lambda, window: half-way through each window; run: half-way through the run; linear: gradual."""
    direct_weight: Weight
    """Weight in direct mode, in place of lambda."""
    loss: str
    """l1: mean |difference|, as in the paper; l2: mean square, which weighs gaps between small splats more than soft
    enlargements; photometric: that of the photos, with SSIM."""
    gain: Weight
    """Factor of the pseudo loss before its weight."""
    per_pixel: bool
    """Ours: weigh a window by its share of the picture's pixels, so that small windows do not outweigh the photos."""
    reduce: str
    """all: mean over all cameras; per_scale: mean over scales of the sum over cameras."""
    densify: bool
    """True: renders of pseudo views count in density control."""
    freeze_shared: str
    """Freeze shared parameters in pseudo views: none, half or active (all) of a window (de-MLP)."""
    strength: Annotated[list[float], Range(0, 1)]
    """Strength of the regenerator at the first and at the last event."""
    prompt: str
    """Text for regenerators; {scene} is the name of the scene."""
    seeds: str
    """fixed: `seed` for every picture; per_view: another for each."""
    seed: Seed
    samples: Annotated[int, Range(1, 1000)]
    """Results averaged for each picture."""
    context: Annotated[int, Range(0, 1000)]
    """Border around the window in the regenerator's input, px."""
    least_alpha: Share
    """Least mean alpha of the model in random windows and moved cameras, which are redrawn up to ten times: objects
    fill little of their pictures (the paper); 0: no limit."""
    project: str
    """exact: replace results by the nearest picture that reduces to the photo in 8 bits; the log has the share of exact
    pixels (all of them for box averages)."""
    weight_map: str
    """none; splatsure: surfaces count that no other photo shows more than 1.1 times as finely; splatsure_1.7: the same
    from 1.7 on; finer (ours): those that no photo shows as finely as the pseudo view."""
    gate: Annotated[float, Range(0, 1e6)]
    """Largest difference of a reduced block from the photo that counts, 8-bit levels; 0: all count."""
    coarse_weight: Weight
    """Weight of the mean difference between the reduced render and the photo."""
    progressive: bool
    """True: the scales take turns over the events."""
    checks: Checks
    """Checks of redrawn pictures; default: those of the regenerator's role."""
    least_gain: Annotated[float, Range(0, 1000)] = 0.0
    """Least gain of the regenerator over Lanczos' filter on the scene's own photos, reduced and enlarged again, dB;
    with less there are no pseudo views; 0: not measured."""
    coarser: Annotated[list[int], Range(2, 64)] = field(default_factory=list)
    """Reductions of training cameras that also count, photos as the scene reduces them, renders by box averages
    (Mipmap-GS)."""

    def __post_init__(self) -> None:
        where = f"augmenter.{self.name}"
        for key, allowed in CHOICES.items():
            if getattr(self, key) not in allowed:
                raise ValueError(f"{where}.{key} is '{getattr(self, key)}'; choose from {', '.join(allowed)}")
        if not self.scales:
            raise ValueError(f"{where}.scales is empty; give factors of 1 or more")
        if not self.narrow > 0:
            raise ValueError(f"{where}.narrow is {self.narrow}; give a fraction above 0, at most 1")
        for key in ("weights", "strength"):
            if len(getattr(self, key)) != 2:
                raise ValueError(f"{where}.{key} is {list(getattr(self, key))}; give two values from 0 to 1")
        if not self.base and self.variants == 0:
            raise ValueError(f"{where}.base is false and variants is 0: set one of them, or there is no pseudo view")

    def window_size(self, camera: Camera, scale: int) -> tuple[int, int]:
        """Returns (width, height) of the window of a camera's raster that is zoomed in by `scale`, px."""
        return camera.size if self.window == "whole" else window_size(*camera.size, self.narrow, scale)

    def begins(self, iterations: int) -> int:
        """Returns the first event of a run of that length."""
        published = self.timing.published_iterations
        schedule = Schedule(iterations=iterations, published_iterations=published, views=1)  # views do not matter
        return min(events_of(self.timing, schedule), default=iterations)
