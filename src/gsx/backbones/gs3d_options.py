"""Options of free Gaussians."""

from dataclasses import dataclass

from gsx.backbones.mip import MipOptions, checked_filter


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Adam learning rates (3D-GS, arguments)."""

    means_first: float
    means_last: float
    sh_dc: float
    sh_rest: float
    opacity_logits: float
    log_scales: float
    quats: float
    shortened: float = 0.0
    """In a run of fewer steps than published, all but that of opacities are (published / taken)^shortened times as
    high, that of means at first; 0: as published."""

    def __post_init__(self) -> None:
        if not 0 <= self.shortened <= 1:
            raise ValueError(f"backbone.rates.shortened is {self.shortened}; give an exponent from 0 to 1")


@dataclass(frozen=True, kw_only=True)
class Density:
    """Adaptive density control in steps of the published run (3D-GS, train.py)."""

    start: int
    stop: int
    every: int
    gradient: float
    """Mean NDC gradient at or above which a primitive is cloned or split."""
    absolute: bool
    """Also clone or split as many again by the mean of absolute gradients (Mip-Splatting, densify_and_prune)."""
    split_extent: float
    """Primitives larger than this fraction of the extent are split, smaller ones cloned."""
    split_shrink: float
    """Children are the parent's scale divided by this."""
    prune_opacity: float
    prune_extent: float
    """Primitives larger than this fraction of the extent are removed, after the first opacity reset."""
    reset_every: int
    reset_opacity: float
    reset_passes: float
    """In a shortened run at least this many passes over the views lie between opacity resets."""
    white_reset: int
    """Step of the extra opacity reset on a white background."""


@dataclass(frozen=True, kw_only=True)
class GS3DOptions:
    """Options of the backbone; values in conf/backbone/gs3d.yaml, gs3d_zoom.yaml and mip_splatting.yaml."""

    name: str
    filter: str
    """none, or mip: both filters of Mip-Splatting."""
    published_iterations: int
    sh_degree: int
    sh_every: int
    initial_opacity: float
    max_primitives: int
    """No primitive is added beyond this number; 0: none is withheld."""
    rates: Rates
    density: Density
    mip: MipOptions
    decay_until: int = 0
    """Published step at which the rate of the means has come down; 0: at the end of the run."""

    def __post_init__(self) -> None:
        checked_filter(self.filter)
        if self.sh_degree not in range(4):
            raise ValueError(f"backbone.sh_degree is {self.sh_degree}; choose 0 to 3")
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"backbone.initial_opacity is {self.initial_opacity}; give a value between 0 and 1")
        if self.published_iterations < 1 or self.max_primitives < 0:
            raise ValueError("backbone.published_iterations must be at least 1, backbone.max_primitives at least 0")
        if not (self.rates.means_first > 0 and self.rates.means_last > 0):
            raise ValueError("backbone.rates.means_first and means_last must be positive: they decay log-linearly")
