"""Options of pseudo details, checked."""

from dataclasses import dataclass, field
from typing import Annotated

from gsx.augmenters.cameras import KEPT, NOISES, WINDOWS
from gsx.augmenters.checks import Checks
from gsx.augmenters.pixel_weights import WeightMap, sampled_better, splatsure
from gsx.augmenters.timing import SPLITS, Timing, events_of
from gsx.core.ranges import Range, Seed, Share, Steps, Weight
from gsx.core.training.schedule import Schedule

ZOOMS = ("intrinsics", "none")
MODES = ("auto", "hybrid", "direct")
SOURCES = ("photo", "render")
LOSSES = ("l1", "l2")
REDUCTIONS = ("all", "per_scale")
FROZEN = ("none", "half", "active")
SEEDS = ("fixed", "per_view")
PROJECTIONS = ("none", "exact")
WEIGHT_MAPS: dict[str, WeightMap | None] = {"none": None, "splatsure": splatsure, "finer": sampled_better}
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
    """Options; values in conf/augmenter, with their sources."""

    name: str
    role: str
    """Regenerator: upscale or restore."""
    timing: Timing
    scales: Annotated[list[int], Range(1, 64)]
    """Zoom factors a; [1]: none."""
    base: bool
    """Whether the training camera itself is zoomed in."""
    base_source: str
    """photo: its window of the photograph is redrawn; render: what the model shows there."""
    variants: Annotated[int, Range(0, 1000)]
    """Cameras moved at random per training camera and scale."""
    first_cameras: Steps
    """Training cameras, in order, that pseudo views are made from; 0: all."""
    narrow: Share
    """Width of the window in training as a fraction of the raster; 1: uncropped."""
    window: str
    """center, random, grid (one after the other over the events), or error (where the model is worst)."""
    zoom: str
    """intrinsics: the result is seen at a times the focal length; none: rendered at 1/a of the density and compared at
    the training density, the other reading of the paper."""
    rotation_noise: Annotated[float, Range(0, 10)]
    translation_noise: Annotated[float, Range(0, 1e6)]
    translation_unit: str
    """world, or extent: of the scene."""
    noise: str
    """uniform or normal."""
    kept: str
    """What a turned camera keeps: t, or its center."""
    relative_noise: bool
    """Turn less where the field of view is small: times min(1, 2 FOV'/FOV)."""
    mode: str
    """hybrid: the term takes its share of the backbone's loss; direct: it is added; auto: hybrid with shared
    parameters, such as colour networks, direct without (the paper, Further Details)."""
    weights: Annotated[list[float], Range(0, 1)]
    """lambda: first and last."""
    weight_split: str
    """window: the first weight holds for half of each window; run: for half of the run; linear: in between."""
    direct_weight: Weight
    """In direct mode, in place of lambda."""
    loss: str
    """l1: mean |difference|, as in the paper; l2: mean square. Squares weigh the gaps that open between small splats;
    |difference| weighs a softer enlargement everywhere as much."""
    gain: Weight
    """Of the pseudo loss, before it is weighted."""
    per_pixel: bool
    """Ours: weigh a pixel of a window like one of a whole picture, so that small windows do not outweigh the photos."""
    reduce: str
    """all: mean over all cameras; per_scale: mean over scales of the sum over cameras."""
    densify: bool
    """Renders of pseudo views count in density control."""
    freeze_shared: str
    """none; half, active: pseudo views do not move shared parameters, in the first half of a window or all of it
    (de-MLP)."""
    strength: Annotated[list[float], Range(0, 1)]
    """How much may change: at the first event and at the last."""
    prompt: str
    """For regenerators that read; {scene} is the name of the scene."""
    seeds: str
    """fixed: `seed` for every picture; per_view: another for each."""
    seed: Seed
    samples: Annotated[int, Range(1, 1000)]
    """Results averaged for each picture."""
    context: Annotated[int, Range(0, 1000)]
    """Pixels around the window that the regenerator also sees."""
    least_alpha: Share
    """Windows at random places, or of cameras moved at random, are drawn again, ten times at most, while the model's
    mean alpha in them is lower: objects fill little of their pictures (the paper). 0: the first is taken."""
    project: str
    """exact: the nearest picture that reduces to its input as the scene's pictures do, of photographs in 8 bits: every
    pixel where they are box averages, else nearly every one; the share is logged."""
    weight_map: str
    """none; splatsure: surfaces count that no other photograph shows more finely; finer, ours: those
    that no photograph shows as finely as the pseudo view does."""
    gate: Annotated[float, Range(0, 1e6)]
    """Blocks do not count that reduce to what is further than this from the known photograph, in 8-bit levels; 0: all
    count."""
    coarse_weight: Weight
    """Of the mean difference between the reduced render and the known photograph, beside that of the pixels."""
    progressive: bool
    """The scales one after the other over the events, instead of all at once."""
    checks: Checks
    """Of redrawn pictures against what they were made from; those of the regenerator's role unless said otherwise."""
    coarser: Annotated[list[int], Range(2, 64)] = field(default_factory=list)
    """Training cameras also count at these fractions of their size: photographs as the scene reduces them, renders by
    box averages (Mipmap-GS)."""

    def __post_init__(self) -> None:
        where = f"augmenter.{self.name}"
        for key, allowed in CHOICES.items():
            if getattr(self, key) not in allowed:
                raise ValueError(f"{where}.{key} is '{getattr(self, key)}'; choose from {', '.join(allowed)}")
        if self.translation_unit not in ("world", "extent"):
            raise ValueError(f"{where}.translation_unit is '{self.translation_unit}'; choose world or extent")
        if not self.scales:
            raise ValueError(f"{where}.scales is empty; give factors of 1 or more")
        if not self.narrow > 0:
            raise ValueError(f"{where}.narrow is {self.narrow}; give a fraction above 0, at most 1")
        for key in ("weights", "strength"):
            if len(getattr(self, key)) != 2:
                raise ValueError(f"{where}.{key} is {list(getattr(self, key))}; give two values from 0 to 1")
        if not self.base and self.variants == 0:
            raise ValueError(f"{where}.base is false and variants is 0: there would be no pseudo view")

    def begins(self, iterations: int) -> int:
        """First event of a run of that length."""
        published = self.timing.published_iterations
        schedule = Schedule(iterations=iterations, published_iterations=published, views=1)  # no view decides it
        return min(events_of(self.timing, schedule), default=iterations)
