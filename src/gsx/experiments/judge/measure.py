"""Figures of a method's pictures, view by view and zoom by zoom, and their means."""

import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from torch import Tensor

from gsx.core.backend import EAGER, Backend
from gsx.core.data.masks import black_out
from gsx.core.data.scene import Scene, View
from gsx.core.quality.metrics import bicubic, psnr
from gsx.core.shapes import Bool, Float
from gsx.experiments.evaluation.competitor import Competitor
from gsx.experiments.evaluation.cross_view import CrossViews
from gsx.experiments.evaluation.detail import details_of
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.lpips import Lpips
from gsx.experiments.evaluation.perceptual import PerceptualMetrics
from gsx.experiments.evaluation.zoom_figures import ZoomFigures, zoom_result
from gsx.experiments.evaluation.zoomed import Zoomed
from gsx.experiments.judge.methods import Method, PictureFolder
from gsx.experiments.judge.similarity_variants import all_ssim

Picture: TypeAlias = Float[Tensor, "3 H W"]
RIVALS = ("enlarged", "upscaled")
"""Pictures that a zoomed render is compared with."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """Metrics and options of a measurement."""

    options: EvalOptions
    perceptual: PerceptualMetrics
    lpips: Lpips | None
    competitor: Competitor | None
    backend: Backend = EAGER

    def evaluated(self, counted: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "H W"] | None:
        """Returns the pixels that are evaluated, of those that a mask keeps; None: all."""
        return None if self.options.masks == "black" else counted


@dataclass(kw_only=True)
class Measured:
    """Figures of one method."""

    method: Method
    views: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Figures by view and zoom."""
    zooms: dict[float, list[ZoomFigures]] = field(default_factory=dict)
    """The same, for means."""
    cross: CrossViews | None = None
    """Consistency of neighbouring views; None: no depth is known."""

    def add(self, view: View, factor: float, found: ZoomFigures) -> None:
        """Adds the figures of a view at a zoom."""
        self.zooms.setdefault(factor, []).append(found)
        own = self.views.setdefault(view.name, {"group": view.group, "zoom": {}})
        perceptual = {name: pictures["render"] for name, pictures in found.perceptual.items() if "render" in pictures}
        own["zoom"][f"{factor:g}"] = {**found.figures, **perceptual}

    def means(self) -> dict[str, dict[str, Any]]:
        """Returns the means over views by zoom, as in evaluation.json."""
        consistency = {factor: self.cross.figures(factor) if self.cross else {} for factor in self.zooms}
        return {f"{zoom:g}": zoom_result(zoom, self.zooms[zoom]) | consistency[zoom] for zoom in sorted(self.zooms)}


Receive: TypeAlias = Callable[[Method, View, Zoomed], None]
"""Receiver of the pictures of a view at a zoom."""


class Measurement:
    """Measures methods on the test views of a scene, view by view, so that pictures need not be kept."""

    def __init__(self, scene: Scene, protocol: Protocol, methods: Sequence[Method], zooms: Sequence[float]) -> None:
        self.scene, self.protocol, self.zooms = scene, protocol, zooms
        self.found = [Measured(method=method, cross=self.cross_views(method)) for method in methods]

    def cross_views(self, method: Method) -> CrossViews | None:
        """Returns pairs of test views that show the same surfaces by the depth of a model; None: there is none."""
        if method.model is None:
            return None
        options = replace(self.protocol.options, zoom=list(self.zooms))
        return CrossViews(self.scene.test, (), options, method.model.surface, lambda view, factor: None)

    def run(self, receive: Receive, advance: Callable[[float, str], None]) -> list[Measured]:
        """Measures all pictures; `advance` receives the pixels of each, in units of an x1 picture, and its name."""
        for view in self.scene.test:
            for one in self.found:
                for factor, zoomed in self.pictures(one.method, view):
                    one.add(view, factor, self.figures(zoomed))
                    if one.cross and factor > 1:
                        one.cross.add(view, zoomed)
                    receive(one.method, view, zoomed)
                    advance(factor**2, f"{one.method.entry} {view.name} x{factor:g}")
        return self.found

    def work(self) -> float:
        """Returns the sum of the pixels of all pictures, in units of x1 pictures."""
        return sum(
            factor**2
            for one in self.found
            for view in self.scene.test
            for factor in self.zooms
            if one.method.camera(view, factor) is not None
        )

    def pictures(self, method: Method, view: View) -> Iterator[tuple[float, Zoomed]]:
        """Yields a method's pictures of a view with the truth of their size, by zoom."""
        first = self.picture(method, view, 1)
        for factor in self.zooms:
            if (zoomed := self.zoomed(method, view, factor, first)) is not None:
                yield factor, zoomed

    def picture(self, method: Method, view: View, factor: float) -> Picture | None:
        """Returns a method's picture as it is measured; None: there is none."""
        if method.camera(view, factor) is None:
            return None
        return self.protocol.options.measured(method.picture(view, factor))

    def zoomed(self, method: Method, view: View, factor: float, first: Picture | None) -> Zoomed | None:
        """Returns a method's picture of a view with its truth and rivals; None: there is no picture.

        first: its x1 picture, which the rivals enlarge; None: there are no rivals.
        """
        camera = method.camera(view, factor)
        image = first if factor == 1 else self.picture(method, view, factor)
        if camera is None or image is None:
            return None
        finer = replace(view, camera=camera)
        counted, truth, measured = finer.counted(), finer.image(), self.protocol.options.measured
        enlarged = None if first is None else black_out(measured(bicubic(first, *camera.size)), counted)
        zoomed = Zoomed(
            view=finer,
            factor=factor,
            truth=black_out(truth, counted),
            render=black_out(image, counted),
            enlarged=enlarged,
            counted=self.protocol.evaluated(counted),
        )
        if self.protocol.competitor is None or first is None or camera.size != view.camera.zoom(factor).size:
            return zoomed
        return self.protocol.competitor.join(zoomed, first, view, measured)

    def figures(self, zoomed: Zoomed) -> ZoomFigures:
        """Measures a picture: PSNR, SSIM by the protocol and by each variant, LPIPS, and its rivals at other zooms."""
        render, truth, counted = zoomed.render, zoomed.truth, zoomed.counted
        rivals = zoomed.pictures(RIVALS if zoomed.factor != 1 else ())
        similar, lpips = all_ssim(render, truth, counted, self.protocol.backend), self.protocol.lpips
        figures = {
            "psnr": psnr(render, truth, counted),
            "ssim": similar[self.protocol.options.ssim],
            **{f"ssim_{name}": value for name, value in similar.items()},
            **({} if lpips is None else {"lpips": lpips.distance(render, truth)}),
            **{f"{name}_psnr": psnr(picture, truth, counted) for name, picture in rivals.items()},
        }
        detailed = zoomed.factor != 1 and zoomed.view.counted() is None
        details = details_of({"render": render}, truth, zoomed.factor) if detailed else {}
        perceptual = self.protocol.perceptual.compare({"render": render, **rivals}, truth)
        return ZoomFigures(zoomed.view.group, figures, details, perceptual)


def own_truth_psnr(method: Method, scene: Scene) -> dict[str, float]:
    """Returns the mean PSNR of the photos that a program compared with, against the protocol's, by zoom, dB.

    It says how differently the program prepares photos. Empty: the program wrote none.
    """
    if not isinstance(method, PictureFolder):
        return {}

    def differences(factor: float) -> Iterator[float]:
        for view in scene.test:
            if placed := method.pictures[factor].get(view.name):
                photo, truth = placed.photo(scene.background), replace(view, camera=placed.camera)
                if photo is not None and photo.shape == truth.image().shape:
                    yield psnr(photo, truth.image(), truth.counted())

    found = {factor: list(differences(factor)) for factor in method.pictures}
    return {f"{factor:g}": statistics.fmean(values) for factor, values in found.items() if values}


def by_view(found: Mapping[str, Any], zoom: str, figure: str) -> dict[str, float]:
    """Returns a figure of each view that has it at a zoom."""
    return {name: view["zoom"][zoom][figure] for name, view in found.items() if figure in view["zoom"].get(zoom, {})}
