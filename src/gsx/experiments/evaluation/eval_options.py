"""Options of an evaluation, and its protocol: what two results must share to be compared."""

import hashlib
import json
from dataclasses import dataclass, field
from typing import Annotated, Any

from torch import Tensor

from gsx.core.data.scene import Scene
from gsx.core.quality.metrics import ROUNDINGS, SSIM_VARIANTS, quantise
from gsx.core.ranges import Range
from gsx.core.shapes import Float
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.evaluation.perceptual import METRICS

COLOURS, POSES = ("rendered", "fitted"), ("given", "aligned")
MASKS = ("excluded", "black")
CHOICES = {"ssim": SSIM_VARIANTS, "rounding": ROUNDINGS, "masks": MASKS, "colours": COLOURS, "poses": POSES}
"""Values of options by name."""
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
    rounding: str = "nearest"
    """nearest: to the nearest of 256 levels; down: to the next lower one. Without effect unless quantised."""
    clamp: bool = False
    """True: renders that are not quantised are clamped to [0, 1]."""
    masks: str = "excluded"
    """excluded: PSNR and SSIM leave masked pixels out; black: they count, black in both pictures."""
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
        for name, known in CHOICES.items():
            if getattr(self, name) not in known:
                raise ValueError(f"eval.{name} is '{getattr(self, name)}'; choose from {', '.join(known)}")
        if not self.zoom:
            raise ValueError("eval.zoom is empty; give factors, for example [1,2,4]")

    def measured(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """Returns a picture as metrics get it: quantised to 8 bits, clamped, or as it is."""
        if self.quantise:
            return quantise(image, self.rounding)
        return image.clamp(0, 1) if self.clamp else image

    @property
    def right_halves(self) -> bool:
        """Returns whether left halves are used for fitting, so that right halves alone are evaluated."""
        return self.colours == "fitted" or self.poses == "aligned"


MASKED = {
    "excluded": "PSNR and SSIM over the pixels that count, the others black in all pictures",
    "black": "PSNR and SSIM over all pixels, those that do not count black in all pictures",
}
"""Rules for masks, by `eval.masks`."""


def protocol_of(scene: Scene, options: EvalOptions, lpips_name: str) -> dict[str, Any]:
    """Returns what two results must share to be compared, and its hash."""
    protocol: dict[str, Any] = {
        "scene": {key: value for key, value in scene.provenance.items() if key != "notes"},
        "test_views": [view.name for view in scene.test],
        "train_views": len(scene.train),
        "size": list((*scene.test, *scene.train)[0].camera.size),
        "background": scene.background.tolist(),
        "quantised_to_8_bit": options.quantise,
        "psnr": "mean over views of 20 log10(1/sqrt(MSE)), all pixels and channels",
        "ssim": options.ssim,
        "lpips": lpips_name,
        "enlarged": "x1 render, antialiased Keys bicubic",
    }
    if "masks" in protocol["scene"]:
        protocol |= {"masks": MASKED[options.masks]}
    if options.quantise and options.rounding != "nearest":
        protocol |= {"rounding": options.rounding}
    if options.clamp and not options.quantise:
        protocol |= {"clamped": True}
    if options.colours == "fitted":
        protocol |= {"colours": "3x4 matrix a view, least squares on the left half; all figures of the right half"}
    if options.poses == "aligned":
        protocol |= {"poses": "aligned to the model by the left half; all figures of the right half"}
    text = json.dumps(protocol, sort_keys=True, default=str)
    # the choice of zooms changes no figure, so it does not enter the hash
    return protocol | {"zoom": list(options.zoom), "hash": hashlib.sha256(text.encode()).hexdigest()[:16]}
