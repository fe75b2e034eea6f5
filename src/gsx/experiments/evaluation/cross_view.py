"""Consistency of neighbouring views: does the detail of one lie where the other shows it?

A held-out view is warped into its neighbour by the model's depth. Detail on surfaces agrees in both pictures; detail
that is invented for each picture does not. A blurred picture agrees as well, so detail alone is also correlated.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.quality.metrics import decibel
from gsx.core.shapes import Float
from gsx.experiments.evaluation.chosen_views import evenly, neighbour
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.warp import Surface, places_in, warped
from gsx.experiments.evaluation.zoomed import Zoomed

COMPARED = ("render", "enlarged", "upscaled", "truth")
"""Pictures of a zoomed view whose consistency is measured."""
Zoom: TypeAlias = Callable[[View, float], Zoomed | None]
"""Returns a view at a zoom; None: it has no truth there."""
SurfaceOf: TypeAlias = Callable[[Zoomed], Surface]
"""Returns what is visible in a zoomed view, by the depth of a model."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceView:
    """A zoomed view's surface and its pictures."""

    surface: Surface
    stored: dict[str, Tensor]
    """Pictures by name (COMPARED), as bytes where they are quantised."""
    size: tuple[int, int]
    """(height, width) at the training resolution, px."""
    masked: bool = False
    """True: pictures are black where a mask is, and its border would be detail."""

    def picture(self, name: str) -> Float[Tensor, "3 H W"]:
        """Returns a picture."""
        stored = self.stored[name]
        return stored.float() / 255 if stored.dtype == torch.uint8 else stored


@dataclass(kw_only=True)
class Sums:
    """Sums over the compared pixels of one kind of picture."""

    pixels: int = 0
    squares: float = 0.0
    """Squared differences."""
    products: float = 0.0
    """Products of both pictures' detail."""
    powers: tuple[float, float] = (0.0, 0.0)
    """Squares of the detail, of the warped picture and of the other."""

    def add(self, one: Float[Tensor, "3 P"], other: Float[Tensor, "3 P"]) -> None:
        """Compares the colours of pixels by the warped picture and by the other."""
        self.squares += float((one - other).square().sum())
        self.pixels += one.shape[1]

    def add_detail(self, one: Float[Tensor, "3 P"], other: Float[Tensor, "3 P"]) -> None:
        """Compares the detail of pixels in both pictures."""
        self.products += float((one * other).sum())
        self.powers = self.powers[0] + float(one.square().sum()), self.powers[1] + float(other.square().sum())

    @property
    def psnr(self) -> float:
        """Returns the PSNR of one picture against the other, dB."""
        return decibel(self.squares / (3 * self.pixels))

    @property
    def correlation(self) -> float:
        """Returns the correlation of both pictures' detail; 0 without any."""
        power = math.sqrt(self.powers[0] * self.powers[1])
        return self.products / power if power > 0 else 0.0


def detail_layer(picture: Float[Tensor, "3 H W"], size: tuple[int, int]) -> Float[Tensor, "3 H W"]:
    """Returns what is lost of a picture if it is reduced to a (height, width) and enlarged again, both bicubic."""
    height, width = picture.shape[1:]
    return picture - resized(resized(picture, size), (height, width))


def resized(picture: Float[Tensor, "3 H W"], size: tuple[int, int]) -> Float[Tensor, "3 h w"]:
    """Resizes by antialiased cubic interpolation."""
    return torch.nn.functional.interpolate(picture[None], size=size, mode="bicubic", antialias=True)[0]


@dataclass(kw_only=True)
class Consistency:
    """Agreement of pairs of views at one zoom."""

    sums: dict[str, Sums] = field(default_factory=dict)
    """Sums by picture."""
    pixels: int = 0
    """Compared pixels."""
    total: int = 0
    """Pixels of the pictures that others are warped into."""
    detailed: bool = False
    """True: the detail of a pair was compared."""

    def add(self, source: SurfaceView, target: SurfaceView) -> None:
        """Warps the source's pictures into the target and compares them with its own."""
        indices, places = places_in(source.surface, target.surface)
        detailed = not (source.masked or target.masked)

        def matched(one: Float[Tensor, "3 H W"], other: Float[Tensor, "3 H W"]) -> tuple[Tensor, Tensor]:
            return warped(one, places), other.flatten(1)[:, indices].double()

        for name in target.stored.keys() & source.stored.keys():
            sums, pictures = self.sums.setdefault(name, Sums()), (source.picture(name), target.picture(name))
            sums.add(*matched(*pictures))
            if detailed:
                sums.add_detail(*matched(*(detail_layer(picture, target.size) for picture in pictures)))
        self.detailed |= detailed
        self.pixels += len(indices)
        self.total += target.surface.visible.numel()

    def figures(self) -> dict[str, object]:
        """Returns PSNR in dB and correlation of detail by picture, and the share of compared pixels; empty without.

        There is no detail if all pairs have a mask.
        """
        if not self.pixels:
            return {}
        known = {name: self.sums[name] for name in COMPARED if name in self.sums}
        whole = {name: sums for name, sums in known.items() if sums.pixels == self.pixels}
        levels: dict[str, object] = {name: sums.psnr for name, sums in whole.items()}
        detail = {name: sums.correlation for name, sums in whole.items()}
        return levels | {"pixels": self.pixels / self.total} | ({"detail": detail} if self.detailed else {})


class CrossViews:
    """Consistency of some held-out views with their neighbours at each zoom above 1.

    A held-out view that waits for its neighbour is kept; a neighbour of training is rendered when its turn has come.
    """

    def __init__(
        self, test: Sequence[View], train: Sequence[View], options: EvalOptions, surface: SurfaceOf, zoom: Zoom
    ) -> None:
        """Chooses pairs of held-out views with neighbours among them and the training views."""
        self.test, self.train = test, [] if options.right_halves else train  # whose right halves may be masked
        self.options, self.surface, self.zoom = options, surface, zoom
        self.pairs = {factor: self.choose(factor) for factor in options.zoom if factor > 1}
        """Pairs of (held-out view, neighbour) that are not compared yet, by zoom."""
        self.kept: dict[float, dict[View, SurfaceView]] = {factor: {} for factor in self.pairs}
        self.found = {factor: Consistency() for factor in self.pairs}

    def choose(self, factor: float) -> list[tuple[View, View]]:
        """Returns up to `eval.pairs` held-out views with their neighbours; all have a truth at that zoom."""
        test, train = ([v for v in views if v.zoom(factor) is not None] for views in (self.test, self.train))
        others = [*test, *train]
        chosen, cameras = evenly(test, self.options.pairs), [view.camera for view in others]
        near = [neighbour(view.camera, cameras) for view in chosen]
        return [(view, others[index]) for view, index in zip(chosen, near, strict=True) if index is not None]

    def add(self, view: View, zoomed: Zoomed) -> None:
        """Receives a held-out view; compares the pairs that are now complete."""
        pairs = self.pairs.get(zoomed.factor, [])
        if not any(view in pair for pair in pairs):
            return
        kept = self.kept[zoomed.factor]
        kept[view] = self.surface_view(zoomed, view)
        for one, other in [p for p in pairs if p[0] in kept and (p[1] in kept or p[1] not in self.test)]:
            self.found[zoomed.factor].add(kept[one], kept.get(other) or self.neighbour_view(other, zoomed.factor))
            pairs.remove((one, other))
        for done in kept.keys() - {one for pair in pairs for one in pair}:
            del kept[done]

    def neighbour_view(self, view: View, factor: float) -> SurfaceView:
        """Renders a training view."""
        zoomed = self.zoom(view, factor)
        assert zoomed is not None, "neighbours have a truth at that zoom"
        return self.surface_view(zoomed, view)

    def surface_view(self, zoomed: Zoomed, view: View) -> SurfaceView:
        """Returns a zoomed view with what is visible in it."""
        pictures: dict[str, Tensor] = zoomed.pictures(COMPARED)
        if self.options.quantise:
            pictures = {name: to_uint8(picture) for name, picture in pictures.items()}
        return SurfaceView(
            surface=self.surface(zoomed),
            stored=pictures,
            size=(view.camera.height, view.camera.width),
            masked=zoomed.view.counted() is not None,
        )

    def figures(self, factor: float) -> dict[str, dict[str, object]]:
        """Returns the entry `consistency` of a zoom; empty where nothing was compared."""
        figures = self.found[factor].figures() if factor in self.found else {}
        return {"consistency": figures} if figures else {}
