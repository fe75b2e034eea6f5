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
    left = half(view, counted, right=False)
    fitted = {name: module.fit_render(image, photo, left) for name, module in run.modules.items()}
    renders = {name: render for name, render in fitted.items() if render is not None}
    if not renders:
        return {}
    right = half(view, counted, right=True)
    if not right.any():
        return {}
    truth = black_out(photo, counted)

    def measure(render: Float[Tensor, "3 H W"]) -> tuple[float, float]:
        pair = black_out(options.measured(render), counted), truth
        return psnr(*pair, right), ssim(*pair, options.ssim, right)

    bare = measure(image)
    figures = {name: (*measure(render.to(image.device)), *bare) for name, render in renders.items()}
    return {"fitted": {name: dict(zip(KEYS, values, strict=True)) for name, values in figures.items()}}


def fitted_summary(views: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns means over views by module under the key `fitted`, with their protocol; empty: no module fits views."""
    found = [view["fitted"]["fitted"] for view in views if view["fitted"]]
    if not found:
        return {}
    means = {name: {key: fmean(figures[name][key] for figures in found) for key in KEYS} for name in found[0]}
    return {"fitted": {"protocol": PROTOCOL} | means}
