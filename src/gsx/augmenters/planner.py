"""Plans of pseudo views at an event: cameras, windows, seeds."""

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from typing import NamedTuple

import torch

from gsx.augmenters.cameras import centred_window, grid_window, moved, noise, random_window, worst_window
from gsx.augmenters.pseudo_options import PseudoOptions
from gsx.core.data.camera import Camera
from gsx.core.data.masks import black_out
from gsx.core.data.window import Window
from gsx.core.seeds import derived_seed
from gsx.core.training.render import render
from gsx.core.training.run import Run

MOST_TRIES = 10
"""Most draws of a window until enough of the scene is in it (the paper, Cropped Upscaling)."""


class Slot(NamedTuple):
    """Place of a pseudo view in an event."""

    event: int
    parent: int
    scale: int
    variant: int
    """0: the training camera; others: randomly moved cameras."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PseudoViewSpec:
    """A pseudo view before its picture is redrawn."""

    parent: int
    scale: int
    kind: str
    """base or random."""
    source: Camera
    """Camera of the input, with context around it."""
    inside: Window
    """Part of the source without context."""
    outer: Window | None
    """Source as a window of the photo; None: it is rendered."""
    camera: Camera
    """Camera of the result."""
    seed: int


@dataclass(frozen=True, kw_only=True)
class Planner:
    """Random cameras and windows near training views, by seed, event, view and scale."""

    name: str
    options: PseudoOptions
    seed: int
    extent: float
    """Extent of the scene, world units."""
    events: Sequence[int]
    """Steps with new pseudo views."""

    def specs(self, run: Run, event: int, parents: Set[int]) -> Iterator[PseudoViewSpec]:
        """Plans the pseudo views of some training views at an event, by view, scale, and base before random."""
        options = self.options
        for parent in sorted(parents):
            if options.first_cameras and parent >= options.first_cameras:
                continue
            for scale in self.scales_of(event):
                variants = range(0 if options.base else 1, options.variants + 1)
                yield from (self.spec(run, Slot(event, parent, scale, variant)) for variant in variants)

    def scales_of(self, event: int) -> list[int]:
        """Returns the scales of an event: all, or one of them if progressive."""
        scales = list(self.options.scales)
        if not self.options.progressive:
            return scales
        return [scales[self.events.index(event) * len(scales) // len(self.events)]]

    def spec(self, run: Run, slot: Slot) -> PseudoViewSpec:
        """Plans one pseudo view."""
        options, camera, scale = self.options, run.train_views[slot.parent].camera, slot.scale
        generator = torch.Generator().manual_seed(derived_seed(self.seed, self.name, *slot))
        zoom = scale if options.zoom == "intrinsics" else 1
        size = options.window_size(camera, zoom)
        pose, window = self.pose_and_window(run, slot, size, generator)
        outer = window.grown(options.context, camera.width, camera.height)
        inside = Window(
            left=window.left - outer.left, top=window.top - outer.top, width=window.width, height=window.height
        )
        result, source = window.of(pose), outer.of(pose)
        if zoom > 1:
            result = result.zoom(zoom)
        elif scale > 1:  # the other reading of the paper: reduced pixels are redrawn at full density
            inside, source, result = reduced(window, pose, scale)
        photo = slot.variant == 0 and options.base_source == "photo" and (zoom > 1 or scale == 1)
        return PseudoViewSpec(
            parent=slot.parent,
            scale=scale,
            kind="random" if slot.variant else "base",
            source=source,
            inside=inside,
            outer=outer if photo else None,
            camera=result,
            seed=options.seed if options.seeds == "fixed" else derived_seed(self.seed, "noise", *slot),
        )

    def pose_and_window(
        self, run: Run, slot: Slot, size: tuple[int, int], generator: torch.Generator
    ) -> tuple[Camera, Window]:
        """Draws pose and window of a pseudo view; random ones until they show enough of the scene."""
        camera, options = run.train_views[slot.parent].camera, self.options
        checked = options.least_alpha > 0 and (slot.variant > 0 or (options.window == "random" and size != camera.size))
        for _ in range(MOST_TRIES if checked else 1):
            pose = camera if slot.variant == 0 else self.perturbed(camera, slot.scale, generator)
            window = self.window_in(run, slot, pose, size, generator)
            if not checked or float(render(run, window.of(pose)).alpha.mean()) >= options.least_alpha:
                break
        return pose, window

    def perturbed(self, camera: Camera, scale: int, generator: torch.Generator) -> Camera:
        """Moves a training camera at random."""
        options = self.options
        turn = options.rotation_noise
        if options.relative_noise:
            turn *= min(1.0, 2 * options.narrow / scale)
        unit = self.extent if options.translation_unit == "extent" else 1.0
        return moved(
            camera,
            noise((3, 3), options.noise, turn, generator),
            noise((3,), options.noise, options.translation_noise * unit, generator),
            options.kept,
        )

    def window_in(
        self, run: Run, slot: Slot, pose: Camera, size: tuple[int, int], generator: torch.Generator
    ) -> Window:
        """Returns the window on the raster (the paper, Cropped Upscaling)."""
        width, height = pose.size
        kind, variant = self.options.window, slot.variant
        if kind == "random" or (kind == "error" and variant > 0):
            return random_window(width, height, size, generator)
        if kind == "grid":
            each, place = (1, 0) if variant == 0 else (self.options.variants, variant - 1)
            return grid_window(width, height, size, self.events.index(slot.event) * each + place + slot.parent)
        if kind == "error":
            view = run.train_views[slot.parent]
            error = black_out(render(run, pose).image - view.image(), view.counted())
            return worst_window(error.abs().mean(0), size)
        return centred_window(width, height, size)


def reduced(window: Window, pose: Camera, scale: int) -> tuple[Window, Camera, Camera]:
    """Returns (whole reduced window, camera at 1/scale of the density, camera of the result) with divisible sides."""
    width, height = max(1, window.width // scale), max(1, window.height // scale)
    whole = Window(left=window.left, top=window.top, width=width * scale, height=height * scale).of(pose)
    return Window(left=0, top=0, width=width, height=height), whole.resize(width, height), whole
