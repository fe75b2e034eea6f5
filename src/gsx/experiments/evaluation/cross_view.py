"""Consistency of neighbouring held-out views: does the detail of one lie where the other shows it?

A view is warped into its neighbour by the model's depth. Real detail lies on surfaces, so both pictures agree; detail
that is invented for each picture does not. A blurred picture agrees as well: read it with the explained detail.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsx.core.data.resize import to_uint8
from gsx.core.quality.metrics import decibel
from gsx.core.shapes import Float, UInt8
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.chosen_views import neighbours
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluated_renders import EvaluatedRenders
from gsx.experiments.evaluation.warp import Surface, places_in, surface_of, warped
from gsx.experiments.evaluation.zoomed import Zoomed

COMPARED = ("render", "enlarged", "upscaled", "truth")
"""Pictures of a zoomed view whose consistency is measured."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceView:
    """A zoomed view's surface and its pictures."""

    surface: Surface
    pictures: dict[str, UInt8[Tensor, "3 H W"] | Float[Tensor, "3 H W"]]
    """Pictures by name (COMPARED), as bytes where they are quantised."""

    def picture(self, name: str) -> Float[Tensor, "3 H W"]:
        """Returns a picture, float64."""
        picture = self.pictures[name]
        return picture.double() / 255 if picture.dtype == torch.uint8 else picture.double()


@dataclass(kw_only=True)
class Differences:
    """Sums over pairs of views."""

    squares: dict[str, float] = field(default_factory=dict)
    """Sum of squared differences over pixels and channels, by picture."""
    counts: dict[str, int] = field(default_factory=dict)
    """Pixels with that picture in both views."""
    pixels: int = 0
    """Compared pixels."""
    total: int = 0
    """Pixels of the pictures that others are warped into."""

    def add(self, source: SurfaceView, target: SurfaceView) -> None:
        """Warps the source's pictures into the target and compares them with its own."""
        indices, places = places_in(source.surface, target.surface)
        for name in target.pictures.keys() & source.pictures.keys():
            own = target.picture(name).flatten(1)[:, indices]
            square = float((warped(source.picture(name), places) - own).square().sum())
            self.squares[name] = self.squares.get(name, 0.0) + square
            self.counts[name] = self.counts.get(name, 0) + len(indices)
        self.pixels += len(indices)
        self.total += target.surface.visible.numel()

    def figures(self) -> dict[str, float]:
        """Returns PSNR by picture, dB, and the share of compared pixels; empty without any."""
        if not self.pixels:
            return {}
        whole = [name for name in COMPARED if self.counts.get(name) == self.pixels]
        levels = {name: decibel(self.squares[name] / (3 * self.pixels)) for name in whole}
        return levels | {"pixels": self.pixels / self.total}


class CrossViews:
    """Pairs of neighbouring views at each zoom; keeps the pictures of a view until its pairs are compared."""

    def __init__(self, run: Run, options: EvalOptions, renders: EvaluatedRenders) -> None:
        self.run, self.options, self.renders = run, options, renders
        self.pairs = {factor: self.choose(factor) for factor in options.zoom if factor > 1}
        """Pairs that wait for a picture, by zoom."""
        self.kept: dict[float, dict[int, SurfaceView]] = {factor: {} for factor in self.pairs}
        self.differences = {factor: Differences() for factor in self.pairs}

    def choose(self, factor: float) -> list[tuple[int, int]]:
        """Returns up to `eval.pairs` pairs of test views with a truth at a zoom."""
        test = self.run.scene.test
        known = [number for number, view in enumerate(test) if view.zoom(factor) is not None]
        pairs = neighbours([self.renders.camera(test[number]) for number in known], self.options.pairs)
        return [(known[one], known[other]) for one, other in pairs]

    def add(self, number: int, zoomed: Zoomed) -> None:
        """Receives a view; compares the pairs that are now complete."""
        pairs, kept = self.pairs.get(zoomed.factor, []), self.kept.get(zoomed.factor, {})
        if not any(number in pair for pair in pairs):
            return
        kept[number] = self.surface_view(zoomed)
        for pair in [pair for pair in pairs if kept.keys() >= {*pair}]:
            self.differences[zoomed.factor].add(*(kept[one] for one in pair))
            pairs.remove(pair)
        for done in kept.keys() - {one for pair in pairs for one in pair}:
            del kept[done]

    def surface_view(self, zoomed: Zoomed) -> SurfaceView:
        """Renders the depth of a zoomed view."""
        camera = self.renders.camera(zoomed.view)
        tiled = render(self.run, camera, self.options.tile_pixels, supersample=1, depth=True)
        assert tiled.depth is not None
        pictures = zoomed.pictures(COMPARED)
        if self.options.quantise:
            pictures = {name: to_uint8(picture) for name, picture in pictures.items()}
        surface = surface_of(camera, tiled.depth, tiled.alpha, zoomed.counted)
        return SurfaceView(surface=surface, pictures=pictures)

    def figures(self, factor: float) -> dict[str, dict[str, float]]:
        """Returns the entry `consistency` of a zoom; empty where nothing was compared."""
        found = self.differences[factor].figures() if factor in self.differences else {}
        return {"consistency": found} if found else {}
