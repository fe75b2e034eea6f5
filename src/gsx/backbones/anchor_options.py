"""Options of neural and of explicit anchors: growth, levels of detail, and the references' quirks."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, ClassVar

from gsx.backbones.capacity_options import CapacityOptions
from gsx.backbones.heads import HeadOptions
from gsx.backbones.mip import MipOptions, checked_filter
from gsx.core.ranges import Gradient, Interval, Length, Range, Rate, Share, Steps, Weight
from gsx.core.training.schedule import log_linear

CHOICES = {
    "early_stop": ("yes", "no"),
    "clamp": ("world", "extent"),
    "voxel": ("squared", "distance"),
    "gate": ("open", "closed"),
    "bias": ("all", "own", "level"),
    "finest": ("bounded", "open"),
    "promoted": ("zeros", "max"),
    "duplicates": ("next", "own"),
}
"""Values of each quirk, the reference's first."""
SANE = {name: values[1] for name, values in CHOICES.items()} | {"duplicates": "next"}
FIDELITIES = {"reference": {name: values[0] for name, values in CHOICES.items()}, "sane": SANE}
MODES = ("round", "floor", "ceil", "progressive")
EXTEND_RULES = ("reference", "sane")
ZOOM_RULES = ("finer", "training")


@dataclass(frozen=True, kw_only=True)
class GrowthOptions:
    """Options of growing and pruning, steps of the published run; values in conf/backbone, with their sources."""

    observe_from: Steps
    start: Steps
    stop: Steps
    every: Interval
    success: Share
    """Fraction of an interval's steps with visits that an anchor needs before it may be pruned; offsets: half."""
    gradient: Gradient
    """Mean NDC gradient above which an offset grows an anchor."""
    prune_opacity: Share
    """Anchors whose opacities sum to less than this per visit are removed."""
    largest_log_scale: Annotated[float, Range(-100, 100)]
    """Upper bound of the Gaussians' log-scales while growing; see `Quirks.clamp`."""
    depths: Annotated[int, Range(1, 20)]
    """Without levels: number of cell sizes."""
    hierarchy: Annotated[int, Range(2, 64)]
    """Without levels: ratio of one cell size to the next; thresholds grow by half of it."""
    coarsest: Annotated[int, Range(1, 10**6)]
    """Without levels: edge of the largest cell, voxels."""
    update_ratio: Annotated[float, Range(0, 100)]
    """With levels: the threshold grows by fork ** this per level."""
    bias_gradient: Annotated[float, Range(0, 100)]
    """With levels: fraction of the threshold above which an anchor is drawn from farther away."""
    bias_step: Annotated[float, Range(0, 100)]
    """With levels: increase of its level bias, in levels."""
    overlap: bool
    """With levels: True allows a second anchor in a cell."""

    def __post_init__(self) -> None:
        if not self.success > 0:
            raise ValueError(f"backbone.growth.success is {self.success}; give a share above 0")


@dataclass(frozen=True, kw_only=True)
class Quirks:
    """Quirks of the reference code that published numbers depend on; '' takes the value of `fidelity`."""

    early_stop: str
    """yes: stop if the coarsest cells grow nothing (Scaffold-GS)."""
    clamp: str
    """Unit of growth.largest_log_scale: world units, or the scene's extent."""
    voxel: str
    """Automatic voxel, squared: the median mean SQUARED neighbour distance (Scaffold-GS); distance: its root."""
    gate: str
    """Promotion and bias (free Gaussians: splits and bias), open: from the start (a bug of Octree-GS); closed: once all
    levels are in training."""
    bias: str
    """all: anchors of all levels get bias, without limit (Octree-GS); level: those of the level at hand, without limit
    (Octree-AnyGS, GSOctree); own: those of the level at hand, at most 1."""
    finest: str
    """bounded: the largest gradients of the finest level grow nothing (Octree-GS); open: they do."""
    promoted: str
    """Features of promoted anchors, zeros: 0 (Octree-GS); max: the largest of their parents."""
    duplicates: str
    """Level whose free cells promotion uses, next: the next one's; own: its own, as in published tables (a bug)."""


def resolved(quirks: Quirks, fidelity: str, published: Mapping[str, str] = MappingProxyType({})) -> Quirks:
    """Sets every switch that is '' by the fidelity; ValueError: a value is unknown.

    `published`: quirks in which this reference differs from `CHOICES`.
    """
    if fidelity not in FIDELITIES:
        raise ValueError(f"backbone.fidelity is '{fidelity}'; choose {' or '.join(FIDELITIES)}")
    defaults = {**FIDELITIES[fidelity], **(published if fidelity == "reference" else {})}
    values = {name: value or defaults[name] for name, value in vars(quirks).items()}
    for name, value in values.items():
        if value not in CHOICES[name]:
            raise ValueError(f"backbone.quirks.{name} is '{value}'; choose {' or '.join(CHOICES[name])}")
    return Quirks(**values)


@dataclass(frozen=True, kw_only=True)
class LevelOptions:
    """Options of the levels; values in conf/backbone, with their sources."""

    fork: Annotated[int, Range(2, 64)]
    count: Annotated[int, Range(-1, 32)]
    """Number of levels; -1: from the range of distances in the scene (Octree-GS, set_level)."""
    first: Annotated[int, Range(-1, 32)]
    """Highest level at the start; -1: half of them (Octree-GS, set_level)."""
    base_layer: Annotated[int, Range(-1, 64)]
    """Forks from the whole box to a cell of level 0; -1: the middle level has cells of `voxel`."""
    voxel: Length
    """Cell of the middle level if base_layer is -1, scene units."""
    distance_quantile: Share
    """Upper quantile of distances, per camera and over cameras; the lower one mirrors it (Octree-GS, set_level)."""
    extend: Annotated[float, Range(1, 1000)]
    """Length of the box over the range of the points' coordinates (Octree-GS, octree_sample)."""
    extend_rule: str
    """reference: multiply both ends of the range, which misses points far from the origin (Octree-GS); sane: extend the
    box equally on both sides; '': by backbone.fidelity."""
    visible_threshold: Annotated[float, Range(-1, 1)]
    """Least fraction of training cameras that draw a primitive's level; -1: the mean fraction (Octree-GS, weed_out)."""
    mode: str
    """Rounding of levels: round, floor, ceil, or progressive, which fades the finest level in (Octree-GS)."""
    half_cell: bool | None
    """True: measure distances to a point half a cell beyond the node (Octree-GS); None: by backbone.fidelity."""
    zoom: str
    """Levels of cameras finer than those of training, finer: those of their resolution, trained or not (Octree-GS);
    training: at most those of the finest training camera."""
    coarse_until: Steps
    """Published step at which all levels are in training (Octree-GS, set_coarse_interval); 0: from the start."""
    coarse_factor: Annotated[float, Range(1, 1000)]
    """Ratio of each interval between two levels to the next (Octree-GS, set_coarse_interval)."""
    cell_pixels: Annotated[float, Range(0, 1000)] = 0.0
    """Ours: least size of a cell of level 0 at the farthest distance, px; 0: no limit, as in runs older than this."""

    def __post_init__(self) -> None:
        threshold, rules = self.visible_threshold, ", ".join(EXTEND_RULES) + ", or '' for backbone.fidelity's"
        self.demand("mode", self.mode in MODES, f"choose {', '.join(MODES)}")
        self.demand("extend_rule", self.extend_rule in ("", *EXTEND_RULES), f"choose {rules}")
        self.demand("zoom", self.zoom in ZOOM_RULES, f"choose {', '.join(ZOOM_RULES)}")
        self.demand("count", self.count != 0, "give at least 1, or -1 to take it from the scene")
        self.demand("distance_quantile", self.distance_quantile > 0.5, "give a value above 0.5, at most 1")
        self.demand("visible_threshold", threshold == -1 or 0 <= threshold < 1, "give -1, or from 0 to below 1")

    def demand(self, name: str, met: bool, advice: str) -> None:
        """Raises ValueError if an option's condition is not met."""
        if not met:
            raise ValueError(f"backbone.levels.{name} is {getattr(self, name)!r}; {advice}")


def faithful(options: LevelOptions | None, fidelity: str) -> LevelOptions | None:
    """Returns the options with unset quirks of the reference set by the fidelity."""
    if options is None:
        return None
    half_cell = fidelity == "reference" if options.half_cell is None else options.half_cell
    return replace(options, extend_rule=options.extend_rule or fidelity, half_cell=half_cell)


def checked_end(options: LevelOptions | None, published: int) -> None:
    """Raises ValueError if the finest levels would never be trained."""
    if options is not None and options.coarse_until >= published:
        raise ValueError(
            f"backbone.levels.coarse_until is {options.coarse_until}, and the published run "
            f"(backbone.published_iterations) ends at {published}, so the finest level would never train: lower it"
        )


@dataclass(frozen=True, kw_only=True)
class Decay:
    """A learning rate, log-linear over the published run."""

    first: Rate
    last: Rate

    def __post_init__(self) -> None:
        if not ((self.first > 0 and self.last > 0) or self.first == self.last == 0):
            raise ValueError(
                f"a learning rate goes from {self.first} to {self.last}; give two positive numbers, or 0 twice"
            )

    def at(self, step: int, steps: int) -> float:
        """Returns the rate of a step."""
        return log_linear(step, steps, self.first, self.last) if self.first > 0 else 0.0


@dataclass(frozen=True, kw_only=True)
class NeuralRates:
    """Learning rates by parameter; `offsets` in units of the extent (Scaffold-GS, training_setup)."""

    offsets: Decay
    features: Decay
    log_scales: Decay


@dataclass(frozen=True, kw_only=True)
class HeadRates:
    """Learning rates of the networks (Scaffold-GS, training_setup)."""

    opacity: Decay
    covariance: Decay
    colour: Decay
    bank: Decay
    appearance: Decay


@dataclass(frozen=True, kw_only=True)
class ExplicitRates:
    """Learning rates by parameter; `offsets` in units of the extent (Octree-AnyGS)."""

    offsets: Decay
    log_scales: Decay
    quats: Decay
    opacity_logits: Decay
    sh_dc: Decay
    sh_rest: Decay


@dataclass(frozen=True, kw_only=True)
class AnchorOptions(CapacityOptions):
    """Options of all anchor backbones; values in conf/backbone, with their sources."""

    name: str
    published_iterations: Interval
    fidelity: str
    """reference: the published code with its quirks; sane: without them; `quirks` sets single ones."""
    filter: str
    volume_weight: Weight
    """Weight of the mean volume of the drawn Gaussians in the loss (Scaffold-GS, train.py)."""
    voxel: Annotated[float, Range(0, 1e6)]
    """Without levels: edge of the initial grid's cells, world units; 0: from the points (Scaffold-GS)."""
    growth: GrowthOptions
    quirks: Quirks
    mip: MipOptions
    levels: LevelOptions | None
    decay_until: Steps = 0
    """Published step at which learning rates reach their last value; 0: the end of the run."""
    reference: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Quirks of this form's reference that differ from those of `CHOICES`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checked_filter(self.filter)
        checked_end(self.levels, self.published_iterations)
        self.switches()

    def switches(self) -> Quirks:
        """Returns all quirks, set one by one or by the fidelity; ValueError: a value is unknown."""
        return resolved(self.quirks, self.fidelity, self.reference)


@dataclass(frozen=True, kw_only=True)
class NeuralOptions(AnchorOptions):
    """Anchors decoded by networks."""

    offsets: Annotated[int, Range(1, 100)]
    """k: Gaussians per anchor."""
    heads: HeadOptions
    rates: NeuralRates
    head_rates: HeadRates


@dataclass(frozen=True, kw_only=True)
class ExplicitOptions(AnchorOptions):
    """Anchors of one explicit Gaussian each."""

    rates: ExplicitRates
    sh_degree: Annotated[int, Range(0, 3)]
    sh_every: Interval
    """Published steps between SH degrees."""
    initial_opacity: Annotated[float, Range(1e-6, 1 - 1e-6)]
    reference: ClassVar[Mapping[str, str]] = MappingProxyType({"bias": "level"})
