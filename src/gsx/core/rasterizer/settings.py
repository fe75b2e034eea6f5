"""The knobs of the rasterizer. Values live in `conf/rasterizer`; the defaults here are the published 3D-GS rules."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

from gsx.core.backend import EAGER, Backend
from gsx.core.ranges import Count, Range, Share, Steps
from gsx.core.rasterizer.compositor import Compositor, WithBackend

CUTOFF_SLACK = 1e-3
"""Added to ln(alpha / alpha_min) when tiles are chosen, so that rounding never drops a pixel at the cut-off."""
WINDOW_TILE = 16
"""Tile edge of the published rasterizer: its 3-sigma windows are whole numbers of these (3D-GS, forward.cu)."""

NOTHING = -1e4
"""Log-opacity of what draws nothing: exp of it is zero in every dtype."""

CHOICES = {
    "cull": ("published", "tight"),
    "pixel": ("sample", "window"),
    "zoomed": ("plain", "magnified", "resampled"),
    "schedule": ("auto", "chunks", "segments"),
    "evaluation": ("float32", "float64"),
    "accumulation": ("float32", "float64"),
}
"""Values of the settings that are names; the first is not always the default."""

SIGNIFICANT_BITS = {"float64": 53, "float32": 24}
OF_BACKBONES = ("zoomed", "training_focal")
"""Fields that are no options of the rasterizer: backbones set them."""
PIXEL_VARIANCE = 0.1
"""Variance of the Gaussian that zoomed=resampled takes a rendered pixel for, px^2 (Mip-Splatting)."""
BOX_VARIANCE = 1 / 12
"""Of a pixel as a square, px^2: pixel=window takes it from a dilation, because the integral over the pixel adds it."""
LEAST_VARIANCE = 1e-6
"""Dilation of splats that are to have none, px^2: everything stays positive."""
LARGEST_BATCH = 1 << 27
"""Alpha values of the compiled path at once: with their rows and channels they are still counted in 32 bits."""


@dataclass(frozen=True, kw_only=True)
class RasterOptions:
    """Options of the rasterizer: rules that shape the image, then sizes that only shape the work."""

    dilation: Annotated[float, Range(LEAST_VARIANCE, 1e6)] = 0.3
    """Added to both diagonal entries of the screen covariance, px^2 (3D-GS, forward.cu)."""
    compensate: bool = False
    """Opacity times sqrt(|S| / |S + dilation I|), S the screen covariance before dilation: Mip-Splatting's 2D filter
    with dilation 0.1 (Mip-Splatting, forward.cu); published 3D-GS draws without."""
    zoomed: str = "plain"
    """How cameras draw that are finer or coarser than the training cameras, k = focal length / `training_focal`.
    `plain`: by the same dilation, as published: thinner splats, with gaps. `magnified`: dilation x k^2 for k > 1, the
    picture at k = 1 sampled more finely (SA-GS). `resampled`: what it is sampled from, sampled by the pixels of this
    camera: dilation (d - 0.1) k^2 + 0.1, opacities (at most alpha_max) compensated from d k^2. Backbones choose it
    (`backbone.filter`)."""
    pixel: str = "sample"
    """What a splat is to a pixel. `sample`: its value at the pixel's centre, dilated, as published (compensated for it:
    Mip-Splatting). `window`: its integral over what is left of the pixel (Gaussian Blending): exact where splats cover
    parts of pixels, above all from afar; several times slower. Instead of the dilation, of which 1/12 px^2 are the
    pixel's own: all of a compensated one is left out."""
    training_focal: Annotated[float, Range(0, 1e9)] = 0.0
    """Largest focal length of the training cameras, px, as the backbone knows it; 0: every camera counts as one of
    them."""
    alpha_min: Share = 1 / 255
    """Contributions below are skipped (3D-GS, renderCUDA)."""
    alpha_max: Share = 0.99
    """Alphas are clamped here (3D-GS, renderCUDA)."""
    transmittance_stop: Share = 1e-4
    """A pixel ends before the splat that would take its transmittance below (3D-GS, renderCUDA); with pixel=window
    behind it (Gaussian Blending)."""
    cull: str = "published"
    """`published`: a splat reaches only the 16 px tiles of its 3-sigma square, as 3D-GS draws it.
    `tight`: it reaches every pixel where its alpha is at least alpha_min (the better rule: no truncation)."""
    jacobian_margin: Annotated[float, Range(0, 100)] = 0.3
    """x/z, y/z are clamped to the raster widened by this fraction of half its extent in the Jacobian (3D-GS)."""
    tile_size: Annotated[int, Range(1, 1024)] = 8
    """Edge of the compositing tiles, px; with cull=published it must divide 16."""
    chunk: Annotated[int, Range(1, 4096)] = 16
    """Eager path: splats composited per step of a tile."""
    batch_values: Annotated[int, Range(1, LARGEST_BATCH)] = 1 << 18
    """Eager path: alpha values evaluated at once; bounds working memory and should fit the CPU's cache."""
    unrolled: Annotated[int, Range(1, 64)] = 8
    """Compiled path: splats composited per step of a tile, unrolled in one loop; compile time grows with it."""
    compiled_values: Annotated[int, Range(0, LARGEST_BATCH)] = 0
    """Compiled path: alpha values evaluated at once (by segments: slopes held at once); 0: 2^22 on a CPU, 2^26 on a
    GPU."""
    max_pairs: Annotated[int, Range(1, 1 << 30)] = 100_000_000
    """A picture that needs more splat-tile pairs is refused by name (memory is about 100 B a pair, on a GPU 300 B or
    more)."""
    path: str = "eager"
    """Name of the compositor; plugins may add some. `eager`: plain torch operations, works everywhere. `compiled`: the
    same mathematics through torch.compile; more than 8 channels and largest weights are blended by `eager` regardless.
    `gsplat`: the CUDA kernels of that package. `auto`: a training run decides (`auto_steps`), and its evaluations
    follow it; everything else is eager."""
    auto_steps: Steps = 300
    """path=auto compiles for runs of at least this many steps, where a compiler works."""
    schedule: str = "auto"
    """Of the compiled path. `chunks`: front to back, saturated tiles leave. `segments`: all chunks of all tiles at
    once, joined by an associative scan. `auto`: chunks on a CPU, segments on a GPU."""
    evaluation: str = "float32"
    """Format of ln alpha and alpha: float32 or float64. Geometry keeps the splats' dtype; float64 splats are evaluated
    in float64."""
    accumulation: str = "float32"
    """Format of transmittance, weights and sums of light: float32 (at least the splats' dtype) or float64."""
    tile_cap: Count = 0
    """At most this many splats are blended per tile, the nearest; 0: all."""

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise ValueError(f"rasterizer.{name} is '{value}'; choose {', '.join(choices)}")
        self._check_rules()
        self._check_sizes()
        self._check_formats()

    def _check_rules(self) -> None:
        if not self.dilation > 0:
            raise ValueError(f"rasterizer.dilation is {self.dilation}; give a positive number of px^2")
        if not 0 <= self.training_focal < math.inf:
            raise ValueError(f"rasterizer.training_focal is {self.training_focal}; give px, or 0 where it is unknown")
        if self.zoomed != "plain" and self.compensate:
            raise ValueError(f"rasterizer.zoomed={self.zoomed} is for models without compensated opacities")
        if self.zoomed == "resampled" and self.dilation <= PIXEL_VARIANCE:
            raise ValueError(
                f"rasterizer.zoomed=resampled needs a dilation above {PIXEL_VARIANCE}, not {self.dilation}"
            )
        if self.pixel == "window":
            self._check_windows()
        if not 0 < self.alpha_min < self.alpha_max < 1:
            raise ValueError(f"need 0 < alpha_min < alpha_max < 1, got {self.alpha_min} and {self.alpha_max}")
        if not 0 <= self.transmittance_stop < 1:
            raise ValueError(
                f"rasterizer.transmittance_stop is {self.transmittance_stop}; give 0 (never stop) or more, below 1"
            )
        if not self.jacobian_margin >= 0:
            raise ValueError(f"rasterizer.jacobian_margin is {self.jacobian_margin}; give a number of 0 or more")

    def _check_windows(self) -> None:
        if not self.compensate and self.dilation <= BOX_VARIANCE:
            raise ValueError(f"rasterizer.pixel=window needs a dilation above 1/12 px^2, not {self.dilation}")

    def _check_sizes(self) -> None:
        if self.tile_size < 1:
            raise ValueError(f"rasterizer.tile_size is {self.tile_size}; give a number of px")
        if self.cull == "published" and WINDOW_TILE % self.tile_size:
            raise ValueError(
                f"rasterizer.tile_size is {self.tile_size}; with cull=published it must divide {WINDOW_TILE}"
            )
        for name in ("chunk", "batch_values", "unrolled", "max_pairs"):
            if getattr(self, name) < 1:
                raise ValueError(f"rasterizer.{name} is {getattr(self, name)}; give at least 1")
        if not 0 <= self.compiled_values <= LARGEST_BATCH:
            raise ValueError(f"rasterizer.compiled_values is {self.compiled_values}; give 0 (auto) to {LARGEST_BATCH}")
        if self.tile_cap < 0:
            raise ValueError(f"rasterizer.tile_cap is {self.tile_cap}; give a number of splats, or 0 for no cap")

    def _check_formats(self) -> None:
        """Refuses an alpha_max that rounds to 1: gradients divide by 1 - alpha."""
        for role in ("evaluation", "accumulation"):
            name = getattr(self, role)
            if 1 - self.alpha_max < 2.0 ** -SIGNIFICANT_BITS[name]:
                raise ValueError(f"rasterizer.alpha_max={self.alpha_max} is 1 in {role}={name}; lower it")

    def dilation_at(self, focal: float) -> tuple[float, float]:
        """(dilation, the dilation that opacities are compensated from or 0), px^2, for a focal length in px."""
        ratio = focal / self.training_focal if self.training_focal else 1.0
        dilation, drawn = self.dilation, 0.0
        if self.zoomed == "magnified":
            dilation = self.dilation * max(1.0, ratio) ** 2
        elif self.zoomed == "resampled" and ratio != 1:
            dilation = (self.dilation - PIXEL_VARIANCE) * ratio**2 + PIXEL_VARIANCE
            drawn = self.dilation * ratio**2
        if self.pixel == "sample":
            return dilation, drawn
        return (LEAST_VARIANCE, 0.0) if self.compensate else (dilation - BOX_VARIANCE, drawn or dilation)

    @property
    def published_dilation(self) -> bool:
        """Whether all cameras dilate by `dilation`, compensated or not."""
        return self.zoomed == "plain" and self.pixel == "sample"


@dataclass(frozen=True, kw_only=True)
class RasterSettings(RasterOptions):
    """Options of the rasterizer with the compositors that `path` may name, beside the eager one of core."""

    compositors: Mapping[str, Compositor] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path not in ("auto", "eager", *self.compositors):
            names = dict.fromkeys(("auto", "eager", *self.compositors))
            raise ValueError(f"rasterizer.path is '{self.path}'; choose {', '.join(names)}")
        if self.compositor_name not in ("eager", *self.compositors):
            raise ValueError("rasterizer.pixel=window needs a compositor `window`, which gsx registers")

    @property
    def drawn_by(self) -> str:
        """The path, `eager` where a training run has not decided."""
        return "eager" if self.path == "auto" else self.path

    @property
    def compositor_name(self) -> str:
        """The compositor that draws: that of pixel windows, or that of the path."""
        return "window" if self.pixel == "window" else self.drawn_by

    @property
    def backend(self) -> Backend:
        """What runs kernels beside blending: what the path's compositor brings, or eager torch."""
        compositor = self.compositors.get(self.drawn_by)
        return compositor.backend if isinstance(compositor, WithBackend) else EAGER

    @property
    def options(self) -> dict[str, Any]:
        """Options by name, without compositors."""
        return {entry.name: getattr(self, entry.name) for entry in fields(RasterOptions)}

    def path_on(self, device: str) -> str:
        """Returns the path by which pictures are drawn on a kind of device: `eager` where nothing compiles."""
        return self.drawn_by if self.backend.available(device) else "eager"
