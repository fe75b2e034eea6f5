"""The knobs of the rasterizer. Values live in `conf/rasterizer`; the defaults here are the published 3D-GS rules."""

from dataclasses import dataclass

WINDOW_TILE = 16
"""Tile edge of the published rasterizer: its 3-sigma windows are whole numbers of these (spec 3.1)."""

CHOICES = {
    "cull": ("published", "tight"),
    "path": ("auto", "eager", "compiled"),
    "schedule": ("auto", "chunks", "segments"),
    "exponent": ("squares", "direct", "expanded"),
    "evaluation": ("float32", "float64", "tf32", "bfloat16", "float16"),
    "accumulation": ("float32", "float64", "bfloat16", "float16"),
}
"""Values of the settings that are names; the first is not always the default."""


@dataclass(frozen=True, kw_only=True)
class RasterSettings:
    """Rules that shape the image, then sizes that only shape the work."""

    dilation: float = 0.3
    """Added to both diagonal entries of the screen covariance, px^2 (3D-GS, spec 3.1)."""
    alpha_min: float = 1 / 255
    """Contributions below are skipped (spec 3.4)."""
    alpha_max: float = 0.99
    """Alphas are clamped here (spec 3.4)."""
    transmittance_stop: float = 1e-4
    """A pixel ends before the splat that would take its transmittance below (spec 3.4)."""
    cull: str = "published"
    """`published`: a splat reaches only the 16 px tiles of its 3-sigma square, as 3D-GS draws it.
    `tight`: it reaches every pixel where its alpha is at least alpha_min (the better rule: no truncation)."""
    jacobian_margin: float = 0.3
    """x/z, y/z are clamped to the raster widened by this fraction of half its extent in the Jacobian (spec 3.2)."""
    tile_size: int = 8
    """Edge of the compositing tiles, px; with cull=published it must divide 16."""
    chunk: int = 16
    """Splats composited per step of a tile."""
    batch_values: int = 1 << 18
    """Alpha values evaluated at once: bounds working memory and should fit the CPU's cache."""
    max_pairs: int = 100_000_000
    """A picture that needs more splat-tile pairs is refused by name (memory is about 100 B a pair)."""
    path: str = "eager"
    """`eager`: plain torch operations, works everywhere. `compiled`: the same mathematics through torch.compile.
    `auto`: a run decides (compiled where a compiler works and the run is long enough to repay it)."""
    schedule: str = "auto"
    """Of the compiled path. `chunks`: front to back, saturated tiles leave. `segments`: all chunks of all tiles at
    once, joined by an associative scan. `auto`: chunks on a CPU, segments on a GPU."""
    exponent: str = "squares"
    """How ln alpha is evaluated: `squares` (two affine squares), `direct` (from the offset to the mean),
    `expanded` (a quadratic polynomial in tile coordinates)."""
    evaluation: str = "float32"
    """Precision in which alphas are evaluated: float64, float32, tf32 (GPU matrix products), bfloat16 or float16."""
    accumulation: str = "float32"
    """Precision in which transmittance and light are accumulated: float64, float32, bfloat16 or float16."""
    tile_cap: int = 0
    """At most this many splats are blended per tile, the nearest; 0: all."""

    def __post_init__(self) -> None:
        if self.tile_size < 1 or (self.cull == "published" and WINDOW_TILE % self.tile_size):
            raise ValueError(
                f"rasterizer.tile_size is {self.tile_size}; with cull=published it must divide {WINDOW_TILE}"
            )
        if not self.dilation > 0:
            raise ValueError(f"rasterizer.dilation is {self.dilation}; give a positive number of px^2")
        if self.chunk < 1 or self.batch_values < 1:
            raise ValueError("rasterizer.chunk and rasterizer.batch_values must be at least 1")
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise ValueError(f"rasterizer.{name} is '{value}'; choose {', '.join(choices)}")
        if self.tile_cap < 0:
            raise ValueError(f"rasterizer.tile_cap is {self.tile_cap}; give a number of splats, or 0 for no cap")
        if not 0 < self.alpha_min < self.alpha_max < 1:
            raise ValueError(f"need 0 < alpha_min < alpha_max < 1, got {self.alpha_min} and {self.alpha_max}")
