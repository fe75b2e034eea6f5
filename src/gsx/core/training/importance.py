"""Importance of primitives in renders of training views: their share of the error, and the loss from their removal.

Both are gradients of one render I, with colours c_k, blending weights w_k and an upstream gradient M:

- dI/dc_k = w_k, so sum_p M w_k is the gradient of sum_p M I by c_k; with M = squared error: the error of splat k.
- dI/d ln o_k = w_k (c_k - b_k), b_k the colour behind k: the change of a pixel when k is removed. The sum of its square
  over pixels is the mean square of a gradient with M = random signs (Hutchinson 1989). The squared error grows by that,
  and by a term linear in the error, which is 0 in the sum over views after training.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.masks import black_out
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, Rendering, rasterize
from gsx.core.rasterizer.composite import sum_by_splat
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import Backbone
from gsx.core.training.finer_raster import FinerRaster
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.training_views import TrainingViews

ROUNDING = 1 / (12 * 255**2)
"""Squared error of rounding a value to 8 bits."""
DRAWS = 32
"""Least number of pictures of random signs over all views."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProbeRender:
    """Render of M splats, of N table rows, with gradients by colours and log-opacities."""

    splats: Splats
    rendering: Rendering
    image: Float[Tensor, "3 H W"]
    """The render, reduced if it is finer than the camera."""
    colours: Float[Tensor, "M 3"]
    log_opacities: Float[Tensor, "M"]
    camera: Camera
    """Camera that the splats are drawn for."""
    rows: Int[Tensor, "M"] | None = None
    """Table row of each splat; None: splat n is row n."""
    count: int
    """Number N of rows."""

    def by_row(self, values: Float[Tensor, "*K M"]) -> Float[Tensor, "*K N"]:
        """Sums values over the splats of each row."""
        if self.rows is None:
            return values
        each = values.reshape(math.prod(values.shape[:-1]), values.shape[-1]).T
        return sum_by_splat(each, self.rows, self.count).T.reshape(*values.shape[:-1], self.count)

    def visible_rows(self) -> Bool[Tensor, "N"]:
        """Marks rows with a splat on screen."""
        screen, visible = self.rendering.screen, torch.zeros_like(self.log_opacities).detach()
        visible[screen.ids[screen.visible]] = 1.0
        return self.by_row(visible) > 0

    def gradient(self, leaf: Tensor, upstream: Float[Tensor, "3 H W"]) -> Tensor:
        """Returns the gradient of a leaf by an upstream gradient of the picture."""
        return torch.autograd.grad(self.image, [leaf], upstream, retain_graph=True)[0]

    def error_sums(self, difference: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
        """Sums squared differences over pixels by blending weights (Rota Bulo et al. 2024, for maxima over views)."""
        return self.gradient(self.colours, difference.square().sum(0, keepdim=True).expand(3, -1, -1) / 3).sum(1)

    def removal_changes(self, signs: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
        """Sums each splat's change of the picture with random signs; the mean square is the squared change."""
        return self.gradient(self.log_opacities, signs)

    def blending_squares(self, signs: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
        """Estimates the sum of each splat's squared blending weights over pixels, by random signs."""
        return self.gradient(self.colours, signs).square().mean(1)

    def squared_changes(
        self, counted: Bool[Tensor, "H W"] | None, draws: int, generator: torch.Generator
    ) -> Float[Tensor, "N"]:
        """Estimates the squared change of the picture without each row, by the mean over random signs."""
        total = self.log_opacities.new_zeros(self.count).detach()
        for _ in range(draws):
            signs = random_signs(self.image.detach(), generator, counted)
            total += self.by_row(self.removal_changes(signs)).square() / draws
        return total

    def blending_weights(self, counted: Bool[Tensor, "H W"] | None) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """Returns the sums of each row's blending weights over masked pixels, and over all pixels."""
        hidden = torch.zeros_like(self.image[0]) if counted is None else (~counted).to(self.image)
        upstream = torch.stack([hidden, torch.ones_like(hidden), torch.zeros_like(hidden)])
        uncounted, total = self.by_row(self.gradient(self.colours, upstream)[:, :2].T)
        return uncounted, total


def render_with_leaves(
    splats: Splats,
    raster: FinerRaster,
    rules: RasterSettings,
    background: Float[Tensor, "3"],
    rows: Int[Tensor, "M"] | None = None,
    count: int | None = None,
) -> ProbeRender:
    """Renders splats, of `count` table rows, with gradients by colours and log-opacities."""
    values = {name: value.detach().requires_grad_() for name, value in vars(splats).items()}  # compiled as in training
    rendering = rasterize(replace(splats, **values), raster.camera, rules, background=background)
    return ProbeRender(
        splats=splats,
        rendering=rendering,
        image=raster.reduced(rendering.image),
        colours=values["colours"],
        log_opacities=values["log_opacities"],
        camera=raster.drawn_for,
        rows=rows,
        count=len(splats) if count is None else count,
    )


def random_signs(
    image: Float[Tensor, "3 H W"], generator: torch.Generator, counted: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "3 H W"]:
    """Draws 1 or -1 for each value of a picture; 0 where masked."""
    return black_out(torch.randint(0, 2, image.shape, generator=generator).to(image) * 2 - 1, counted)


def draws_per_view(views: Sequence[View]) -> int:
    """Returns the number of sign pictures for each of the views."""
    return max(1, DRAWS // len(views))


def random_views(views: Sequence[View], count: int, generator: torch.Generator) -> list[View]:
    """Picks at most `count` of the views at random."""
    return [views[index] for index in torch.randperm(len(views), generator=generator)[:count].tolist()]


def rounding_of(view: View, window: Window | None = None) -> float:
    """Returns the squared error of rounding a photo, or a window of it, to 8 bits, summed over unmasked values."""
    part, counted = window or Window(0, 0, *view.camera.size), view.counted()
    return 3 * ROUNDING * (part.width * part.height if counted is None else int(counted[part.pixels].sum()))


@dataclass(frozen=True, eq=False, kw_only=True)
class Removal:
    """Estimated loss from the removal of each of N rows, from some views."""

    squares: Float[Tensor, "N"]
    """Squared change of the picture without each row, mean over the views that show it; 0: no view does."""
    views: Float[Tensor, "N"]
    """Number of views that show each row."""
    error_share: float
    """Squared error per visible row, summed over views."""
    rounding_share: float
    """The same of rounding the photos: the lower bound of any model."""

    def to(self, device: torch.device | str) -> "Removal":
        """Returns a copy on a device."""
        return replace(self, squares=self.squares.to(device), views=self.views.to(device))


@dataclass(frozen=True, eq=False, kw_only=True)
class Probe:
    """Renders of training views by the rules of a step, compared with their photos."""

    model: Backbone[Any]
    views: TrainingViews
    step: int
    """Step whose rules the splats are drawn by."""
    raster_step: int = 0
    """Step whose raster is used; 0: `step`."""

    @property
    def background(self) -> Float[Tensor, "3"]:
        """The scene's background on the model's device."""
        return self.views.scene.background.to(self.model.table.device)

    def with_table(self, table: ParameterTable) -> "Probe":
        """Returns a probe of a shallow copy of the model with another table."""
        model = copy.copy(self.model)
        model.table = table
        return replace(self, model=model)

    def raster(self, camera: Camera) -> FinerRaster:
        """Returns the raster of a camera."""
        return self.views.raster_for(self.raster_step or self.step)(camera)

    def render(self, camera: Camera) -> ProbeRender:
        """Renders the model for a camera."""
        raster, model = self.raster(camera), self.model
        with torch.no_grad():
            drawn = model.draw(raster.drawn_for, self.step)
        return render_with_leaves(drawn.splats, raster, model.raster, self.background, drawn.rows, len(model.table))

    def difference(
        self, image: Float[Tensor, "3 H W"], view: View, window: Window | None = None
    ) -> Float[Tensor, "3 H W"]:
        """Returns the corrected render minus the photo, or a window of it; 0 where masked."""
        part, counted = window or Window(0, 0, *view.camera.size), view.counted()
        photo = part.cut(view.image()).to(image)
        return black_out(
            self.views.match_photo(image.detach(), photo, view, window) - photo,
            None if counted is None else counted[part.pixels],
        )

    def squared_error(
        self, image: Float[Tensor, "3 H W"], view: View, window: Window | None = None
    ) -> Float[Tensor, ""]:
        """Returns the sum of squared differences of a render and a photo, float64."""
        return self.difference(image, view, window).double().square().sum()

    def row_errors(self, views: Sequence[View]) -> Float[Tensor, "N"]:
        """Returns each row's squared error in the views, by blending weights."""
        sums = self.background.new_zeros(len(self.model.table))
        for view in views:
            render = self.render(view.camera)
            sums += render.by_row(render.error_sums(self.difference(render.image, view)))
        return sums

    def removal(self, views: Sequence[View], generator: torch.Generator) -> Removal:
        """Estimates the loss from the removal of each row, from the views."""
        squares, visible = self.background.new_zeros(2, len(self.model.table))
        error = rounding = 0.0
        for view in views:
            render = self.render(view.camera)
            squares += render.squared_changes(view.counted(), draws_per_view(views), generator)
            visible += render.visible_rows()
            error += float(self.squared_error(render.image, view))
            rounding += rounding_of(view)
        total = max(1.0, float(visible.sum()))
        shares = {"error_share": error / total, "rounding_share": rounding / total}
        return Removal(squares=squares / visible.clamp_min(1), views=visible, **shares)

    @torch.no_grad()
    def window_errors(self, windows: Mapping[View, Window]) -> Float[Tensor, "W"]:
        """Returns the squared error in each window of a view."""
        return torch.stack([self.window_error(view, window) for view, window in windows.items()])

    def window_error(self, view: View, window: Window) -> Float[Tensor, ""]:
        """Returns the squared error in a window of a view."""
        splats = self.model.draw(self.raster(view.camera).drawn_for, self.step).splats
        raster = self.raster(window.of(view.camera))
        rendering = rasterize(splats, raster.camera, self.model.raster, background=self.background)
        return self.squared_error(raster.reduced(rendering.image), view, window)
