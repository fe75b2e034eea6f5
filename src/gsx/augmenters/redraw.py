"""Pictures of pseudo views: requests, redrawing and pixel weights (the paper, Practical Implementation).

`exactly_consistent` makes 8-bit pictures that reduce exactly to their input: the paper's interpolation flexibility,
guaranteed for box averages.
"""

import hashlib
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.augmenters.checked_regenerator import CheckedRegenerator
from gsx.augmenters.pixel_weights import WeightMap, agreeing, in_bytes
from gsx.augmenters.planner import PseudoViewSpec, reduced
from gsx.augmenters.pseudo_options import PseudoOptions, ramp
from gsx.augmenters.store import picture_name
from gsx.core.data.camera import Camera
from gsx.core.data.images import write_image
from gsx.core.data.masks import where_counted
from gsx.core.data.reduction import Reduction, as_blocks, projected
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.shapes import Bool, Float, Int, UInt8
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.regenerator import Request
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.core.training.schedule import Schedule

logger = logging.getLogger(__name__)

BATCH, BATCH_PIXELS = 64, 16_000_000
"""Most pictures redrawn per line of progress, and pixels of their results, if they are several: for memory."""
PICTURED = 3
"""Training views of an event with comparison pictures."""
BOX = Reduction()
REPAIRS = 50
"""Most rounds that spread rounding errors back, for overlapping blocks."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Redrawer:
    """Pictures of pseudo views by a checked regenerator, with pixel weights."""

    name: str
    options: PseudoOptions
    regenerator: CheckedRegenerator
    schedule: Schedule
    weight_map: WeightMap | None
    """None: all pixels count."""

    def redraw_all(self, run: Run, event: int, specs: Sequence[PseudoViewSpec]) -> list[PseudoView]:
        """Makes the planned pseudo views, except those with dropped pictures, and logs each batch."""
        views: list[PseudoView] = []
        pictured = sorted({spec.parent for spec in specs})[:PICTURED]
        done = 0
        for batch in batches(specs):
            views += self.redraw_batch(run, event, batch, pictured)
            done += len(batch)
            logger.info("%s at step %d: %d of %d pictures", self.name, event, done, len(specs))
        return views

    def redraw_batch(
        self, run: Run, event: int, specs: Sequence[PseudoViewSpec], pictured: Sequence[int]
    ) -> list[PseudoView]:
        """Makes some pseudo views, and writes comparison pictures for the training views `pictured`."""
        views = []
        requests = [self.request(run, event, spec) for spec in specs]
        run.raise_if_stopping()
        options = self.options
        redrawn = self.regenerator.redraw(requests, samples=options.samples, project=options.project == "exact")
        for spec, request, one in zip(specs, requests, redrawn, strict=True):
            if one.image is not None:
                view = self.view(run, event, spec, request, one.image)
                views.append(view)
                if spec.parent in pictured:
                    self.write_comparison(run.folder / "pseudo", spec, request, view)
        return views

    def request(self, run: Run, event: int, spec: PseudoViewSpec) -> Request:
        """Returns the request for a planned pseudo view."""
        run.raise_if_stopping()
        view = run.train_views[spec.parent]
        outer = spec.outer
        image = render(run, spec.source).image if outer is None else photo_window(run, view, outer, spec.source)
        return Request(
            image=image,
            scale=spec.scale,
            reduction=run.scene.reduction,
            camera=spec.source,
            view=view,
            number=spec.parent,
            photo=outer is not None,
            seed=spec.seed,
            strength=ramp(self.options.strength, event, self.options.timing, self.schedule),
            strongest=max(self.options.strength),
            prompt=self.options.prompt.replace("{scene}", run.scene.name),
            step=event,
        )

    def view(
        self, run: Run, event: int, spec: PseudoViewSpec, request: Request, result: Float[Tensor, "3 H W"]
    ) -> PseudoView:
        """Makes the pseudo view of a result: its window in 8 bits."""
        a, inside, reduction = spec.scale, spec.inside, request.reduction
        enlarged = request.photo and a > 1
        target, low = to_uint8(result.clamp(0, 1)), to_uint8(request.image)
        if self.options.project == "exact" and enlarged:
            target = exactly_consistent(result, low, a, reduction)
        window = Window(left=a * inside.left, top=a * inside.top, width=a * inside.width, height=a * inside.height)
        kept = window.cut(target).contiguous()
        shares = {}
        if enlarged:
            same = consistent_pixels(target, low, a, reduction)
            shares = {"consistent": float(inside.cut(same[None].float()).mean())}
        known = enlarged and self.options.coarse_weight > 0
        return PseudoView(
            camera=spec.camera,
            target=kept,
            parent=spec.parent,
            pixel_weight=self.pixel_weight(run, spec, request, target.float() / 255, window),
            coarse=to_uint8(inside.cut(request.image)).contiguous() if known else None,
            coarse_weight=self.options.coarse_weight if known else 0.0,
            reduction=reduction,
            provenance=provenance(
                run, event, request.view, kept, spec.kind, a, request.photo,
                seed=request.seed, strength=request.strength, **shares,
            ),
        )  # fmt: skip

    def coarser_view(self, run: Run, event: int, parent: int, factor: int) -> PseudoView:
        """Makes the pseudo view of a reduced training camera, without partial blocks at the rim."""
        run.raise_if_stopping()
        view = run.train_views[parent]
        width, height = view.camera.size
        whole = Window(left=0, top=0, width=width, height=height)
        _, camera, covered = reduced(whole, view.camera, factor)
        photo = self.options.base_source == "photo"
        picture = photo_window(run, view, whole, view.camera) if photo else render(run, view.camera).image
        reduction = run.scene.reduction if photo else Reduction()  # Mipmap-GS: bilinear, which is the mean of four
        target = to_uint8(reduction.reduce(Window(0, 0, *covered.size).cut(picture), factor))
        facts = provenance(run, event, view, target, "coarser", 1 / factor, photo)
        return PseudoView(camera=camera, target=target, parent=parent, provenance=facts)

    def pixel_weight(
        self, run: Run, spec: PseudoViewSpec, request: Request, result: Float[Tensor, "3 H W"], window: Window
    ) -> UInt8[Tensor, "h w"] | None:
        """Returns pixel weights of a window of the result, 0 where the photo is masked; None: all are 1."""
        options, pixel_weight = self.options, torch.ones(window.height, window.width)
        if self.weight_map is not None:
            photographs = [view.camera for view in run.train_views]
            draw = partial(run.backbone.draw, step=run.model_step)
            weights = self.weight_map(draw, spec.camera, photographs, spec.parent, run.raster)
            pixel_weight = pixel_weight * weights.cpu()
        if options.gate > 0 and request.photo and spec.scale > 1:
            agreed = agreeing(result, request.image, spec.scale, request.reduction, options.gate)
            pixel_weight = pixel_weight * window.cut(agreed[None])[0]
        if request.photo and (counted := request.view.counted()) is not None and spec.outer is not None:
            inside = spec.inside.cut(spec.outer.cut(counted[None].float()))
            pixel_weight = pixel_weight * as_blocks(inside[0], spec.scale)
        return None if bool((pixel_weight == 1).all()) else in_bytes(pixel_weight)

    def write_comparison(self, folder: Path, spec: PseudoViewSpec, request: Request, view: PseudoView) -> None:
        """Writes a picture of the enlarged input, the result, and their difference."""
        source = as_blocks(spec.inside.cut(request.image), spec.scale)
        result = view.target.float() / 255
        difference = (0.5 + 4 * (result - source)).clamp(0, 1)
        folder.mkdir(parents=True, exist_ok=True)
        write_image(folder / picture_name(self.name, view), torch.cat([source, result, difference], 2))


def batches(specs: Sequence[PseudoViewSpec]) -> Iterator[list[PseudoViewSpec]]:
    """Divides pictures into batches of at most BATCH and BATCH_PIXELS, in order."""
    batch, pixels = list[PseudoViewSpec](), 0
    for spec in specs:
        size = math.prod(spec.source.size) * spec.scale**2
        if batch and (len(batch) == BATCH or pixels + size > BATCH_PIXELS):
            yield batch
            batch, pixels = [], 0
        batch.append(spec)
        pixels += size
    if batch:
        yield batch


def provenance(
    run: Run,
    event: int,
    view: View,
    target: UInt8[Tensor, "3 h w"],
    kind: str,
    scale: float,
    photo: bool,
    **more: float,
) -> dict[str, Any]:
    """Returns the origin of a pseudo view, for its file."""
    return {
        "event": event,
        "made_after_step": run.step,
        "view": view.name,
        "kind": kind,
        "scale": scale,
        "source": "photo" if photo else "render",
        **more,
        "sha256": hashlib.sha256(target.numpy().tobytes()).hexdigest(),
    }


def photo_window(run: Run, view: View, window: Window, camera: Camera) -> Float[Tensor, "3 h w"]:
    """Cuts a window out of a photo; a render by the window's camera replaces masked pixels."""
    photo, counted = window.cut(view.image()), view.counted()
    return photo if counted is None else where_counted(photo, render(run, camera).image.cpu(), counted[window.pixels])


def exactly_consistent(
    image: Float[Tensor, "3 H W"], low: UInt8[Tensor, "3 h w"], factor: int, reduction: Reduction
) -> UInt8[Tensor, "3 H W"]:
    """Returns the 8-bit picture near `image` that reduces to `low`: exactly for box averages, else in nearly all
    pixels."""
    near = projected(image.float(), low.float() / 255, factor, reduction)
    return repaired(near, low, factor) if reduction == BOX else settled(near, low, factor, reduction)


def settled(
    near: Float[Tensor, "3 H W"], low: UInt8[Tensor, "3 h w"], factor: int, reduction: Reduction
) -> UInt8[Tensor, "3 H W"]:
    """Rounds a picture, and spreads remaining differences from `low` over its pixels."""
    known = low.float() / 255
    for _ in range(REPAIRS):
        off = known - reduction.reduce(to_uint8(near).float() / 255, factor)
        wrong = torch.where(off.abs() * 255 > 0.5, off, 0)
        if not bool(wrong.any()):
            break
        near = near + factor**2 * reduction.adjoint(wrong, factor)
    return to_uint8(near)


def repaired(near: Float[Tensor, "3 H W"], low: UInt8[Tensor, "3 h w"], factor: int) -> UInt8[Tensor, "3 H W"]:
    """Rounds such that a^2 (low - 1/2) <= sum of each block < a^2 (low + 1/2), at the least cost.

    Moves values by one level at a time, first those that rounding moved most the other way.
    """
    values = blocks(to_uint8(near).long(), factor)
    exact = blocks(near * 255, factor)
    area = factor * factor
    lowest = -(-(2 * low.long() - 1) * area // 2).flatten()
    highest = ((2 * low.long() + 1) * area - 1).div(2, rounding_mode="floor").flatten()
    while True:
        sums = values.sum(1)
        step = (sums < lowest).long() - (sums > highest).long()
        if not bool(step.any()):
            return unblocked(values, low.shape, factor).to(torch.uint8)
        values = values + moves(values, exact, step)


def moves(values: Int[Tensor, "B a"], exact: Float[Tensor, "B a"], step: Int[Tensor, "B"]) -> Int[Tensor, "B a"]:
    """Returns one level more or less for the value of least cost in each block, within 0..255."""
    gain = (exact - values) * step[:, None]
    allowed = ((values + step[:, None]) >= 0) & ((values + step[:, None]) <= 255)
    chosen = torch.where(allowed, gain, -torch.inf).argmax(1)
    return torch.zeros_like(values).scatter_(1, chosen[:, None], step[:, None])


def blocks(image: Tensor, factor: int) -> Tensor:
    """Returns the pixels of each block, [3 h w, a^2]."""
    parts = image.unfold(1, factor, factor).unfold(2, factor, factor)
    return parts.reshape(-1, factor * factor)


def unblocked(values: Int[Tensor, "B a"], shape: torch.Size, factor: int) -> Int[Tensor, "3 H W"]:
    """Returns the image of `blocks`; `shape`: of the box average."""
    channels, height, width = shape
    parts = values.view(channels, height, width, factor, factor).permute(0, 1, 3, 2, 4)
    return parts.reshape(channels, height * factor, width * factor)


def consistent_pixels(
    image: UInt8[Tensor, "3 H W"], low: UInt8[Tensor, "3 h w"], factor: int, reduction: Reduction
) -> Bool[Tensor, "h w"]:
    """Marks pixels of `low` that the image reduces to in 8 bits, in all channels."""
    if reduction == BOX:
        sums = blocks(image.long(), factor).sum(1).view(low.shape)
        back = ((2 * sums + factor * factor) // (2 * factor * factor)).to(torch.uint8)
    else:
        back = to_uint8(reduction.reduce(image.float() / 255, factor))
    return (back == low).all(0)
