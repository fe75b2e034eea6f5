"""Renders of held-out views as an evaluation compares them: aligned cameras, fitted colours, finer rasters."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.core.quality.colour_matrix import fit_colours, transform_colours
from gsx.core.rasterizer import TiledRendering, rasterize_tiled
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import behind_scene
from gsx.core.training.render import coverage_and_depth, render, splats_for
from gsx.core.training.run import Run
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.surface_errors import ExactDepth, mean_depth, surface_errors
from gsx.experiments.evaluation.warp import Surface, surface_of
from gsx.experiments.evaluation.zoomed import Zoomed
from gsx.modules.alignment import estimate_camera, refuse_lens

ALIGNMENTS = 2
"""Number of times that a pose moves to where its photo was taken, each time by a new render."""


class EvaluatedRenders:
    """Renders of a run's held-out views by the options of an evaluation."""

    def __init__(self, run: Run, options: EvalOptions) -> None:
        self.run, self.options = run, options
        self.matrices: dict[str, Float[Tensor, "3 4"]] = {}
        """Fitted colour matrices by name of a view."""
        self.cameras: dict[str, Camera] = {}
        """Aligned cameras by name of a view."""

    def camera(self, view: View) -> Camera:
        """Returns the camera that a view is rendered from."""
        if self.options.poses == "given":
            return view.camera
        if view.name not in self.cameras:
            self.cameras[view.name] = align_camera(self.run, view)
        return view.camera.with_pose_of(self.cameras[view.name])

    def render(self, view: View, factor: float = 1) -> TiledRendering:
        """Renders the view, which is `factor` times as fine as a photo.

        From afar a model that was trained on finer renders is rendered as finely as it was trained.
        """
        times, trained = self.options.supersample, self.run.views.raster_scale(self.run.model_step)
        if factor < 1 and not times and trained > 1:
            times = math.ceil(trained / factor)
        return render(self.run, self.camera(view), self.options.tile_pixels, times)

    def surface(self, zoomed: Zoomed) -> Surface:
        """Renders what is visible in a zoomed view."""
        camera = self.camera(zoomed.view)
        depth, alpha = depth_and_coverage(self.run, camera, self.options.tile_pixels)
        counted = zoomed.view.counted() if zoomed.counted is None else zoomed.counted
        return surface_of(camera, depth, alpha, counted)

    def surface_errors(self, view: View, evaluated: Bool[Tensor, "H W"] | None) -> dict[str, dict[str, float]]:
        """Returns the errors of the model's depth on the evaluated pixels; empty: the true depth is unknown."""
        if not isinstance(view.source, ExactDepth):
            return {}
        summed, alpha = depth_and_coverage(self.run, self.camera(view), self.options.tile_pixels)
        return surface_errors(mean_depth(summed, alpha), view.source.exact_depth(view.camera), evaluated)

    def fit(self, view: View, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """Returns a render of a view in the colours that are compared; call it at the photos' resolution first."""
        if self.options.colours == "rendered":
            return image
        if view.name not in self.matrices:
            left = half(view, view.counted(), right=False)
            self.matrices[view.name] = fit_colours(image, view.image().to(image.device), left)
        return transform_colours(image, self.matrices[view.name]).clamp(0, 1)

    def evaluated_pixels(self, view: View, counted: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "H W"] | None:
        """Returns the pixels of a view that are evaluated, of those that count; None: all.

        Raises:
            InputError: there are none.
        """
        counted = None if self.options.masks == "black" else counted
        if not self.options.right_halves:
            return counted
        right = half(view, counted, right=True)
        if not right.any():
            raise InputError(
                f"{view.name}: its mask covers the whole right half, the part that is evaluated where colours are "
                "fitted or poses aligned. Use eval.colours=rendered eval.poses=given, or leave that view out."
            )
        return right


def half(view: View, counted: Bool[Tensor, "H W"] | None, right: bool) -> Bool[Tensor, "H W"]:
    """Returns the pixels of one half of a view, of those that count."""
    middle = view.camera.width // 2
    out = torch.ones(view.camera.height, view.camera.width, dtype=torch.bool) if counted is None else counted.clone()
    out[:, slice(middle) if right else slice(middle, None)] = False
    return out


def align_camera(run: Run, view: View) -> Camera:
    """Returns the camera where the model says that a view was taken, by its left half."""
    left, camera = half(view, view.counted(), right=False), view.camera
    refuse_lens(camera)
    for _ in range(ALIGNMENTS):
        rendering = render(run, camera, supersample=1, depth=True)
        assert rendering.depth is not None
        pictures = rendering.image, rendering.depth, rendering.alpha, view.image()
        camera = estimate_camera(camera, *pictures, left, prior=view.camera)
    return camera


def depth_and_coverage(run: Run, camera: Camera, pixels: int) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Return (blending-weighted sum of camera z, coverage) of all splats but those behind the scene.

    They are drawn in place of colours, for which loops are compiled already.
    """
    splats = splats_for(run, camera)
    both = coverage_and_depth(splats, behind_scene(run.backbone, splats.means), camera)
    with_depth = replace(splats, colours=torch.cat([both, both[:, :1]], 1))
    coverage, summed, _ = rasterize_tiled(with_depth, camera, run.raster, pixels=pixels).image
    return summed, coverage
