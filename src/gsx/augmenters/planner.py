"""Which pseudo views an event makes: cameras, windows, seeds."""

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass

import torch

from gsx.augmenters.cameras import centred_window, grid_window, moved, noise, random_window, window_size, worst_window
from gsx.augmenters.pseudo_options import PseudoOptions
from gsx.core.data.camera import Camera
from gsx.core.data.masks import blacked
from gsx.core.data.window import Window
from gsx.core.seeds import derived_seed
from gsx.core.training.render import render
from gsx.core.training.run import Run

MOST_TRIES = 10
"""Times that a place is drawn for a window until it shows enough of the scene (the paper, Cropped Upscaling)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PseudoViewSpec:
    """A pseudo view before its picture is drawn."""

    parent: int
    scale: int
    kind: str
    """base or random."""
    seen: Camera
    """What is redrawn, with context around it."""
    inside: Window
    """Of `seen`: what is kept."""
    outer: Window | None
    """Of the photograph, where `seen` is cut from it; None: it is rendered."""
    camera: Camera
    """Of the result."""
    seed: int


@dataclass(frozen=True, kw_only=True)
class Planner:
    """Draws cameras and windows beside training views; everything random comes from seed, event, view and scale."""

    name: str
    options: PseudoOptions
    seed: int
    extent: float
    """Of the scene, world units."""
    events: Sequence[int]
    """Steps at which pseudo views are made."""

    def specs(self, run: Run, event: int, parents: Set[int]) -> Iterator[PseudoViewSpec]:
        """Cameras of an event beside some training views, in the order of these, base before random."""
        options = self.options
        for parent in sorted(parents):
            if options.first_cameras and parent >= options.first_cameras:
                continue
            for scale in self.scales_of(event):
                variants = range(0 if options.base else 1, options.variants + 1)
                yield from (self.spec(run, event, parent, scale, variant) for variant in variants)

    def scales_of(self, event: int) -> list[int]:
        """All of them, or the one whose turn it is."""
        scales = list(self.options.scales)
        if not self.options.progressive:
            return scales
        return [scales[self.events.index(event) * len(scales) // len(self.events)]]

    def spec(self, run: Run, event: int, parent: int, scale: int, variant: int) -> PseudoViewSpec:
        """One camera; variant 0 is the training camera's own."""
        options, own = self.options, run.train_views[parent].camera
        generator = torch.Generator().manual_seed(derived_seed(self.seed, self.name, event, parent, scale, variant))
        zoom = scale if options.zoom == "intrinsics" else 1
        size = window_size(own.width, own.height, options.narrow, zoom)
        pose, window = self.looking(run, event, parent, scale, variant, size, generator)
        outer = window.grown(options.context, own.width, own.height)
        inside = Window(
            left=window.left - outer.left, top=window.top - outer.top, width=window.width, height=window.height
        )
        result = window.of(pose)
        seen = outer.of(pose)
        if zoom > 1:
            result = result.zoom(zoom)
        elif scale > 1:  # the other reading: fewer pixels are redrawn to as many
            inside, seen, result = reduced(window, pose, scale)
        return PseudoViewSpec(
            parent=parent,
            scale=scale,
            kind="base" if variant == 0 else "random",
            seen=seen,
            inside=inside,
            outer=outer if variant == 0 and options.base_source == "photo" and (zoom > 1 or scale == 1) else None,
            camera=result,
            seed=options.seed
            if options.seeds == "fixed"
            else derived_seed(self.seed, "noise", event, parent, scale, variant),
        )

    def looking(
        self,
        run: Run,
        event: int,
        parent: int,
        scale: int,
        variant: int,
        size: tuple[int, int],
        generator: torch.Generator,
    ) -> tuple[Camera, Window]:
        """(camera, window) of a pseudo view; of those drawn at random the first that shows enough of the scene."""
        own, options = run.train_views[parent].camera, self.options
        checked = options.least_alpha > 0 and (variant > 0 or (options.window == "random" and size != own.size))
        for _ in range(MOST_TRIES if checked else 1):
            pose = own if variant == 0 else self.beside(own, scale, generator)
            window = self.placed(run, parent, pose, size, event, variant, generator)
            if not checked or float(render(run, window.of(pose)).alpha.mean()) >= options.least_alpha:
                break
        return pose, window

    def beside(self, camera: Camera, scale: int, generator: torch.Generator) -> Camera:
        """A camera near a training camera."""
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

    def placed(
        self,
        run: Run,
        parent: int,
        pose: Camera,
        size: tuple[int, int],
        event: int,
        variant: int,
        generator: torch.Generator,
    ) -> Window:
        """Where the window lies on the raster (the paper, Cropped Upscaling)."""
        width, height = pose.size
        kind = self.options.window
        if kind == "random" or (kind == "error" and variant > 0):
            return random_window(width, height, size, generator)
        if kind == "grid":
            each, place = (1, 0) if variant == 0 else (self.options.variants, variant - 1)
            return grid_window(width, height, size, self.events.index(event) * each + place + parent)
        if kind == "error":
            view = run.train_views[parent]
            error = blacked(render(run, pose).image - view.image(), view.counted())
            return worst_window(error.abs().mean(0), size)
        return centred_window(width, height, size)


def reduced(window: Window, pose: Camera, scale: int) -> tuple[Window, Camera, Camera]:
    """(all of it, camera of 1/scale the density, camera of the result) for a window whose sides are made divisible."""
    width, height = max(1, window.width // scale), max(1, window.height // scale)
    whole = Window(left=window.left, top=window.top, width=width * scale, height=height * scale).of(pose)
    return Window(left=0, top=0, width=width, height=height), whole.resize(width, height), whole
