"""Options of an evaluation."""

from dataclasses import dataclass, field
from typing import Annotated

from gsx.core.quality.metrics import SSIM_VARIANTS
from gsx.core.ranges import Range
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.evaluation.perceptual import METRICS

COLOURS, POSES = ("rendered", "fitted"), ("given", "aligned")
LEAST_WINDOW_PIXELS = 1 << 16
"""Four windows of 128 px, in which networks see more than borders."""
LEAST_TILE_PIXELS = 16 * 16
"""One tile of the published rasterizer."""


@dataclass(frozen=True, kw_only=True)
class MetricOptions:
    """Options of the group `metrics`; values in conf/config.yaml."""

    lpips: LpipsOptions
    perceptual: list[str] = field(default_factory=list)
    """Names of perceptual metrics."""
    perceptual_pixels: Annotated[int, Range(0, 1 << 31)] = 1 << 17
    """Largest picture that networks measure as a whole; 0: any."""

    def __post_init__(self) -> None:
        if unknown := [name for name in self.perceptual if name not in METRICS]:
            raise ValueError(f"metrics.perceptual has '{unknown[0]}'; choose from {', '.join(METRICS)}")
        if self.perceptual_pixels and self.perceptual_pixels < LEAST_WINDOW_PIXELS:
            raise ValueError(
                f"metrics.perceptual_pixels is {self.perceptual_pixels}; give 0, or {LEAST_WINDOW_PIXELS} and more"
            )


@dataclass(frozen=True, kw_only=True)
class EvalOptions(MetricOptions):
    """Options; values in conf/config.yaml. What changes figures is saved and hashed with every result."""

    zoom: Annotated[list[float], Range(1 / 64, 64)]
    quantise: bool
    ssim: str
    tile_pixels: Annotated[int, Range(LEAST_TILE_PIXELS, 1 << 31)]
    supersample: Annotated[int, Range(0, 16)] = 0
    """Factor by which renders are finer than each picture before they are reduced; 0: as in training."""
    colours: str = "rendered"
    """rendered: as the model renders them; fitted: corrected by one colour matrix per view, fitted on its left half and
    evaluated on its right half."""
    poses: str = "given"
    """given: poses of the scene; aligned: poses estimated with the model on left halves, evaluated on right halves."""
    pairs: Annotated[int, Range(0, 1 << 20)] = 8
    """Test views whose consistency with a neighbour is measured at each zoom above 1; 0: none."""
    flight: bool = True
    """Draw a flight into the finest detail, for the report."""
    remedy: str = ""
    """Overrides that are suggested where a render zoomed in loses to the enlarged one; empty: none."""
    advice: str = ""
    """Overrides that are suggested where a pretrained upscaler is installed and training used none; empty: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ssim not in SSIM_VARIANTS:
            raise ValueError(f"eval.ssim is '{self.ssim}'; choose from {', '.join(SSIM_VARIANTS)}")
        if self.colours not in COLOURS:
            raise ValueError(f"eval.colours is '{self.colours}'; choose from {', '.join(COLOURS)}")
        if self.poses not in POSES:
            raise ValueError(f"eval.poses is '{self.poses}'; choose from {', '.join(POSES)}")
        if not self.zoom:
            raise ValueError("eval.zoom is empty; give factors, for example [1,2,4]")

    @property
    def right_halves(self) -> bool:
        """Returns whether left halves are used for fitting, so that right halves alone are evaluated."""
        return self.colours == "fitted" or self.poses == "aligned"
