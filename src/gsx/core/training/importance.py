"""What a model's renders of training views say of each primitive: who draws the error, what is lost without whom.

Both come from gradients of one render I of colours c_k by blending weights w_k, whatever the upstream gradient M:

- dI/dc_k = w_k, so that sum_p M w_k is the gradient of sum_p M I with respect to c_k (M = squared error: who draws it);
- dI/d ln o_k = w_k (c_k - b_k), b_k the colour behind k: just what a pixel loses when k is removed. Its square, summed
  over pixels, is the mean of the square of a gradient with M = random signs (Hutchinson 1989). The squared error grows
  by that, and by a part linear in the error, which training has brought to nothing in the sum over views.
"""

from collections.abc import Callable, Mapping, Sequence
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
from gsx.core.rasterizer.composite import sum_by_splat
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import Backbone, Drawn
from gsx.core.training.finer_raster import FinerRaster
from gsx.core.training.parameter_table import ParameterTable

ROUNDING = 1 / (12 * 255**2)
"""Squared error of a value that is rounded to 8 bits: what lies below it is no evidence."""
Forming = Callable[[Camera], FinerRaster]
"""How a camera's picture comes about at a step (`training.supersample`)."""
Compared = Callable[[Float[Tensor, "3 H W"], Float[Tensor, "3 H W"], View, Window | None], Float[Tensor, "3 H W"]]
"""(render, photograph, view, window that both are of, None: all of it) -> the render as that photograph would show it
(`TrainingViews.compared`). Errors are told of these; what a primitive does to a picture, of the render itself."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Look:
    """A render of M splats whose colours and log-opacities are leaves."""

    rendering: Rendering
    image: Float[Tensor, "3 H W"]
    """The picture: the render, reduced where that is finer."""
    colours: Float[Tensor, "M 3"]
    log_opacities: Float[Tensor, "M"]
    camera: Camera
    """That the splats are drawn for."""

    @property
    def visible(self) -> Float[Tensor, "M"]:
        """1 for splats that are on screen, 0 for others."""
        screen, out = self.rendering.screen, torch.zeros_like(self.log_opacities).detach()
        out[screen.ids[screen.visible]] = 1.0
        return out


def look(splats: Splats, raster: FinerRaster, rules: RasterSettings, background: Float[Tensor, "3"]) -> Look:
    """Render splats for a camera, as it is rendered at that step."""
    values = {name: value.detach().requires_grad_() for name, value in vars(splats).items()}  # compiled as in training
    colours, log_opacities = values["colours"], values["log_opacities"]
    rendering = rasterize(replace(splats, **values), raster.camera, rules, background=background)
    image = raster.reduced(rendering.image)
    leaves = {"colours": colours, "log_opacities": log_opacities}
    return Look(rendering=rendering, image=image, camera=raster.drawn_for, **leaves)


def difference(
    image: Float[Tensor, "3 H W"], view: View, compared: Compared, window: Window | None = None
) -> Float[Tensor, "3 H W"]:
    """A render of all of a view or of a window, as the photograph would show it, less that photograph; 0 where that
    does not count."""
    part, counted = window or Window(0, 0, *view.camera.size), view.counted()
    photograph = part.cut(view.image()).to(image)
    off = compared(image.detach(), photograph, view, window) - photograph
    return blacked(off, None if counted is None else counted[part.pixels])


def rounding_of(view: View, window: Window | None = None) -> float:
    """Squared error of a photograph's rounding to 8 bits, summed over the values that count, of all or of a window."""
    part, counted = window or Window(0, 0, *view.camera.size), view.counted()
    return 3 * ROUNDING * (part.width * part.height if counted is None else int(counted[part.pixels].sum()))


def error_sums(seen: Look, off: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
    """Sum over pixels of blending weight times squared difference, summed over channels: they add up to the squared
    error where splats cover everything (Rota Bulo et al. 2024, for maxima over views)."""
    upstream = off.square().sum(0, keepdim=True).expand(3, -1, -1) / 3
    (gradient,) = torch.autograd.grad(seen.image, [seen.colours], upstream, retain_graph=True)
    return gradient.sum(1)


def random_signs(
    image: Float[Tensor, "3 H W"], generator: torch.Generator, counted: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "3 H W"]:
    """1 or -1 for each value of a picture; 0 where it does not count."""
    return blacked(torch.randint(0, 2, image.shape, generator=generator).to(image) * 2 - 1, counted)


def removal_changes(seen: Look, signs: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
    """By how much the picture changes without each of the splats, summed over its values with random signs. The mean of
    the square, of one or of a sum of several, is the sum over values of the squared change without these splats.

    Alphas at their upper bound count as if there were none.
    """
    (change,) = torch.autograd.grad(seen.image, [seen.log_opacities], signs, retain_graph=True)
    return change


def blending_squares(seen: Look, signs: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
    """The square of each splat's blending weights summed over pixels with random signs, in the mean over channels. Its
    mean is the sum over pixels of the squared weights."""
    (gradient,) = torch.autograd.grad(seen.image, [seen.colours], signs, retain_graph=True)
    return gradient.square().mean(1)


# -- by row of a model's table -----------------------------------------------------------------------------------------


def by_row(drawn: Drawn, values: Float[Tensor, "*K M"], count: int) -> Float[Tensor, "*K N"]:
    """Sums of what was found of the splats of each of so many rows."""
    if drawn.rows is None:
        return values
    each = values.reshape(-1, values.shape[-1]).T
    return sum_by_splat(each, drawn.rows, count).T.reshape(*values.shape[:-1], count)


def render_probe(
    model: Backbone[Any], camera: Camera, form: Forming, background: Float[Tensor, "3"], step: int
) -> tuple[Drawn, Look]:
    """(what the model draws for a camera, its render)."""
    raster = form(camera)
    with torch.no_grad():
        drawn = model.draw(raster.drawn_for, step)
    return drawn, look(drawn.splats, raster, model.raster, background)


def drawn_errors(
    model: Backbone[Any],
    views: Sequence[View],
    form: Forming,
    background: Float[Tensor, "3"],
    step: int,
    compared: Compared,
) -> Float[Tensor, "N"]:
    """Of each row the squared error that it draws in the views, by blending weights."""
    sums = background.new_zeros(len(model.table))
    for view in views:
        drawn, seen = render_probe(model, view.camera, form, background, step)
        sums += by_row(drawn, error_sums(seen, difference(seen.image, view, compared)), len(sums))
    return sums


def shown_weights(
    drawn: Drawn, seen: Look, counted: Bool[Tensor, "H W"] | None, count: int
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Blending weights of each row summed over pixels of a picture: (those that do not count, all)."""
    hidden = torch.zeros_like(seen.image[0]) if counted is None else (~counted).to(seen.image)
    upstream = torch.stack([hidden, torch.ones_like(hidden), torch.zeros_like(hidden)])
    (gradient,) = torch.autograd.grad(seen.image, [seen.colours], upstream, retain_graph=True)
    own, all_over = by_row(drawn, gradient[:, :2].T, count)
    return own, all_over


@dataclass(frozen=True, eq=False, kw_only=True)
class Removal:
    """What N rows are worth to the pictures of some views."""

    squares: Float[Tensor, "N"]
    """Squared changes of the picture without them, in the mean over the views that show the row; 0 where none does."""
    shown: Float[Tensor, "N"]
    """How many views show it."""
    error_share: float
    """Squared error of the views over the rows that they show, summed over views."""
    rounding_share: float
    """The like of photographs' own rounding: what no model can do better than."""

    def to(self, device: torch.device | str) -> "Removal":
        """On a device."""
        return replace(self, squares=self.squares.to(device), shown=self.shown.to(device))


DRAWS = 32
"""Of random signs, at least, over all views."""


def draws_of_each(views: Sequence[View]) -> int:
    """How often signs are drawn for each of the views."""
    return max(1, DRAWS // len(views))


def worth_of_rows(
    model: Backbone[Any],
    views: Sequence[View],
    form: Forming,
    background: Float[Tensor, "3"],
    step: int,
    generator: torch.Generator,
    compared: Compared,
) -> Removal:
    """What the pictures of the views lose without each row."""
    count, draws = len(model.table), draws_of_each(views)
    squares, shown, error, rounding = background.new_zeros(count), background.new_zeros(count), 0.0, 0.0
    for view in views:
        drawn, seen = render_probe(model, view.camera, form, background, step)
        squares += squared_changes(drawn, seen, view.counted(), count, draws, generator)
        shown += by_row(drawn, seen.visible, count) > 0
        error += float(difference(seen.image, view, compared).double().square().sum())
        rounding += rounding_of(view)
    all_shown = max(1.0, float(shown.sum()))
    shares = {"error_share": error / all_shown, "rounding_share": rounding / all_shown}
    return Removal(squares=squares / shown.clamp_min(1), shown=shown, **shares)


def squared_changes(
    drawn: Drawn,
    seen: Look,
    counted: Bool[Tensor, "H W"] | None,
    count: int,
    draws: int,
    generator: torch.Generator,
) -> Float[Tensor, "N"]:
    """Squared change of a picture without each row, in the mean over draws of signs."""
    total = seen.log_opacities.new_zeros(count).detach()
    for _ in range(draws):
        signs = random_signs(seen.image.detach(), generator, counted)
        total += by_row(drawn, removal_changes(seen, signs), count).square() / draws
    return total


def some_of(views: Sequence[View], count: int, generator: torch.Generator) -> list[View]:
    """At most so many of the views, at random."""
    return [views[index] for index in torch.randperm(len(views), generator=generator)[:count].tolist()]


@torch.no_grad()
def window_errors(
    model: Backbone[Any],
    table: ParameterTable,
    windows: Mapping[View, Window],
    form: Forming,
    background: Float[Tensor, "3"],
    step: int,
    compared: Compared,
) -> Float[Tensor, "W"]:
    """Squared error in windows of views, each summed over its values, of the model as it would be with that table."""
    own, model.table = model.table, table
    try:
        errors = [
            window_error(model, view, window, form, background, step, compared) for view, window in windows.items()
        ]
    finally:
        model.table = own
    return torch.stack(errors)


def window_error(
    model: Backbone[Any],
    view: View,
    window: Window,
    form: Forming,
    background: Float[Tensor, "3"],
    step: int,
    compared: Compared,
) -> Float[Tensor, ""]:
    """Squared error in a window of a view."""
    splats = model.draw(form(view.camera).drawn_for, step).splats
    raster = form(window.of(view.camera))
    image = raster.reduced(rasterize(splats, raster.camera, model.raster, background=background).image)
    return difference(image, view, compared, window).double().square().sum()
