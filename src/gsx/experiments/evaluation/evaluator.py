"""Evaluation on held-out views: image quality, zoomed views against true finer pixels, size and speed.

Each zoomed figure is compared with two competitors: the x1 render enlarged by bicubic interpolation, and by a
pretrained network. A zoomed render that loses to the first adds artefacts, not detail; one that loses to the second
holds less than a network guesses.
"""

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.masks import black_out
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.quality.metrics import bicubic, psnr, ssim
from gsx.core.shapes import Bool, Float
from gsx.core.training.parameter_table import size_of
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.chosen_views import evenly
from gsx.experiments.evaluation.competitor import Competitor
from gsx.experiments.evaluation.cross_view import CrossViews
from gsx.experiments.evaluation.eval_options import EvalOptions, protocol_of
from gsx.experiments.evaluation.evaluated_renders import EvaluatedRenders
from gsx.experiments.evaluation.fitted_views import fitted_figures, fitted_summary
from gsx.experiments.evaluation.lpips import load_lpips
from gsx.experiments.evaluation.perceptual import MetricSettings, at_training_size, load_metrics, mean_of
from gsx.experiments.evaluation.remarks import NOT_MEASURED, gathered, module_remarks, module_summaries
from gsx.experiments.evaluation.surface_errors import surface_summary
from gsx.experiments.evaluation.zoom_figures import ZoomFigures, measure_zoom, zoom_result
from gsx.experiments.evaluation.zoomed import Drawing, Zoomed


def peak_memory_mb(device: torch.device) -> float | None:
    """Peak memory of the GPU, or of this process on the CPU, in MB (1e6 bytes); None where Python cannot ask."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is in bytes on macOS, in KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def means(views: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, float | None]:
    """Returns the means of some figures over views."""
    return {name: mean_of([view[name] for view in views]) for name in names}


Advance = Callable[[float, str], None]
"""Callback after each picture: its size in units of an x1 picture, and its name."""


def silent(amount: float, part: str) -> None:
    """Ignores progress."""


class Evaluator:
    """Measures one run by one protocol; each view is rendered once at each zoom."""

    def __init__(self, run: Run, options: EvalOptions, competitor: Competitor | None = None) -> None:
        self.run, self.options, self.competitor = run, options, competitor
        self.lpips, self.renders = load_lpips(options.lpips), EvaluatedRenders(run, options)
        ranges, pixels, photos = options.lpips.input_range, options.perceptual_pixels, run.scene.train
        inputs = MetricSettings(input_range=ranges, pixels=pixels, device=run.device, photos=photos)
        self.perceptual = load_metrics(options.perceptual, inputs)
        self.times: list[float] = []
        """Seconds of each render at the training resolution, without its way to the CPU."""
        self.kept: dict[View, Tensor] = {}
        """Renders at the training resolution, as bytes where they are quantised."""

    def view(self, view: View) -> dict[str, Any]:
        """Measures one view at the training resolution."""
        self.renders.camera(view)  # estimating it is not part of the time of a render
        start = time.perf_counter()
        tiled = self.renders.render(view)
        self.times.append(time.perf_counter() - start - tiled.gathering)
        whole, counted = self.keep(view, tiled.image), view.counted()
        image, truth = black_out(whole, counted), black_out(view.image(), counted)
        parts = self.evaluated_part(image), self.evaluated_part(truth)
        evaluated = self.renders.evaluated_pixels(view, counted)
        return {
            "name": view.name,
            "group": view.group,
            "psnr": psnr(image, truth, evaluated),
            "ssim": self.ssim(image, truth, evaluated),
            "lpips": None if self.lpips is None else self.lpips.distance(*parts),
            "perceptual": self.perceptual.view(*parts),
            "surface": self.renders.surface_errors(view, evaluated),
            "fitted": fitted_figures(self.run, view, tiled.image, self.options),
            "visible_primitives": int(tiled.visible.sum()),
            "left_out": tiled.dropped,
        }

    def ssim(
        self, image: Float[Tensor, "3 H W"], truth: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None
    ) -> float:
        """Returns SSIM by the protocol's variant, compiled if renders on that device are."""
        return ssim(image, truth, self.options.ssim, counted, self.run.raster.backend.on(image.device.type))

    def evaluated_part(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H w"]:
        """Returns the part of a picture that counts, for metrics without masks."""
        return image[..., image.shape[2] // 2 :] if self.options.right_halves else image

    def keep(self, view: View, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """Keeps an x1 render as it is measured, and returns it."""
        whole = self.options.measured(self.renders.fit(view, image))
        self.kept[view] = to_uint8(whole) if self.options.quantise else whole
        return whole

    def whole(self, view: View) -> Float[Tensor, "3 H W"]:
        """Returns the x1 render of a view."""
        if view not in self.kept:
            self.keep(view, self.renders.render(view).image)
        kept = self.kept[view]
        return kept.float() / 255 if self.options.quantise else kept

    def zoomed(self, view: View, factor: float) -> Zoomed | None:
        """Returns a view at `factor` times the resolution, or None where there is no truth."""
        finer = view.zoom(factor)
        if finer is None:
            return None
        whole, image = self.whole(view), self.renders.fit(view, self.renders.render(finer, factor).image)
        counted = finer.counted()
        enlarged, photograph = (bicubic(picture, *finer.camera.size) for picture in (whole, view.image()))
        zoomed = Zoomed(
            view=finer,
            factor=factor,
            truth=black_out(finer.image(), counted),
            render=black_out(self.options.measured(image), counted),
            enlarged=black_out(self.options.measured(enlarged), counted),
            photograph=black_out(self.options.measured(photograph), counted),
            counted=self.renders.evaluated_pixels(finer, counted),
        )
        return self.competitor.join(zoomed, whole, view, self.options.measured) if self.competitor else zoomed

    def work(self) -> float:
        """Returns the sum of sizes that `advance` will receive."""
        test = self.run.scene.test
        zooms = [f for view in test for f in self.options.zoom if f != 1 and view.zoom(f) is not None]
        return len(test) + sum(factor**2 for factor in zooms)

    def views(self, advance: Advance = silent) -> list[dict[str, Any]]:
        """Measures all views at the training resolution."""
        out = []
        for view in self.run.scene.test:
            out.append(self.view(view))
            advance(1, view.name)
        return out

    def zooms(
        self, views: Sequence[dict[str, Any]], drawing: Drawing | None = None, advance: Advance = silent
    ) -> dict[str, dict[str, Any]]:
        """Returns mean figures at each zoom from those of `views` at x1; sends each picture to `drawing`."""
        if not views:
            return {f"{factor:g}": {"unavailable": NOT_MEASURED} for factor in self.options.zoom}
        found: dict[float, list[ZoomFigures]] = {factor: [] for factor in self.options.zoom}
        run = self.run
        cross = CrossViews(run.scene.test, run.train_views, self.options, self.renders.surface, self.zoomed)
        for number, (view, own) in enumerate(zip(self.run.scene.test, views, strict=True)):
            if drawing is not None:
                drawing.whole(number, view, self.whole(view))
            for factor, figures in found.items():
                if factor == 1:  # nothing is enlarged
                    same = {kind + key: own[key] for kind in ("", "enlarged_") for key in ("psnr", "ssim")}
                    figures.append(ZoomFigures(view.group, same, {}, at_training_size(own["perceptual"])))
                elif zoomed := self.zoomed(view, factor):
                    perceptual = self.perceptual.zoomed(zoomed, self.evaluated_part)
                    figures.append(measure_zoom(zoomed, self.ssim, perceptual))
                    cross.add(view, zoomed)
                    if drawing is not None:
                        drawing.zoomed(number, zoomed)
                    advance(factor**2, f"{view.name} x{factor:g}")
        return {f"{factor:g}": zoom_result(factor, views) | cross.figures(factor) for factor, views in found.items()}

    def frames_per_second(self) -> float | None:
        """Return renders per second at the training resolution, without the first, which warms up; None: none was."""
        times = self.times[1:11] or self.times
        return 1 / statistics.median(times) if times else None

    def evaluate(self, drawing: Drawing | None = None, advance: Advance = silent) -> dict[str, Any]:
        """Return the content of evaluation.json; figures of quality are None where no view is held out.

        Raises:
            InputError: a view has no pixel that counts; raised before the first picture.
        """
        if self.options.right_halves:
            for view in self.run.scene.test:
                self.renders.evaluated_pixels(view, view.counted())
        run, views, curves = self.run, self.views(advance), self.run.progress.curves
        primitives, size = size_of(run.backbone.table)
        groups = sorted({v["group"] for v in views if v["group"]})
        by_group = {name: [v for v in views if v["group"] == name] for name in groups}
        figures = ("psnr", "ssim", "lpips")
        own = ("name", "group", *figures, "perceptual")
        memory = [peak_memory_mb(run.device), *(line.get("memory_mb") for line in curves)]
        if drawing is not None:
            drawing.choose(views)
        evaluation = {
            "protocol": protocol_of(run.scene, self.options, self.lpips.name if self.lpips else "n/a (no weights)"),
            "step": run.step,
            **means(views, figures),
            **self.perceptual.summary(views),
            **self.perceptual.provenance,
            "primitives": primitives,
            **means(views, ("visible_primitives", "left_out")),
            **surface_summary(views),
            **fitted_summary(views),
            **gathered(curves),
            **module_summaries(run),
            "megabytes": size / 1e6,
            "render_fps": self.frames_per_second(),
            "render_path": run.raster.path_on(run.device.type),
            "train_seconds": run.progress.seconds,
            "peak_memory_mb": max((value for value in memory if value is not None), default=None),
            "groups": {
                name: means(some, (*figures, "visible_primitives")) | self.perceptual.summary(some)
                for name, some in by_group.items()
            },
            **({"competitor": self.competitor.provenance()} if self.competitor else {}),
            "zoom": self.zooms(views, drawing, advance),
            "views": [{key: v[key] for key in own} | v["surface"] | v["fitted"] for v in views],
        }
        return evaluation | module_remarks(run, evaluation)


def quick_psnr(run: Run, options: EvalOptions, count: int = 8) -> float:
    """Returns mean PSNR over up to `count` evenly spread test views, for the curve during training."""
    views = evenly(run.scene.test, count)
    renders = ((v, render(run, v.camera, options.tile_pixels).image) for v in views)
    return statistics.fmean(psnr(image, v.image(), v.counted()) for v, image in renders)
