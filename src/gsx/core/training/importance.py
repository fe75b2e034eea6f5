"""What a model's renders of training views say of each primitive: who draws the error, what is lost without whom.

Both come from gradients of one render I of colours c_k by blending weights w_k, whatever the upstream gradient M:

- dI/dc_k = w_k, so that sum_p M w_k is the gradient of sum_p M I with respect to c_k (M = squared error: who draws it);
- dI/d ln o_k = w_k (c_k - b_k), b_k the colour behind k: just what a pixel loses when k is removed. Its square, summed
  over pixels, is the mean of the square of a gradient with M = random signs (Hutchinson 1989). The squared error grows
  by that, and by a part linear in the error, which training has brought to nothing in the sum over views.
"""

import copy
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
from gsx.core.rasterizer.composite import sum_by_splat
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.backbone import Backbone
from gsx.core.training.finer_raster import FinerRaster
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.training_views import TrainingViews

ROUNDING = 1 / (12 * 255**2)
"""Squared error of a value that is rounded to 8 bits."""
DRAWS = 32
"""Least number of random sign pictures over all views."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProbeRender:
    """A render of M splats whose colours and log-opacities are leaves; the splats belong to N rows of a table."""

    splats: Splats
    rendering: Rendering
    image: Float[Tensor, "3 H W"]
    """The picture: the render, reduced where that is finer."""
    colours: Float[Tensor, "M 3"]
    log_opacities: Float[Tensor, "M"]
    camera: Camera
    """The camera that the splats are drawn for."""
    rows: Int[Tensor, "M"] | None = None
    """Row of each splat; None: splat n is row n."""
    count: int
    """N."""

    def by_row(self, values: Float[Tensor, "*K M"]) -> Float[Tensor, "*K N"]:
        """Sums values of splats over the splats of each row."""
        if self.rows is None:
            return values
        each = values.reshape(-1, values.shape[-1]).T
        return sum_by_splat(each, self.rows, self.count).T.reshape(*values.shape[:-1], self.count)

    def visible_rows(self) -> Bool[Tensor, "N"]:
        """Marks rows of which a splat is on screen."""
        screen, visible = self.rendering.screen, torch.zeros_like(self.log_opacities).detach()
        visible[screen.ids[screen.visible]] = 1.0
        return self.by_row(visible) > 0

    def gradient(self, leaf: Tensor, upstream: Float[Tensor, "3 H W"]) -> Tensor:
        """Sends an upstream gradient of the picture back to one of the leaves."""
        return torch.autograd.grad(self.image, [leaf], upstream, retain_graph=True)[0]

    def error_sums(self, difference: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
        """Sums squared differences over pixels by blending weights (Rota Bulo et al. 2024, for maxima over views).

        Over splats they add up to the squared error where splats cover everything.
        """
        return self.gradient(self.colours, difference.square().sum(0, keepdim=True).expand(3, -1, -1) / 3).sum(1)

    def removal_changes(self, signs: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
        """Estimates the change of the picture without each splat, summed over its values with random signs.

        The mean square, of one or of a sum of several, is the squared change of the picture without these splats.
        Alphas at their upper bound count as if there were none.
        """
        return self.gradient(self.log_opacities, signs)

    def blending_squares(self, signs: Float[Tensor, "3 H W"]) -> Float[Tensor, "M"]:
        """Estimates the sum over pixels of each splat's squared blending weights, as the mean over random signs."""
        return self.gradient(self.colours, signs).square().mean(1)

    def squared_changes(
        self, counted: Bool[Tensor, "H W"] | None, draws: int, generator: torch.Generator
    ) -> Float[Tensor, "N"]:
        """Estimates the squared change of the picture without each row, in the mean over random signs."""
        total = self.log_opacities.new_zeros(self.count).detach()
        for _ in range(draws):
            signs = random_signs(self.image.detach(), generator, counted)
            total += self.by_row(self.removal_changes(signs)).square() / draws
        return total

    def blending_weights(self, counted: Bool[Tensor, "H W"] | None) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """Sums blending weights of each row over (pixels that do not count, all pixels)."""
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
    """Renders splats, of `count` rows of a table, for a camera; without `rows` splat n is row n."""
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
    """Draws 1 or -1 for each value of a picture; 0 where it does not count."""
    return blacked(torch.randint(0, 2, image.shape, generator=generator).to(image) * 2 - 1, counted)


def draws_per_view(views: Sequence[View]) -> int:
    """Returns how often signs are drawn for each of the views."""
    return max(1, DRAWS // len(views))


def random_views(views: Sequence[View], count: int, generator: torch.Generator) -> list[View]:
    """Picks at most `count` of the views at random."""
    return [views[index] for index in torch.randperm(len(views), generator=generator)[:count].tolist()]


def rounding_of(view: View, window: Window | None = None) -> float:
    """Squared error of a photo's rounding to 8 bits, summed over the values that count, of all or of a window."""
    part, counted = window or Window(0, 0, *view.camera.size), view.counted()
    return 3 * ROUNDING * (part.width * part.height if counted is None else int(counted[part.pixels].sum()))


@dataclass(frozen=True, eq=False, kw_only=True)
class Removal:
    """What N rows are worth to the pictures of some views."""

    squares: Float[Tensor, "N"]
    """Squared changes of the picture without them, in the mean over the views that show the row; 0 where none does."""
    views: Float[Tensor, "N"]
    """Number of views that show each row."""
    error_share: float
    """Squared error of the views over the rows that they show, summed over views."""
    rounding_share: float
    """The same of the rounding of the photos: no model can do better."""

    def to(self, device: torch.device | str) -> "Removal":
        """Moves it to a device."""
        return replace(self, squares=self.squares.to(device), views=self.views.to(device))


@dataclass(frozen=True, eq=False, kw_only=True)
class Probe:
    """Renders a model of training views as a step does, and compares the renders with the photos."""

    model: Backbone[Any]
    views: TrainingViews
    step: int
    """Step whose rules the model is drawn by."""
    raster_step: int = 0
    """Step whose rules pictures are rendered by; 0: `step`."""

    @property
    def background(self) -> Float[Tensor, "3"]:
        """The scene's background on the model's device."""
        return self.views.scene.background.to(self.model.table.device)

    def with_table(self, table: ParameterTable) -> "Probe":
        """Returns a probe of the same model with another table; the model itself stays as it is."""
        model = copy.copy(self.model)
        model.table = table
        return replace(self, model=model)

    def raster(self, camera: Camera) -> FinerRaster:
        """Returns the raster that a camera's picture is rendered on."""
        return self.views.raster_for(self.raster_step or self.step)(camera)

    def render(self, camera: Camera) -> ProbeRender:
        """Renders what the model draws for a camera."""
        raster, model = self.raster(camera), self.model
        with torch.no_grad():
            drawn = model.draw(raster.drawn_for, self.step)
        return render_with_leaves(drawn.splats, raster, model.raster, self.background, drawn.rows, len(model.table))

    def difference(
        self, image: Float[Tensor, "3 H W"], view: View, window: Window | None = None
    ) -> Float[Tensor, "3 H W"]:
        """Subtracts a photo, or a window of it, from a render as the photo would show it; 0 where it does not count."""
        part, counted = window or Window(0, 0, *view.camera.size), view.counted()
        photo = part.cut(view.image()).to(image)
        return blacked(
            self.views.match_photo(image.detach(), photo, view, window) - photo,
            None if counted is None else counted[part.pixels],
        )

    def squared_error(
        self, image: Float[Tensor, "3 H W"], view: View, window: Window | None = None
    ) -> Float[Tensor, ""]:
        """Sums the squared difference of a render and a photo, float64."""
        return self.difference(image, view, window).double().square().sum()

    def row_errors(self, views: Sequence[View]) -> Float[Tensor, "N"]:
        """Sums the squared error that each row draws in the views, by blending weights."""
        sums = self.background.new_zeros(len(self.model.table))
        for view in views:
            render = self.render(view.camera)
            sums += render.by_row(render.error_sums(self.difference(render.image, view)))
        return sums

    def removal(self, views: Sequence[View], generator: torch.Generator) -> Removal:
        """Estimates what the pictures of the views lose without each row."""
        squares, shown = self.background.new_zeros(2, len(self.model.table))
        error = rounding = 0.0
        for view in views:
            render = self.render(view.camera)
            squares += render.squared_changes(view.counted(), draws_per_view(views), generator)
            shown += render.visible_rows()
            error += float(self.squared_error(render.image, view))
            rounding += rounding_of(view)
        total = max(1.0, float(shown.sum()))
        shares = {"error_share": error / total, "rounding_share": rounding / total}
        return Removal(squares=squares / shown.clamp_min(1), views=shown, **shares)

    @torch.no_grad()
    def window_errors(self, windows: Mapping[View, Window]) -> Float[Tensor, "W"]:
        """Sums the squared error in each window of a view."""
        return torch.stack([self.window_error(view, window) for view, window in windows.items()])

    def window_error(self, view: View, window: Window) -> Float[Tensor, ""]:
        """Sums the squared error in a window of a view."""
        splats = self.model.draw(self.raster(view.camera).drawn_for, self.step).splats
        raster = self.raster(window.of(view.camera))
        rendering = rasterize(splats, raster.camera, self.model.raster, background=self.background)
        return self.squared_error(raster.reduced(rendering.image), view, window)
