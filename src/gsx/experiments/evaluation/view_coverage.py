"""Coverage of views: how many training views show what a view shows.

Each sampled pixel of a view v has a point X on the model's surface. A training camera c covers the pixel if it shows
the same point from a similar side, not much coarser:

* X lies before c's near plane and projects onto a pixel of c's photo that counts;
* nothing stands before X: c's own depth D there is at least (1 - HIDDEN) z, z the depth of X in c;
* the rays from X to v and to c differ by at most LARGEST_TURN degrees;
* f_c / |X - c| >= f_v / (COARSER |X - v|), f the focal lengths in px: c shows X at least 1/COARSER times as large.

A pixel without a surface, such as sky, lies at infinity: a camera covers it that has no surface in that direction.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.run import Run
from gsx.experiments.evaluation.chosen_views import LARGEST_TURN, distinct
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluated_renders import depth_and_coverage
from gsx.experiments.evaluation.perceptual import mean_of
from gsx.experiments.evaluation.warp import Surface, points_of, project, surface_of
from gsx.experiments.run_folder.files import part
from gsx.experiments.run_folder.shapes import is_number

LONGER_SIDE = 160
"""Longer side of depth maps, px: about a quarter of a training photo's."""
SAMPLES = 400
"""Most sampled pixels of a view, on a regular grid; a share is then known to 3 %."""
ENOUGH = 3
"""Training views that should show a point: two triangulate it, a third confirms it."""
HIDDEN = 0.2
"""Relative depth by which a surface stands before a point that it hides: depths of young models differ by some 0.1."""
COARSER = 2.0
"""Largest ratio of the sizes at which a view and a training view show a point."""
FAR = 1e6
"""Distance of pixels without a surface, scene extents."""
CLASSES = {"well": 0.9, "partly": 0.5, "thin": 0.0}
"""Least covered share of the pixels of each class of views."""
LABELS = {"well": "well covered", "partly": "partly", "thin": "thinly"}
"""Words for the classes."""

Render: TypeAlias = Callable[[Camera], tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]]
"""Returns (blending-weighted sum of camera z, alpha) of a camera."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sampled:
    """Sampled pixels of a view, those that count."""

    view: View
    surface: Surface
    """Surface on a raster of at most LONGER_SIDE px."""
    counted: Bool[Tensor, "H W"]
    """Pixels of that raster that count."""
    indices: Int[Tensor, "S"]
    """Sampled pixels, row-major."""
    points: Float[Tensor, "S 3"]
    """World points of the samples, float64; far away without a surface."""
    empty: Bool[Tensor, "S"]
    """Samples without a surface."""

    @property
    def places(self) -> Float[Tensor, "S 2"]:
        """Returns the samples' places as shares of width and height."""
        width, height = self.surface.camera.size
        across, down = self.indices % width, self.indices.div(width, rounding_mode="floor")
        return torch.stack([(across + 0.5) / width, (down + 0.5) / height], 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Covered:
    """A view's samples with the number of other training views that cover each."""

    sampled: Sampled
    counts: Int[Tensor, "S"]

    def figures(self, right: bool = False) -> dict[str, float | None]:
        """Returns the covered share of the pixels and the mean number of views; `right`: of the right half alone."""
        counts = self.counts[self.sampled.places[:, 0] > 0.5] if right else self.counts
        if not len(counts):
            return {"coverage": None, "covering_views": None}
        share, views = (counts >= ENOUGH).double().mean(), counts.double().mean()
        return {"coverage": float(share), "covering_views": float(views)}


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneCoverage:
    """Coverage of all views of a scene by its training views."""

    train: Sequence[Covered]
    """Each training view, covered by the others."""
    test: Sequence[Covered]

    def figures(self, views: Sequence[dict[str, Any]], right: bool = False) -> dict[str, Any]:
        """Returns entries `coverage` and `views` of evaluation.json.

        views: its present entries of the test views. right: figures are of right halves.
        """
        own, training = [one.figures(right) for one in self.test], [one.figures() for one in self.train]
        classes = [class_of(one["coverage"]) for one in training if one["coverage"] is not None]
        entries = [view | figures for view, figures in zip(views, own, strict=True)]
        coverage = {
            "least_views": ENOUGH,
            **means(entries),
            "classes": by_class(entries),
            "training": means(training) | {"classes": {name: classes.count(name) for name in CLASSES}},
        }
        return {"coverage": coverage, "views": entries}


def class_of(share: float) -> str:
    """Returns the class of a covered share (CLASSES)."""
    return next(name for name, least in CLASSES.items() if share >= least)


def by_class(entries: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Returns the number of views of each class, their PSNR, SSIM and LPIPS, and the lowest PSNR."""
    known = [entry for entry in entries if entry["coverage"] is not None]
    groups = {name: [entry for entry in known if class_of(entry["coverage"]) == name] for name in CLASSES}
    figures = ("psnr", "ssim", "lpips")
    return {
        name: {"from": CLASSES[name], "views": len(group)}
        | {key: mean_of([entry.get(key) for entry in group]) for key in figures}
        | {"lowest_psnr": min((entry["psnr"] for entry in group), default=None)}
        for name, group in groups.items()
    }


def means(entries: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Returns the means of both figures of coverage over the views that have them."""
    known = [entry for entry in entries if entry["coverage"] is not None]
    shares, views = ([entry[key] for entry in known] for key in ("coverage", "covering_views"))
    return {"share": mean_of(shares), "covering_views": mean_of(views)}


def coverage_of(run: Run, options: EvalOptions) -> SceneCoverage:
    """Measures the coverage of all views of a run's scene by the depth of its model."""

    def draw(camera: Camera) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
        return depth_and_coverage(run, camera, options.tile_pixels)

    return scene_coverage(distinct(run.train_views), run.scene.test, draw, FAR * run.scene.extent)


def coverage_lines(evaluation: Mapping[str, Any]) -> list[str]:
    """Returns the coverage of an evaluation.json in a line; none if it was not measured."""
    coverage = part(dict(evaluation), "coverage")
    if "unavailable" in coverage:
        return [f"coverage: n/a, {coverage['unavailable']}"]
    training = part(coverage, "training")
    if is_number(coverage.get("share")):
        classes = {LABELS[name]: one for name, one in part(coverage, "classes").items() if one["views"]}
        levels = {label: "" if one["psnr"] is None else f" ({one['psnr']:.2f} dB)" for label, one in classes.items()}
        texts = [f"{label} {one['views']}{levels[label]}" for label, one in classes.items()]
        shared = f"at least {coverage['least_views']} training views show {coverage['share']:.0%} of a test view"
        return [f"coverage: {shared}; test views {', '.join(texts)}"]
    if is_number(training.get("share")):
        others = f"at least {coverage['least_views']} other training views"
        return [f"coverage: {others} show {training['share']:.0%} of a training view"]
    return []


def scene_coverage(train: Sequence[View], test: Sequence[View], draw: Render, far: float) -> SceneCoverage:
    """Measures the coverage of all views by the training views.

    Args:
        train: Training views, each once.
        test: Held-out views.
        draw: Depth of the model.
        far: Distance of pixels without a surface, scene units.
    """
    sampled = [sample_view(view, draw, far) for view in (*train, *test)]
    counts = count_covering(sampled, len(train))
    covered = [Covered(sampled=one, counts=own) for one, own in zip(sampled, counts, strict=True)]
    return SceneCoverage(train=covered[: len(train)], test=covered[len(train) :])


def sample_view(view: View, draw: Render, far: float) -> Sampled:
    """Renders a view's depth on a small raster and samples it on a grid."""
    camera = small_camera(view.camera)
    depth, alpha = draw(camera)
    mask = View(name=view.name, camera=camera, source=view.source).counted()
    counted = torch.ones(camera.height, camera.width, dtype=torch.bool) if mask is None else mask
    surface = surface_of(camera, depth.cpu(), alpha.cpu())
    columns, rows = grid_of(camera)
    indices = (rows[:, None] * camera.width + columns).flatten()
    indices = indices[counted.flatten()[indices]]
    empty = ~surface.visible.flatten()[indices]
    deep = Surface(camera=camera, depth=surface.depth.masked_fill(~surface.visible, far), visible=surface.visible)
    points = (points_of(deep, indices).T - camera.translation.double()) @ camera.rotation.double()
    return Sampled(view=view, surface=surface, counted=counted, indices=indices, points=points, empty=empty)


def small_camera(camera: Camera) -> Camera:
    """Returns a camera on a raster of at most LONGER_SIDE px."""
    return camera.zoom(min(1.0, LONGER_SIDE / max(camera.size)))


def grid_of(camera: Camera) -> tuple[Int[Tensor, "W"], Int[Tensor, "H"]]:
    """Returns columns and rows of a regular grid of at most SAMPLES pixels."""
    stride = math.ceil(math.sqrt(camera.width * camera.height / SAMPLES))
    while True:
        columns, rows = (torch.arange(stride // 2, side, stride) for side in camera.size)
        if len(columns) * len(rows) <= SAMPLES:
            return columns, rows
        stride += 1


def count_covering(sampled: Sequence[Sampled], observers: int) -> list[Int[Tensor, "S"]]:
    """Counts for each sample the first `observers` views that cover it, without views from the same place and side."""
    points, empty = torch.cat([one.points for one in sampled]), torch.cat([one.empty for one in sampled])
    sizes = [len(one.points) for one in sampled]
    centres = torch.stack([one.view.camera.centre.double() for one in sampled])
    focals = torch.tensor([one.view.camera.focal for one in sampled], dtype=torch.float64)
    owners = torch.repeat_interleave(torch.arange(len(sampled)), torch.tensor(sizes))
    rays = centres[owners] - points
    distances = rays.norm(dim=1)
    scales = focals[owners] / distances
    counts = torch.zeros(len(points), dtype=torch.int64)
    cameras = [one.view.camera for one in sampled]
    poses = torch.stack([torch.cat([one.rotation.double().flatten(), one.translation.double()]) for one in cameras])
    for number, observer in enumerate(sampled[:observers]):
        own = (poses == poses[number]).all(1)
        near = alike(observer, points, rays, distances, scales) & ~own[owners]
        rows = near.nonzero()[:, 0]
        counts[rows[shows(observer, points[rows], empty[rows])]] += 1
    return list(counts.split(sizes))


def alike(
    observer: Sampled,
    points: Float[Tensor, "P 3"],
    rays: Float[Tensor, "P 3"],
    distances: Float[Tensor, "P"],
    scales: Float[Tensor, "P"],
) -> Bool[Tensor, "P"]:
    """Marks points that an observer would show from a similar side and not much smaller.

    rays, distances: from points to their cameras. scales: px per scene unit at which these show the points.
    """
    camera = observer.view.camera
    own = camera.centre.double() - points
    lengths = own.norm(dim=1)
    turned = (own * rays).sum(1) >= math.cos(math.radians(LARGEST_TURN)) * lengths * distances
    return turned & (camera.focal * COARSER >= scales * lengths)


def shows(observer: Sampled, points: Float[Tensor, "P 3"], empty: Bool[Tensor, "P"]) -> Bool[Tensor, "P"]:
    """Marks points on an observer's raster that no surface hides; any surface hides those that are empty."""
    camera, surface = observer.surface.camera, observer.surface
    (columns, rows), depths = project(camera, camera.to_camera(points).T)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height) & (depths > camera.near)
    pixels = rows.long().clamp(0, camera.height - 1) * camera.width + columns.long().clamp(0, camera.width - 1)
    solid, own = surface.visible.flatten()[pixels], surface.depth.flatten()[pixels].double()
    clear = ~solid | (~empty & (own >= (1 - HIDDEN) * depths))
    return inside & observer.counted.flatten()[pixels] & clear
