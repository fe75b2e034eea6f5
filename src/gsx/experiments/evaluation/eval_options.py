"""Options of an evaluation."""

from dataclasses import dataclass
from typing import Annotated

from gsx.core.quality.metrics import SSIM_VARIANTS
from gsx.core.ranges import Range
from gsx.experiments.evaluation.lpips import LpipsOptions

COLOURS, POSES = ("rendered", "fitted"), ("given", "aligned")
LEAST_TILE_PIXELS = 16 * 16
"""One tile of the published rasterizer."""


@dataclass(frozen=True, kw_only=True)
class EvalOptions:
    """Options; values in conf/config.yaml. What changes figures is saved and hashed with every result."""

    zoom: Annotated[list[float], Range(1 / 64, 64)]
    quantise: bool
    ssim: str
    tile_pixels: Annotated[int, Range(LEAST_TILE_PIXELS, 1 << 31)]
    lpips: LpipsOptions
    supersample: Annotated[int, Range(0, 16)] = 0
    """Renders are so many times as fine as each picture and are reduced; 0: as the run was trained."""
    colours: str = "rendered"
    """rendered: as the model shows them; fitted: by one matrix of colours a view, which its left half is fitted by and
    its right half judged."""
    poses: str = "given"
    """given: views are drawn where the scene says; aligned: where the model says that they were taken, told from their
    left halves, and their right halves are judged."""
    flight: bool = True
    """Draw a flight into the finest detail, for the report."""
    remedy: str = ""
    """Overrides that are suggested where a render zoomed in loses to the enlarged one; empty: none."""

    def __post_init__(self) -> None:
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
        """Whether left halves tell something of views, and right halves alone are judged."""
        return self.colours == "fitted" or self.poses == "aligned"
