"""Evaluation on held-out views: image quality, zoomed views against true finer pixels, size and speed.

Beside each zoomed figure stands the naive competitor, the x1 render resized by bicubic interpolation: a zoomed render
that loses to it adds artefacts, not detail.
"""

import hashlib
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.masks import blacked
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.core.quality.metrics import SSIM_VARIANTS, bicubic, psnr, quantise, ssim
from gsx.core.ranges import Range
from gsx.core.rasterizer import TiledRendering
from gsx.core.shapes import Bool, Float
from gsx.core.training.parameter_table import size_of
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.engine.compiled import path_of
from gsx.experiments.evaluation.detail import Details, details_of, explained
from gsx.experiments.evaluation.lpips import LpipsOptions, load_lpips
from gsx.experiments.evaluation.remarks import NOT_MEASURED, gathered
from gsx.experiments.run_folder.files import DETAIL_OF
from gsx.modules.alignment import aligned
from gsx.modules.exposure import best_matrix, transformed

COLOURS, POSES = ("rendered", "fitted"), ("given", "aligned")
ALIGNED = 2
"""How often a pose is moved to where its photograph was taken, each time by a new render."""
LEAST_TILE_PIXELS = 16 * 16
"""One tile of the published rasterizer."""


@dataclass(frozen=True, kw_only=True)
class EvalOptions:
    """Options; values in conf/config.yaml. What changes figures is saved and hashed with every result."""

    zoom: Annotated[list[float], Range(1 / 64, 64)]
    quantise: bool
    ssim: str
    tile_pixels: Annotated[int, Range(LEAST_TILE_PIXELS, 1 << 31)]
    lpips: LpipsOptions
    supersample: Annotated[int, Range(0, 16)] = 0
    """Renders are so many times as fine as each picture and are reduced; 0: as the run was trained."""
    colours: str = "rendered"
    """rendered: as the model shows them; fitted: by one matrix of colours a view, which its left half is fitted by and
    its right half judged."""
    poses: str = "given"
    """given: views are drawn where the scene says; aligned: where the model says that they were taken, told from their
    left halves, and their right halves are judged."""
    flight: bool = True
    """Draw a flight into the finest detail, for the report."""
    remedy: str = ""
    """Overrides that are suggested where a render zoomed in loses to the enlarged one; empty: none."""

    def __post_init__(self) -> None:
        if self.ssim not in SSIM_VARIANTS:
            raise ValueError(f"eval.ssim is '{self.ssim}'; choose from {', '.join(SSIM_VARIANTS)}")
        if self.colours not in COLOURS:
            raise ValueError(f"eval.colours is '{self.colours}'; choose from {', '.join(COLOURS)}")
        if self.poses not in POSES:
            raise ValueError(f"eval.poses is '{self.poses}'; choose from {', '.join(POSES)}")
        if not self.zoom:
            raise ValueError("eval.zoom is empty; give factors, for example [1,2,4]")

    @property
    def right_halves(self) -> bool:
        """Whether left halves tell something of views, and right halves alone are judged."""
        return self.colours == "fitted" or self.poses == "aligned"


def peak_memory_mb(device: torch.device) -> float | None:
    """Peak memory of the GPU, or of this process on the CPU, in MB (1e6 bytes); None where Python is not told it."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is in bytes on macOS, in KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def protocol_of(run: Run, options: EvalOptions, lpips_name: str) -> dict[str, Any]:
    """What two results must share to be compared, and its hash."""
    protocol: dict[str, Any] = {
        "scene": {key: value for key, value in run.scene.provenance.items() if key != "notes"},
        "test_views": [view.name for view in run.scene.test],
        "train_views": len(run.scene.train),
        "size": list((*run.scene.test, *run.scene.train)[0].camera.size),
        "background": run.scene.background.tolist(),
        "quantised_to_8_bit": options.quantise,
        "psnr": "mean over views of 20 log10(1/sqrt(MSE)), all pixels and channels",
        "ssim": options.ssim,
        "lpips": lpips_name,
        "enlarged": "x1 render, antialiased Keys bicubic",
    }
    if "masks" in protocol["scene"]:
        protocol |= {"masks": "PSNR and SSIM over the pixels that count, the others black in all pictures"}
    if options.colours == "fitted":
        protocol |= {"colours": "3x4 matrix a view, least squares on the left half; all figures of the right half"}
    if options.poses == "aligned":
        protocol |= {"poses": "aligned to the model by the left half; all figures of the right half"}
    text = json.dumps(protocol, sort_keys=True, default=str)
    # which zooms were looked at changes no figure, so it does not enter the hash
    return protocol | {"zoom": list(options.zoom), "hash": hashlib.sha256(text.encode()).hexdigest()[:16]}


def mean(values: Sequence[float | None]) -> float | None:
    """Mean, or None where a value is missing."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known and len(known) == len(values) else None


def highest(values: Sequence[float | None]) -> float | None:
    """The largest known value, or None where none is known."""
    return max((value for value in values if value is not None), default=None)


def group_figures(views: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Means over the views of a group."""
    keys = {"psnr": "psnr", "ssim": "ssim", "lpips": "lpips", "visible_primitives": "visible"}
    return {name: mean([view[key] for view in views]) for name, key in keys.items()}


@dataclass(frozen=True, eq=False, kw_only=True)
class Zoomed:
    """A view at a zoom: the truth there, the render, and the x1 render resized to it, as they are measured."""

    view: View
    factor: float
    truth: Float[Tensor, "3 H W"]
    render: Float[Tensor, "3 H W"]
    enlarged: Float[Tensor, "3 H W"]
    photograph: Float[Tensor, "3 H W"]
    """The truth at the training resolution, enlarged: the most that can be had without new detail."""
    counted: Bool[Tensor, "H W"] | None = None
    """Which pixels count, None: all; those that masks leave out are black in every picture."""


@runtime_checkable
class Drawing(Protocol):
    """Who draws views while their truth and renders are at hand; views are counted as in `scene.test`."""

    def choose(self, figures: Sequence[dict[str, Any]]) -> None:
        """Learns the figures of all views at the training resolution, before the first is drawn."""
        ...

    def whole(self, number: int, view: View, render: Float[Tensor, "3 H W"]) -> None:
        """A view at the training resolution."""
        ...

    def zoomed(self, number: int, zoomed: Zoomed) -> None:
        """The same view at another zoom; all of its zooms come before the next view."""
        ...


Advance = Callable[[float, str], None]
"""Told after each picture: its size in units of an x1 picture, and what it was."""


def silent(amount: float, part: str) -> None:
    """Tells nobody."""


def half(view: View, counted: Bool[Tensor, "H W"] | None, right: bool) -> Bool[Tensor, "H W"]:
    """Which pixels of one half of a view count, of those that do."""
    middle = view.camera.width // 2
    out = torch.ones(view.camera.height, view.camera.width, dtype=torch.bool) if counted is None else counted.clone()
    out[:, slice(middle) if right else slice(middle, None)] = False
    return out


def aligned_to(run: Run, view: View) -> Camera:
    """Where the model says that a view was taken, told from its left half."""
    left, camera = half(view, view.counted(), right=False), view.camera
    for _ in range(ALIGNED):
        shown = render(run, camera, supersample=1, depth=True)
        assert shown.depth is not None
        camera = aligned(camera, shown.image, shown.depth, shown.alpha, view.image(), left, given=view.camera)
    return camera


class Evaluator:
    """Measures one run by one protocol; each view is rendered once at each zoom."""

    def __init__(self, run: Run, options: EvalOptions) -> None:
        self.run, self.options = run, options
        self.lpips = load_lpips(options.lpips)
        self.times: list[float] = []
        """Seconds of each render at the training resolution, without its way to the CPU."""
        self.kept: dict[View, Tensor] = {}
        """Those renders, as bytes where they are quantised."""
        self.matrices: dict[str, Float[Tensor, "3 4"]] = {}
        """Of colours, by name of the view, where they are fitted."""
        self.cameras: dict[str, Camera] = {}
        """Where views were taken, by name, where poses are aligned."""

    def measured(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """The picture as metrics see it."""
        return quantise(image) if self.options.quantise else image

    def fitted(self, view: View, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """A render of a view, at the training resolution first, in the colours that are judged."""
        if self.options.colours == "rendered":
            return image
        if view.name not in self.matrices:
            left = half(view, view.counted(), right=False)
            self.matrices[view.name] = best_matrix(image, view.image().to(image.device), left)
        return transformed(image, self.matrices[view.name]).clamp(0, 1)

    def judged(self, view: View, counted: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "H W"] | None:
        """Which pixels of a view are judged, of those that count; None: all.

        Raises:
            InputError: none is.
        """
        if not self.options.right_halves:
            return counted
        right = half(view, counted, right=True)
        if not right.any():
            raise InputError(
                f"{view.name}: its mask leaves nothing of the right half, by which pictures are judged where colours "
                "are fitted or poses are aligned: give eval.colours=rendered eval.poses=given, or leave that view out"
            )
        return right

    def drawn_from(self, view: View) -> Camera:
        """The camera that a view is drawn from."""
        if self.options.poses == "given":
            return view.camera
        if view.name not in self.cameras:
            self.cameras[view.name] = aligned_to(self.run, view)
        return view.camera.with_pose_of(self.cameras[view.name])

    def rendered(self, view: View, factor: float = 1) -> TiledRendering:
        """The model as the view's camera sees it, `factor` times as fine as a photograph. From afar a model of finer
        renders is drawn as finely as it was trained."""
        times = self.options.supersample
        if factor < 1 and not times and self.run.views.supersample_at(self.run.model_step) > 1:
            times = math.ceil(self.run.views.supersample_at(self.run.model_step) / factor)
        return render(self.run, self.drawn_from(view), self.options.tile_pixels, times)

    def view(self, view: View) -> dict[str, Any]:
        """Figures of one view at the training resolution."""
        self.drawn_from(view)  # what finds it is not part of the time of a render
        begun = time.perf_counter()
        tiled = self.rendered(view)
        self.times.append(time.perf_counter() - begun - tiled.gathering)
        whole, counted = self.measured(self.fitted(view, tiled.image)), view.counted()
        self.kept[view] = to_uint8(whole) if self.options.quantise else whole
        image, truth, judged = blacked(whole, counted), blacked(view.image(), counted), self.judged(view, counted)
        return {
            "name": view.name,
            "group": view.group,
            "psnr": psnr(image, truth, judged),
            "ssim": self.ssim(image, truth, judged),
            "lpips": None if self.lpips is None else self.lpips.distance(self.seen(image), self.seen(truth)),
            "visible": int(tiled.visible.sum()),
            "left_out": tiled.dropped,
        }

    def ssim(
        self, image: Float[Tensor, "3 H W"], truth: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None
    ) -> float:
        """By the protocol's variant, compiled if renders would be where the picture is."""
        return ssim(image, truth, self.options.ssim, counted, path_of(self.run.raster, image.device) == "compiled")

    def seen(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H w"]:
        """The part of a picture that is judged, for metrics that know no mask."""
        return image[..., image.shape[2] // 2 :] if self.options.right_halves else image

    def whole(self, view: View) -> Float[Tensor, "3 H W"]:
        """The render of a view that was measured."""
        kept = self.kept[view]
        return kept.float() / 255 if self.options.quantise else kept

    def zoomed(self, view: View, factor: float) -> Zoomed | None:
        """A measured view at `factor` times the resolution, or None where there is no truth."""
        finer = view.zoom(factor)
        if finer is None:
            return None
        whole, image = self.whole(view), self.fitted(view, self.rendered(finer, factor).image)
        counted = finer.counted()
        enlarged, photograph = (bicubic(picture, *finer.camera.size) for picture in (whole, view.image()))
        return Zoomed(
            view=finer,
            factor=factor,
            truth=blacked(finer.image(), counted),
            render=blacked(self.measured(image), counted),
            enlarged=blacked(self.measured(enlarged), counted),
            photograph=blacked(self.measured(photograph), counted),
            counted=self.judged(finer, counted),
        )

    def zoom_figures(self, zoomed: Zoomed) -> dict[str, float]:
        """Figures of one view at a zoom, beside those of its competitors."""
        truth, counted = zoomed.truth, zoomed.counted
        return {
            "psnr": psnr(zoomed.render, truth, counted),
            "ssim": self.ssim(zoomed.render, truth, counted),
            "enlarged_psnr": psnr(zoomed.enlarged, truth, counted),
            "enlarged_ssim": self.ssim(zoomed.enlarged, truth, counted),
            "photograph_psnr": psnr(zoomed.photograph, truth, counted),
        }

    def work(self) -> float:
        """What `advance` will be told in all."""
        test = self.run.scene.test
        zooms = [f for view in test for f in self.options.zoom if f != 1 and view.zoom(f) is not None]
        return len(test) + sum(factor**2 for factor in zooms)

    def views(self, advance: Advance = silent) -> list[dict[str, Any]]:
        """Figures of all views at the training resolution."""
        out = []
        for view in self.run.scene.test:
            out.append(self.view(view))
            advance(1, view.name)
        return out

    def zooms(
        self, views: Sequence[dict[str, Any]], drawing: Drawing | None = None, advance: Advance = silent
    ) -> dict[str, dict[str, Any]]:
        """Mean figures at each zoom, from those of `views` and of zoomed views; all of them are drawn on the way."""
        if not views:
            return {f"{factor:g}": {"unavailable": NOT_MEASURED} for factor in self.options.zoom}
        found: dict[float, list[dict[str, float]]] = {factor: [] for factor in self.options.zoom}
        details: dict[float, list[Details]] = {factor: [] for factor in self.options.zoom}
        for number, (view, own) in enumerate(zip(self.run.scene.test, views, strict=True)):
            if drawing is not None:
                drawing.whole(number, view, self.whole(view))
            for factor, figures in found.items():
                if factor == 1:  # nothing is enlarged
                    figures.append({kind + key: own[key] for kind in ("", "enlarged_") for key in ("psnr", "ssim")})
                elif zoomed := self.zoomed(view, factor):
                    figures.append(self.zoom_figures(zoomed))
                    shown = {name: getattr(zoomed, name) for name in DETAIL_OF}
                    whole = zoomed.counted is None  # the border of a mask would be detail
                    details[factor].append(details_of(shown, zoomed.truth, factor) if whole else {})
                    if drawing is not None:
                        drawing.zoomed(number, zoomed)
                    advance(factor**2, f"{view.name} x{factor:g}")
        return {f"{factor:g}": zoom_entry(factor, figures, details[factor]) for factor, figures in found.items()}

    def frames_per_second(self) -> float | None:
        """Return renders per second at the training resolution, without the first, which warms up; None: none was."""
        times = self.times[1:11] or self.times
        return 1 / statistics.median(times) if times else None

    def evaluate(self, drawing: Drawing | None = None, advance: Advance = silent) -> dict[str, Any]:
        """Return the content of evaluation.json; figures of quality are None where no view is held out.

        Raises:
            InputError: of a view nothing is judged; before any is drawn.
        """
        if self.options.right_halves:
            for view in self.run.scene.test:
                self.judged(view, view.counted())
        run, views = self.run, self.views(advance)
        primitives, size = size_of(run.backbone.table)
        groups = sorted({v["group"] for v in views if v["group"]})
        by_group = {name: [v for v in views if v["group"] == name] for name in groups}
        figures = ("psnr", "ssim", "lpips")
        if drawing is not None:
            drawing.choose(views)
        return {
            "protocol": protocol_of(run, self.options, self.lpips.name if self.lpips else "n/a (no weights)"),
            "step": run.step,
            **{key: mean([v[key] for v in views]) for key in figures},
            "primitives": primitives,
            "visible_primitives": mean([v["visible"] for v in views]),
            "left_out": mean([v["left_out"] for v in views]),
            **gathered(run.curves),
            "megabytes": size / 1e6,
            "render_fps": self.frames_per_second(),
            "render_path": path_of(run.raster, run.device),
            "train_seconds": run.seconds,
            "peak_memory_mb": highest([peak_memory_mb(run.device), *(line.get("memory_mb") for line in run.curves)]),
            "groups": {name: group_figures(vs) for name, vs in by_group.items()},
            "zoom": self.zooms(views, drawing, advance),
            "views": [{key: v[key] for key in ("name", "group", *figures)} for v in views],
        }


def zoom_entry(factor: float, figures: Sequence[dict[str, float]], details: Sequence[Details]) -> dict[str, Any]:
    """Mean figures at one zoom, with the verdict; or a reason why there are none."""
    if not figures:
        return {"unavailable": f"the images hold no truth at x{factor:g}: train on a larger scene.downscale"}
    means = {key: statistics.fmean(f[key] for f in figures) for key in figures[0]}
    gain = means["psnr"] - means["enlarged_psnr"]
    known = [detail for detail in details if detail]
    found = {name: explained([detail[name] for detail in known]) for name in known[0]} if known else {}
    verdict = {"views": len(figures), "beats_enlarged": None if factor == 1 else gain > 0}
    return means | verdict | ({"detail": found} if found else {})


def quick_psnr(run: Run, options: EvalOptions, count: int = 8) -> float:
    """Mean PSNR over up to `count` evenly spread test views, for the curve during training."""
    views = evenly(run.scene.test, count)
    renders = ((v, render(run, v.camera, options.tile_pixels).image) for v in views)
    return statistics.fmean(psnr(image, v.image(), v.counted()) for v, image in renders)


def evenly(views: Sequence[View], count: int) -> list[View]:
    """Up to `count` of some views, the middles of as many equal parts."""
    count = min(count, len(views))
    return [views[(2 * part + 1) * len(views) // (2 * count)] for part in range(count)]
