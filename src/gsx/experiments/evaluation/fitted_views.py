"""Held-out views as modules fit them: fitted to the left half of the photo, measured on its right half.

The protocol of NeRF in the Wild (Martin-Brualla et al. 2021, section 4.3). These figures stand next to those of the
model's own render, which they replace nowhere.
"""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from torch import Tensor

from gsx.core.data.masks import black_out
from gsx.core.data.scene import View
from gsx.core.quality.metrics import psnr, ssim
from gsx.core.shapes import Float
from gsx.core.training.run import Run
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluated_renders import half

PROTOCOL = (
    "fitted on the left half of each held-out photo; all figures of the right halves, without the fit as _rendered"
)
KEYS = ("psnr", "ssim", "psnr_rendered", "ssim_rendered")


def fitted_figures(run: Run, view: View, image: Float[Tensor, "3 H W"], options: EvalOptions) -> dict[str, Any]:
    """Returns figures of a view's right half under the key `fitted`, by name of the module; empty: none fits views."""
    photo, counted = view.image(), view.counted()
    left, right = (half(view, counted, right=side) for side in (False, True))
    truth, figures = black_out(photo, counted), dict[str, dict[str, float]]()

    def measure(render: Float[Tensor, "3 H W"]) -> tuple[float, float]:
        pair = black_out(options.measured(render), counted), truth
        return psnr(*pair, right), ssim(*pair, options.ssim, right)

    for name, module in run.modules.items() if right.any() else ():
        fitted = module.fit_render(image, photo, left)
        if fitted is not None:
            figures[name] = dict(zip(KEYS, (*measure(fitted.to(image.device)), *measure(image)), strict=True))
    return {"fitted": figures} if figures else {}


def fitted_summary(views: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns means over views by module under the key `fitted`, with their protocol; empty: no module fits views."""
    found = [view["fitted"]["fitted"] for view in views if view["fitted"]]
    if not found:
        return {}
    means = {name: {key: fmean(figures[name][key] for figures in found) for key in KEYS} for name in found[0]}
    return {"fitted": {"protocol": PROTOCOL} | means}
