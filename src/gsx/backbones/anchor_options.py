"""Options of neural and of explicit anchors."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, ClassVar

from gsx.backbones.capacity_options import CapacityOptions
from gsx.backbones.growth_options import GrowthOptions, Quirks, resolved
from gsx.backbones.heads import HeadOptions
from gsx.backbones.level_options import LevelOptions, checked_end
from gsx.backbones.mip import MipOptions, checked_filter
from gsx.core.ranges import Interval, Range, Rate, Steps, Weight
from gsx.core.training.schedule import log_linear


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
    """Quirks of this form's reference that differ from those of `growth_options.CHOICES`."""

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
