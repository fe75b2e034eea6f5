"""One candidate of the rasterizer at a time: drawn, checked against a float64 truth, timed, its memory."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.device import clock
from gsx.core.errors import GsxError, InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.reference import render_reference
from gsx.core.shapes import Float
from gsx.engine.compiled import takes
from gsx.engine.path import compiles
from gsx.experiments.runs.rasterizer_path import Learnt, compile_now
from gsx.experiments.trade.rasterizer.knobs import Row, Trial, gradient_error, image_errors, pooled_psnr
from gsx.experiments.trade.rasterizer.subject import Shot, Subject

EXACT: dict[str, Any] = {"path": "eager", "exponent": "direct", "evaluation": "float64", "accumulation": "float64"}
"""How the truth is computed; what it is, the rules of the base settings say."""
UNBOUNDED: dict[str, Any] = {"cull": "tight", "alpha_min": 1e-5, "transmittance_stop": 0.0, "tile_cap": 0}
"""Rules so loose that nothing visible is cut off: the ideal picture."""
CROP = 32
"""Edge of the picture on which the truth is compared with the untiled reference, px."""
CROP_SPLATS = 300
"""Splats in it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Drawn:
    """A picture and the gradient of a fixed linear function of it."""

    image: Float[Tensor, "C H W"]
    gradients: dict[str, Tensor]
    """By field of the splats."""
    pairs: int


@dataclass(frozen=True, kw_only=True)
class Check:
    """How far the truth is from the reference, which shares no code with it."""

    splats: int
    pixels: int
    image: float
    """Largest difference of a pixel."""
    gradient: float
    """Norm of the difference over norm, worst field."""

    def __str__(self) -> str:
        return (
            f"tiled float64 truth against the untiled reference on {self.splats} splats and {self.pixels:,} px: "
            f"image differs by at most {self.image:.1e}, gradient by {self.gradient:.1e}"
        )


@dataclass(frozen=True, kw_only=True)
class Times:
    """Seconds of one picture, mean over the shots."""

    forward: float
    """Without gradients."""
    step: float
    """Forward and backward."""
    peak_mb: float | None
    """Working memory of the latter, MB; None where the machine does not tell."""


def converted(splats: Splats, dtype: torch.dtype) -> Splats:
    """The same splats in another precision."""
    return Splats(**{name: value.to(dtype) for name, value in vars(splats).items()})


def draw(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings,
    background: Float[Tensor, "3"],
    weights: Float[Tensor, "3 H W"],
) -> Drawn:
    """Render, and take the gradient of the sum of weights times pixels."""
    leaves = {name: value.detach().requires_grad_() for name, value in vars(splats).items()}
    rendering = rasterize(Splats(**leaves), camera, settings, background=background)
    rendering.image.backward(weights.to(rendering.image))
    gradients = {name: leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for name, leaf in leaves.items()}
    return Drawn(image=rendering.image.detach(), gradients=gradients, pairs=rendering.intersections)


def random_weights(camera: Camera, seed: int) -> Float[Tensor, "3 H W"]:
    """Normal numbers: a gradient in which nothing cancels by symmetry."""
    return torch.randn(3, camera.height, camera.width, generator=torch.Generator().manual_seed(seed))


def window_of(shot: Shot) -> tuple[Camera, Splats]:
    """A small picture in the middle of what is seen, and splats on it."""
    positions, depths = shot.camera.project(shot.splats.means)
    width, height = shot.camera.size
    size = positions.new_tensor([width, height])
    seen = (depths > shot.camera.near) & ((positions >= 0) & (positions < size)).all(1)
    middle = positions[seen].median(0).values if bool(seen.any()) else size / 2
    left, top = (int(max(0, value - CROP // 2)) for value in middle.tolist())
    window = replace(shot.camera.crop(left, top, min(CROP, width), min(CROP, height)), cut_from=None)
    inside = (seen & ((positions - middle).abs() <= CROP / 2).all(1)).nonzero()[:, 0]
    chosen = inside[:: max(1, -(-len(inside) // CROP_SPLATS))]
    return window, Splats(**{name: value[chosen].cpu().double() for name, value in vars(shot.splats).items()})


def check_truth(shot: Shot, settings: RasterSettings) -> Check:
    """Compare the tiled float64 path with the reference on a small picture with few splats."""
    camera, splats = window_of(shot)
    weights = random_weights(camera, 0)
    drawn = draw(splats, camera, settings, torch.zeros(3), weights)
    leaves = {name: value.detach().requires_grad_() for name, value in vars(splats).items()}
    image, _, _ = render_reference(Splats(**leaves), camera, settings)
    image.backward(weights.double())
    gradients = {name: leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for name, leaf in leaves.items()}
    return Check(
        splats=len(splats),
        pixels=camera.width * camera.height,
        image=image_errors([drawn.image], [image.detach()])[0],
        gradient=gradient_error([drawn.gradients], [gradients], [splats.scales])[0],
    )


@dataclass(eq=False)
class Bench:
    """The shots of a subject with their truths, on which trials are measured."""

    subject: Subject
    base: RasterSettings
    weights: list[Tensor] = field(init=False)
    truths: list[Drawn] = field(init=False)
    ideals: list[Tensor] = field(init=False)
    """Empty: too many pairs to draw them."""

    def __post_init__(self) -> None:
        shots, seed = self.subject.shots, self.subject.seed
        self.weights = [random_weights(s.camera, seed + i).to(self.subject.device) for i, s in enumerate(shots)]
        exact = replace(self.base, **EXACT)
        self.truths = self.draw(exact, torch.float64)
        try:
            self.ideals = [self.render(shot, replace(exact, **UNBOUNDED), torch.float64) for shot in shots]
        except InputError:
            self.ideals = []

    def render(self, shot: Shot, settings: RasterSettings, dtype: torch.dtype) -> Float[Tensor, "3 H W"]:
        """A picture alone."""
        with torch.no_grad():
            splats, background = converted(shot.splats, dtype), self.subject.background
            return rasterize(splats, shot.camera, settings, background=background).image

    def draw(self, settings: RasterSettings, dtype: torch.dtype) -> list[Drawn]:
        """All shots with gradients."""
        background = self.subject.background
        return [
            draw(converted(shot.splats, dtype), shot.camera, settings, background, weights)
            for shot, weights in zip(self.subject.shots, self.weights, strict=True)
        ]

    def measured(self, trial: Trial) -> Row:
        """A row without times, or with the reason why there can be none."""
        row = Row(knob=trial.knob, changes=trial.changes)
        try:
            settings = replace(self.base, **trial.changes)
            if self.subject.device.type == "cpu" and compiles(settings, "cpu"):
                compile_now(settings, Learnt(), self.subject.device, helped=True)
            for shot in self.subject.shots:
                self.render(shot, settings, torch.float32)
            figures = self.figures(self.draw(settings, torch.float32))
            return replace(row, **figures, fell_back=fell_back(settings, self.subject.device))
        except Exception as error:  # whatever a compiler or a kernel throws is that row's result
            return replace(row, failure=reason(error))

    def figures(self, drawn: Sequence[Drawn]) -> dict[str, Any]:
        """Errors and sizes of pictures."""
        refuse_non_finite(drawn)
        images, truths = [d.image for d in drawn], [d.image for d in self.truths]
        scales = [shot.splats.scales.double() for shot in self.subject.shots]
        largest, most = image_errors(images, truths)
        gradient, name = gradient_error([d.gradients for d in drawn], [d.gradients for d in self.truths], scales)
        return {
            "max_error": largest,
            "most_error": most,
            "psnr": pooled_psnr(images, truths),
            "ideal_psnr": pooled_psnr(images, self.ideals) if self.ideals else float("nan"),
            "gradient_error": gradient,
            "gradient_field": name,
            "pairs": statistics.fmean(d.pairs for d in drawn),
        }

    def ideal_errors(self) -> dict[str, float] | None:
        """What the rules of the base settings themselves cost."""
        if not self.ideals:
            return None
        truths = [drawn.image for drawn in self.truths]
        largest, most = image_errors(truths, self.ideals)
        return {"max_error": largest, "most_error": most, "psnr": pooled_psnr(truths, self.ideals)}

    def times(self, settings: RasterSettings) -> Times:
        """One measurement over all shots."""
        shots, device = self.subject.shots, self.subject.device
        forward = stopwatch(lambda: [self.render(shot, settings, torch.float32) for shot in shots], device)
        peak = PeakMemory(device)
        step = stopwatch(lambda: self.draw(settings, torch.float32), device)
        return Times(forward=forward / len(shots), step=step / len(shots), peak_mb=peak.megabytes())


def fell_back(settings: RasterSettings, device: torch.device) -> bool:
    """Whether settings that ask for the compiled path are drawn by the eager one, which alone can do some things."""
    return settings.path == "compiled" and not takes(settings, 3, 1, False, device.type)


def refuse_non_finite(drawn: Sequence[Drawn]) -> None:
    """Raise InputError naming what holds values that are not finite."""
    for d in drawn:
        for name, value in {"the picture": d.image, **d.gradients}.items():
            count = int((~torch.isfinite(value)).sum())
            if count:
                what = name if name == "the picture" else f"the gradient of {name}"
                raise InputError(f"{count:,} of {value.numel():,} values of {what} are not finite")


def reason(error: Exception) -> str:
    """The first line of an error, with its type unless it is ours."""
    line = (str(error).strip().splitlines() or [""])[0][:300]
    return line if isinstance(error, GsxError) else f"{type(error).__name__}: {line}"


def stopwatch(action: Callable[[], object], device: torch.device) -> float:
    """Seconds an action takes, work queued on a GPU included."""
    begun = clock(device)
    action()
    return clock(device) - begun


class PeakMemory:
    """Peak of GPU memory allocated above what was there at the start; a CPU process does not tell it by part."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.before = device, 0
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
            self.before = torch.cuda.memory_allocated(device)

    def megabytes(self) -> float | None:
        """MB (1e6 bytes) since the start, or None."""
        if self.device.type != "cuda":
            return None
        return (torch.cuda.max_memory_allocated(self.device) - self.before) / 1e6
