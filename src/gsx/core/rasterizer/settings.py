"""Settings of the rasterizer; values in `conf/rasterizer`, defaults here as published 3D-GS."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

import torch

from gsx.core.backend import EAGER, Backend
from gsx.core.ranges import Count, Range, Share, Steps, beyond_range
from gsx.core.rasterizer.compositor import Compositor, WithBackend

CUTOFF_SLACK = 1e-3
"""Added to ln(alpha / alpha_min) in the choice of tiles, so that rounding never drops a pixel at the cut-off."""
WINDOW_TILE = 16
"""Tile edge of published 3D-GS, px; its 3-sigma squares consist of these (3D-GS, forward.cu)."""
NOTHING = -1e4
"""Log-opacity of padding: its exp is 0 in every dtype."""
DTYPES = {"float32": torch.float32, "float64": torch.float64}
CHOICES = {
    "cull": ("published", "tight"),
    "pixel": ("sample", "window"),
    "zoomed": ("plain", "magnified", "resampled"),
    "schedule": ("auto", "chunks", "segments"),
    "evaluation": tuple(DTYPES),
    "accumulation": tuple(DTYPES),
}
"""Values of the settings that are names; the first is not always the default."""
OF_BACKBONES = ("zoomed", "training_focal")
"""Fields that backbones set, not the configuration."""
PIXEL_VARIANCE = 0.1
"""Variance of a rendered pixel as a Gaussian, px^2, with zoomed=resampled (Mip-Splatting)."""
BOX_VARIANCE = 1 / 12
"""Variance of a pixel as a square, px^2; pixel=window subtracts it from the dilation, since integration adds it."""
LEAST_VARIANCE = 1e-6
"""Dilation in place of none, px^2, so that covariances stay positive."""
LARGEST_BATCH = 1 << 27
"""Most alpha values of the compiled path at once; their indices fit 32 bits."""


@dataclass(frozen=True, kw_only=True)
class RasterOptions:
    """Options of the rasterizer: first rules that change the image, then sizes that do not.

    Raises:
        ValueError: a value is out of range, or two exclude each other.
    """

    dilation: Annotated[float, Range(LEAST_VARIANCE, 1e6)] = 0.3
    """Added to both diagonal entries of the screen covariance, px^2 (3D-GS, forward.cu)."""
    compensate: bool = False
    """Opacity times sqrt(|S| / |S + dilation I|), S the covariance before dilation: Mip-Splatting's 2D filter, with
    dilation 0.1 (Mip-Splatting, forward.cu)."""
    zoomed: str = "plain"
    """Rule for cameras with k = focal length / `training_focal` != 1. `plain`: the same dilation, as published; thinner
    splats, with gaps. `magnified`: dilation k^2 for k > 1, the picture at k = 1 sampled more finely (SA-GS).
    `resampled`: dilation (d - 0.1) k^2 + 0.1, opacities (at most alpha_max) compensated from d k^2: the signal behind
    the picture at k = 1, sampled by this camera's pixels. Set by `backbone.filter`."""
    pixel: str = "sample"
    """`sample`: a splat's value at the pixel's centre, dilated, as published. `window`: its integral over what is left
    of the pixel (Gaussian Blending), exact where splats cover parts of pixels; several times slower. 1/12 px^2 of the
    dilation are the pixel's own; a compensated dilation is left out."""
    training_focal: Annotated[float, Range(0, 1e12)] = 0.0
    """Largest focal length of the training cameras, px; 0: every camera counts as one of them."""
    alpha_min: Share = 1 / 255
    """Smaller contributions are skipped (3D-GS, renderCUDA)."""
    alpha_max: Share = 0.99
    """Upper bound of alpha (3D-GS, renderCUDA)."""
    transmittance_stop: Share = 1e-4
    """A pixel ends before the splat that would take its transmittance below this (3D-GS, renderCUDA); with pixel=window
    after it (Gaussian Blending)."""
    cull: str = "published"
    """`published`: a splat reaches the 16 px tiles of its 3-sigma square, as 3D-GS. `tight`: every pixel with
    alpha >= alpha_min, without truncation."""
    jacobian_margin: Annotated[float, Range(0, 100)] = 0.3
    """Share of half the raster by which it is widened before x/z and y/z of the Jacobian are clamped to it (3D-GS)."""
    tile_size: Annotated[int, Range(1, 1024)] = 8
    """Edge of the compositing tiles, px; with cull=published a divisor of 16."""
    chunk: Annotated[int, Range(1, 4096)] = 16
    """Eager path: splats per step of a tile."""
    batch_values: Annotated[int, Range(1, LARGEST_BATCH)] = 1 << 18
    """Eager path: alpha values at once; bounds memory, and should fit the CPU's cache."""
    unrolled: Annotated[int, Range(1, 64)] = 8
    """Compiled path: splats per step of a tile, unrolled in one loop; compile time grows with it."""
    compiled_values: Annotated[int, Range(0, LARGEST_BATCH)] = 0
    """Compiled path: alpha values (by segments: slopes) at once; 0: 2^22 on a CPU, 2^26 on a GPU."""
    max_pairs: Annotated[int, Range(1, 1 << 30)] = 100_000_000
    """Most splat-tile pairs of a picture; a pair takes about 100 B of memory, on a GPU 300 B or more."""
    path: str = "eager"
    """Name of the compositor. `eager`: plain torch, works everywhere. `compiled`: the same by torch.compile; pictures
    of more than 8 channels, or with largest weights, stay eager. `gsplat`: CUDA kernels of that package. `auto`:
    decided by a training run (`auto_steps`), also for its evaluations; otherwise eager. Plugins may add more."""
    auto_steps: Steps = 300
    """Least number of steps at which path=auto compiles."""
    schedule: str = "auto"
    """Compiled path. `chunks`: front to back, saturated tiles leave. `segments`: all chunks of all tiles at once,
    joined by an associative scan. `auto`: chunks on a CPU, segments on a GPU."""
    evaluation: str = "float32"
    """Format of ln alpha and alpha, at least the splats' dtype: float32 or float64."""
    accumulation: str = "float32"
    """Format of transmittance, weights and sums of light, at least the splats' dtype: float32 or float64."""
    tile_cap: Count = 0
    """Most splats per tile, the nearest; 0: all."""

    def __post_init__(self) -> None:
        for problem in self._problems():
            raise ValueError(problem)

    def _problems(self) -> Iterator[str]:
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                yield f"rasterizer.{name} is '{getattr(self, name)}'; choose {', '.join(choices)}"
        for name, value, bounds in beyond_range(RasterOptions, vars(self)):
            yield f"rasterizer.{name} is {value}; give a number {bounds}"
        if self.zoomed != "plain" and self.compensate:
            yield f"rasterizer.zoomed={self.zoomed} is for models without compensated opacities"
        if self.zoomed == "resampled" and self.dilation <= PIXEL_VARIANCE:
            yield f"rasterizer.zoomed=resampled needs a dilation above {PIXEL_VARIANCE}, not {self.dilation}"
        if self.pixel == "window" and not self.compensate and self.dilation <= BOX_VARIANCE:
            yield f"rasterizer.pixel=window needs a dilation above 1/12 px^2, not {self.dilation}"
        if not 0 < self.alpha_min < self.alpha_max < 1:
            yield f"need 0 < alpha_min < alpha_max < 1, got {self.alpha_min} and {self.alpha_max}"
        if self.transmittance_stop == 1:
            yield "rasterizer.transmittance_stop is 1.0; give 0 (never stop) or more, below 1"
        if self.cull == "published" and WINDOW_TILE % self.tile_size:
            yield f"rasterizer.tile_size is {self.tile_size}; with cull=published it must divide {WINDOW_TILE}"
        for role in ("evaluation", "accumulation"):  # gradients divide by 1 - alpha
            dtype = getattr(self, role)
            if 1 - self.alpha_max < torch.finfo(DTYPES[dtype]).eps / 2:
                yield f"rasterizer.alpha_max={self.alpha_max} is 1 in {role}={dtype}; lower it"

    def dilation_at(self, focal: float) -> tuple[float, float]:
        """Returns, for a focal length in px, the dilation and that from which opacities are compensated or 0, px^2."""
        ratio = focal / self.training_focal if self.training_focal else 1.0
        dilation, source = self.dilation, 0.0
        if self.zoomed == "magnified":
            dilation = self.dilation * max(1.0, ratio) ** 2
        elif self.zoomed == "resampled" and ratio != 1:
            dilation = (self.dilation - PIXEL_VARIANCE) * ratio**2 + PIXEL_VARIANCE
            source = self.dilation * ratio**2
        if self.pixel == "sample":
            return dilation, source
        return (LEAST_VARIANCE, 0.0) if self.compensate else (dilation - BOX_VARIANCE, source or dilation)

    @property
    def published_dilation(self) -> bool:
        """True: all cameras use `dilation`, compensated or not."""
        return self.zoomed == "plain" and self.pixel == "sample"


@dataclass(frozen=True, kw_only=True)
class RasterSettings(RasterOptions):
    """Options of the rasterizer with the compositors that `path` may name in addition to eager.

    Raises:
        ValueError: an option is wrong, or there is no compositor for it.
    """

    compositors: Mapping[str, Compositor] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path not in (names := dict.fromkeys(("auto", "eager", *self.compositors))):
            raise ValueError(f"rasterizer.path is '{self.path}'; choose {', '.join(names)}")
        if self.compositor_name not in ("eager", *self.compositors):
            raise ValueError("rasterizer.pixel=window needs a compositor `window`; register gsx's own")

    @property
    def drawn_by(self) -> str:
        """`path`, or `eager` where no training run has decided."""
        return "eager" if self.path == "auto" else self.path

    @property
    def compositor_name(self) -> str:
        """Name of the compositor that draws: `window` for pixel windows, or the path's."""
        return "window" if self.pixel == "window" else self.drawn_by

    @property
    def backend(self) -> Backend:
        """Backend of all kernels but blending: that of the path's compositor, or eager torch."""
        compositor = self.compositors.get(self.drawn_by)
        return compositor.backend if isinstance(compositor, WithBackend) else EAGER

    @property
    def options(self) -> dict[str, Any]:
        """Options by name, without compositors."""
        return {entry.name: getattr(self, entry.name) for entry in fields(RasterOptions)}

    def path_on(self, device: str) -> str:
        """Returns the path on a kind of device: `eager` where nothing compiles."""
        return self.drawn_by if self.backend.available(device) else "eager"


@dataclass(frozen=True, kw_only=True)
class Precision:
    """Number formats of one picture."""

    evaluation: torch.dtype
    """Format of ln alpha and alpha at pixels."""
    accumulation: torch.dtype
    """Format of transmittance, weights and sums of light, and of their gradients at pixels."""
    exact: torch.dtype
    """The wider of both: format of values per list entry, and of sums over pixels and entries in gradients."""

    @staticmethod
    def of(settings: RasterSettings, splats: torch.dtype) -> "Precision":
        """Returns the formats for splats of a dtype, never narrower than it."""
        evaluation = torch.promote_types(DTYPES[settings.evaluation], splats)
        accumulation = torch.promote_types(DTYPES[settings.accumulation], splats)
        exact = torch.promote_types(evaluation, accumulation)
        return Precision(evaluation=evaluation, accumulation=accumulation, exact=exact)
