"""What a model's renders of training views say of each primitive: who draws the error, what is lost without whom.

Both come from gradients of one render I of colours c_k by blending weights w_k, whatever the upstream gradient M:

- dI/dc_k = w_k, so that sum_p M w_k is the gradient of sum_p M I with respect to c_k (M = squared error: who draws it);
- dI/d ln o_k = w_k (c_k - b_k), b_k the colour behind k: just what a pixel loses when k is removed. Its square, summed
  over pixels, is the mean of the square of a gradient with M = random signs (Hutchinson 1989). The squared error grows
  by that, and by a part linear in the error, which training has brought to nothing in the sum over views.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.masks import blacked
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, Rendering, rasterize
from gsx.core.shapes import Float
from gsx.core.training.backbone import Backbone, Drawn
from gsx.core.training.parameter_table import ParameterTable


@dataclass(frozen=True, eq=False, kw_only=True)
class Look:
    """A render of M splats whose colours and log-opacities are leaves."""

    rendering: Rendering
    colours: Float[Tensor, "M 3"]
    log_opacities: Float[Tensor, "M"]


def look(splats: Splats, camera: Camera, raster: RasterSettings, background: Float[Tensor, "3"]) -> Look:
    """Render splats for a camera, at its own resolution."""
    values = {name: value.detach() for name, value in vars(splats).items()}
    colours, log_opacities = (values[name].requires_grad_() for name in ("colours", "log_opacities"))
    rendering = rasterize(replace(splats, **values), camera, raster, background=background)
    return Look(rendering=rendering, colours=colours, log_opacities=log_opacities)


def difference(image: Float[Tensor, "3 H W"], view: View) -> Float[Tensor, "3 H W"]:
    """A render less the photograph of its view; 0 where that does not count."""
    return blacked(image.detach() - view.image().to(image), view.counted())


def error_sums(seen: Look, off: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
    """Sum over pixels of blending weight times squared difference, summed over channels: they add up to the squared
    error where splats cover everything (Rota Bulo et al. 2024, for maxima over views)."""
    upstream = off.square().sum(0, keepdim=True).expand(3, -1, -1) / 3
    (gradient,) = torch.autograd.grad(seen.rendering.image, [seen.colours], upstream, retain_graph=True)
    return gradient.sum(1)


def random_signs(image: Float[Tensor, "3 H W"], generator: torch.Generator) -> Float[Tensor, "3 H W"]:
    """1 or -1 for each value of a picture."""
    return torch.randint(0, 2, image.shape, generator=generator).to(image) * 2 - 1


def removal_squares(seen: Look, signs: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
    """By how much the picture changes without each of the splats: squares summed over its values, in the mean over
    random signs. Where the model is at its best this is what the squared error grows by.

    Alphas at their upper bound count as if there were none.
    """
    (change,) = torch.autograd.grad(seen.rendering.image, [seen.log_opacities], signs, retain_graph=True)
    return change.square()


# -- by row of a model's table -----------------------------------------------------------------------------------------


def add_by_row(sums: Float[Tensor, "N"], drawn: Drawn, values: Float[Tensor, "M"]) -> None:
    """Add what was found of each splat to the row that it comes from."""
    if drawn.rows is None:
        sums += values
    else:
        sums.index_add_(0, drawn.rows, values)


def drawn_errors(
    model: Backbone[Any], views: Sequence[View], background: Float[Tensor, "3"], step: int
) -> Float[Tensor, "N"]:
    """Of each row the squared error that it draws in the views, by blending weights."""
    sums = background.new_zeros(len(model.table))
    for view in views:
        with torch.no_grad():
            drawn = model.draw(view.camera, step)
        seen = look(drawn.splats, view.camera, model.raster, background)
        add_by_row(sums, drawn, error_sums(seen, difference(seen.rendering.image, view)))
    return sums


@dataclass(frozen=True, eq=False, kw_only=True)
class Removal:
    """What N rows are worth to the pictures of some views."""

    squares: Float[Tensor, "N"]
    """`removal_squares` of the row's splats, in the mean over those that some view shows; 0 where none is shown."""
    shown: Float[Tensor, "N"]
    """How many are: views that show it, where a row is one splat."""
    error_share: float
    """Squared error of the views over all splats that they show."""


def worth_of_rows(
    model: Backbone[Any],
    views: Sequence[View],
    background: Float[Tensor, "3"],
    step: int,
    generator: torch.Generator,
) -> Removal:
    """What the pictures of the views lose without each row."""
    squares, shown, error = background.new_zeros(len(model.table)), background.new_zeros(len(model.table)), 0.0
    for view in views:
        with torch.no_grad():
            drawn = model.draw(view.camera, step)
        seen = look(drawn.splats, view.camera, model.raster, background)
        image = seen.rendering.image
        add_by_row(squares, drawn, removal_squares(seen, random_signs(image.detach(), generator)))
        screen = seen.rendering.screen
        visible = torch.zeros_like(seen.log_opacities).detach()
        visible[screen.ids[screen.visible]] = 1.0
        add_by_row(shown, drawn, visible)
        error += float(difference(image, view).double().square().sum())
    return Removal(squares=squares / shown.clamp_min(1), shown=shown, error_share=error / max(1.0, float(shown.sum())))


def some_of(views: Sequence[View], count: int, generator: torch.Generator) -> list[View]:
    """At most so many of the views, at random."""
    return [views[index] for index in torch.randperm(len(views), generator=generator)[:count].tolist()]


@torch.no_grad()
def window_errors(
    model: Backbone[Any],
    table: ParameterTable,
    windows: Mapping[View, Window],
    background: Float[Tensor, "3"],
    step: int,
) -> Float[Tensor, "W"]:
    """Squared error in windows of views, each summed over its values, of the model as it would be with that table."""
    own, model.table = model.table, table
    try:
        errors = [window_error(model, view, window, background, step) for view, window in windows.items()]
    finally:
        model.table = own
    return torch.stack(errors)


def window_error(
    model: Backbone[Any], view: View, window: Window, background: Float[Tensor, "3"], step: int
) -> Float[Tensor, ""]:
    """Squared error in a window of a view, at the view's own resolution."""
    splats = model.draw(view.camera, step).splats
    shown = rasterize(splats, window.of(view.camera), model.raster, background=background).image
    counted = view.counted()
    difference = shown - window.cut(view.image()).to(shown)
    return blacked(difference, None if counted is None else counted[window.pixels]).double().square().sum()
