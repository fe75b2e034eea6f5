"""Options of free Gaussians."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from gsx.backbones.capacity_options import CapacityOptions
from gsx.backbones.mip import MipOptions, checked_filter
from gsx.backbones.sky import WHEN
from gsx.core.ranges import Count, Gradient, Interval, Range, Rate, Share, Steps, Weight


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Adam learning rates (3D-GS, arguments)."""

    means_first: Rate
    means_last: Rate
    sh_dc: Rate
    sh_rest: Rate
    opacity_logits: Rate
    log_scales: Rate
    quats: Rate
    shortened: Share = 0.0
    """Exponent of the factor (published steps / steps)^shortened on all rates but that of opacities (of means: the
    first) in runs shorter than published; 0: as published."""


@dataclass(frozen=True, kw_only=True)
class Density:
    """Adaptive density control in steps of the published run (3D-GS, train.py)."""

    start: Steps
    stop: Steps
    every: Interval
    gradient: Gradient
    """Mean NDC gradient at or above which a primitive is cloned or split."""
    absolute: bool
    """Also clone or split as many by the mean absolute gradient (Mip-Splatting, densify_and_prune)."""
    split_extent: Annotated[float, Range(0, 1e6)]
    """Fraction of the extent above which primitives are split instead of cloned."""
    split_shrink: Annotated[float, Range(1, 100)]
    """Scale of a parent over that of its children."""
    prune_opacity: Share
    prune_extent: Annotated[float, Range(0, 1e6)]
    """Fraction of the extent above which primitives are removed, after the first opacity reset."""
    reset_every: Interval
    reset_opacity: Annotated[float, Range(1e-6, 1 - 1e-6)]
    reset_passes: Annotated[float, Range(0, 1e6)]
    """Least passes over the views between opacity resets, in a shortened run."""
    white_reset: Steps
    """Step of the extra opacity reset on a white background."""
    passes: Annotated[float, Range(0, 1e6)] = 1.0
    """Least passes over the views between events, in a shortened run."""


@dataclass(frozen=True, kw_only=True)
class MCMCOptions:
    """Options of capacity=mcmc in steps of the published run; values in conf/backbone/gs3d.yaml, with their sources."""

    primitives: Count = 0
    """Number of Gaussians at which growth ends."""
    start: Steps = 500
    stop: Steps = 25000
    every: Interval = 100
    passes: Annotated[float, Range(0, 1e6)] = 0.0
    """Least passes over the views between events, in a shortened run."""
    growth: Annotated[float, Range(1, 10)] = 1.05
    """Factor of the number of Gaussians at each event of a published run."""
    dead_opacity: Annotated[float, Range(1e-6, 0.5)] = 0.005
    """Opacity at or below which a Gaussian is relocated; the least one after it; middle of the noise's gate."""
    noise: Annotated[float, Range(0, 1e9)] = 5e5
    """Noise over the learning rate of the means, per squared scale."""
    opacity_weight: Weight = 0.01
    """Weight of the mean opacity in the loss."""
    scale_weight: Weight = 0.01
    """Weight of the mean scale in the loss, at the reference extent."""
    extent: Annotated[float, Range(0, 1e6)] = 5.0
    """Reference extent, scene units: noise and scale_weight act as in a scene of this extent; 0: in scene units."""
    initial_opacity: Annotated[float, Range(1e-6, 1 - 1e-6)] = 0.5
    initial_scale: Annotated[float, Range(1e-6, 100)] = 0.1
    """Initial scales over the distances of neighbouring points."""


@dataclass(frozen=True, kw_only=True)
class GS3DOptions(CapacityOptions):
    """Options of the backbone; values in conf/backbone/gs3d.yaml, gs3d_zoom.yaml and mip_splatting.yaml."""

    name: str
    filter: str
    """none, or mip: both filters of Mip-Splatting."""
    published_iterations: Interval
    sh_degree: Annotated[int, Range(0, 3)]
    sh_every: Interval
    sh_judged: Share = 0.0
    """Share of the run after which each Gaussian keeps only SH bands worth their numbers; 0: it keeps all."""
    sh_price: Annotated[float, Range(1e-6, 100)] = 0.8
    """Least gain of a doubling of the model's numbers, dB."""
    sky: str = "never"
    """Distant Gaussians behind the scene (`backbones.sky`), never, always, or auto: if photos look past the scene."""
    initial_opacity: Annotated[float, Range(1e-6, 1 - 1e-6)]
    rates: Rates
    density: Density
    mip: MipOptions
    decay_until: Steps = 0
    """Published step at which the rate of the means reaches its last value; 0: the end of the run."""
    mcmc: MCMCOptions = MCMCOptions()
    capacities: ClassVar[tuple[str, ...]] = ("published", "budget", "adaptive", "mcmc")

    def __post_init__(self) -> None:
        super().__post_init__()
        checked_filter(self.filter)
        self.check_number("mcmc", self.mcmc.primitives)
        if self.sky not in WHEN:
            raise ValueError(f"backbone.sky is '{self.sky}'; choose from {', '.join(WHEN)}")
        if not (self.rates.means_first > 0 and self.rates.means_last > 0):
            raise ValueError("backbone.rates.means_first and means_last must be positive: they decay log-linearly")
