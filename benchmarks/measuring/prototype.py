"""The rasterizer against the prototype of its formulation, on the same screen splats in the same process.

The prototype is a Python file that is not part of gsx. It offers `random_splats(n)`, `Prototype(splats, tile)` with
`pair`, `gather`, `forward` and `backward`, and `measure(n, tile, repeats)`.
"""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.errors import InputError
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.projection import ScreenSplats
from gsx.core.shapes import Float
from measuring.adapter import blend_screen, count_pairs, learnable, settings_of, to_raster, to_tiles
from measuring.bench import Bench, Row, section
from measuring.cases import blending
from measuring.results import Section
from measuring.watches import Job, Timing, Watch, take_turns

TILE = 8
AGREEMENT = 1e-4
"""Largest difference between two pictures, where no alpha lies at the cut-off to within rounding."""
STRAY = 1e-4
"""Fraction of pixels at which one may lie there: then the pictures differ by up to alpha_min."""


def load_prototype(path: Path) -> ModuleType:
    """The prototype as a module.

    Raises:
        InputError: the file is not there or does not offer what is needed.
    """
    spec = importlib.util.spec_from_file_location("prototype_file", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"--prototype {path} is no Python file: give the prototype's composite.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in ("measure", "random_splats", "Prototype", "W", "H"):
        if not hasattr(module, name):
            raise InputError(f"--prototype {path} has no '{name}': give the prototype's composite.py")
    return module


def factors_of(covariances: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
    """(u0, u1, u2) with U^T U half the inverse of the covariance (xx, xy, yy)."""
    xx, xy, yy = covariances.unbind(1)
    determinant = xx * yy - xy * xy
    return torch.stack([(yy / (2 * determinant)).sqrt(), -xy / (2 * determinant * yy).sqrt(), (2 * yy).rsqrt()], 1)


def screen_of(
    means: Float[Tensor, "M 2"],
    covariances: Float[Tensor, "M 3"],
    opacities: Float[Tensor, "M"],
    colours: Float[Tensor, "M 3"],
    depths: Float[Tensor, "M"],
) -> tuple[ScreenSplats, Tensor]:
    """The prototype's splats as the rasterizer's, nearest first, and the row that each had."""
    order = torch.argsort(depths, stable=True)
    screen = ScreenSplats(
        ids=torch.arange(len(order)),
        means=means[order],
        depths=depths[order],
        covariances=covariances[order],
        conic_factors=factors_of(covariances)[order],
        log_opacities=opacities[order].log(),
        channels=colours[order],
        dropped=0,
    )
    return screen, order


def flat_camera(width: int, height: int) -> Camera:
    """A camera for splats that are on the screen already: only its raster counts."""
    turn, shift = torch.eye(3), torch.zeros(3)
    x, y = width / 2, height / 2
    return Camera(rotation=turn, translation=shift, fx=1.0, fy=1.0, cx=x, cy=y, width=width, height=height)


def drawn_by(prototype: Any, gradient: Float[Tensor, "T P 3"]) -> Job:
    """A job of the prototype's four phases."""

    def job(watch: Watch) -> None:
        watch.begin()
        for phase in ("pair", "gather", "forward"):
            getattr(prototype, phase)()
            watch.lap(phase)
        prototype.backward(gradient)
        watch.lap("backward")

    return job


class Unwatched:
    """A watch for warming up."""

    def begin(self) -> None:
        pass

    def lap(self, phase: str) -> None:
        pass


def warm_up(module: ModuleType, splats: Any, gradient: Float[Tensor, "T P 3"]) -> Any:
    """The prototype, compiled under the compiler options that it sets; the process gets its own options back."""
    import torch._inductor.config as inductor

    with inductor.patch(max_fusion_size=inductor.max_fusion_size):
        prototype = module.Prototype(splats, TILE)
        for _ in range(2):
            drawn_by(prototype, gradient)(Unwatched())
    return prototype


def differences(
    screen: ScreenSplats, order: Tensor, settings: RasterSettings, prototype: Any, gradient: Float[Tensor, "3 H W"]
) -> Row:
    """How a path's picture and colour gradient differ from the prototype's.

    Where its transmittance stays above the stop value both blend the same splats; elsewhere the prototype goes on
    until a whole batch has ended, and both may differ by the light that is left.
    """
    camera = flat_camera(gradient.shape[2], gradient.shape[1])
    screen = learnable(screen)
    image, _ = blend_screen(screen, camera, settings)
    by_colour = torch.autograd.grad(image, screen.channels, gradient)[0]
    error = (image.detach() - to_raster(prototype.image, camera, TILE)).abs().amax(0)
    going = to_raster(prototype.T[..., None], camera, TILE)[0] >= 1.01 * settings.transmittance_stop
    _, by_pair = prototype.backward(to_tiles(gradient, camera, TILE))
    truth = torch.zeros_like(by_colour).index_add_(0, prototype.splat, by_pair[: len(prototype.splat)])[order]
    return {
        "stray": int((error[going] > AGREEMENT).sum()),
        "going": float(going.float().mean()),
        "error": largest(error[going & (error <= AGREEMENT)]),
        "stray_error": largest(error[going]),
        "stopped_error": largest(error[~going]),
        "gradient_error": float((by_colour - truth).norm() / truth.norm()),
    }


def largest(values: Float[Tensor, "E"]) -> float:
    """The largest value, 0 of none."""
    return float(values.max()) if len(values) else 0.0


def refuse_disagreement(path: str, found: Row, settings: RasterSettings, pixels: int) -> None:
    """Raise InputError where two pictures are not the same: then their times must not be compared."""
    if found["stray"] > STRAY * pixels or found["stray_error"] > 1.5 * settings.alpha_min:
        raise InputError(
            f"the {path} path and the prototype draw different pictures: {found['stray']} of {pixels} pixels differ by "
            f"more than {AGREEMENT:g}, at worst by {found['stray_error']:.2g}"
        )


def prototype_section(bench: Bench) -> Section:
    """Pairing, forward and backward of the prototype and of each path, in turn.

    Raises:
        InputError: there is no prototype, or the pictures differ.
    """
    if bench.prototype is None:
        raise InputError("the section 'prototype' needs --prototype FILE, the prototype's composite.py")
    if bench.device.type != "cpu":
        raise InputError("the prototype works on a CPU only: give --device cpu, or leave the section 'prototype' out")
    module = load_prototype(bench.prototype)
    splats = module.random_splats(bench.pick(100_000, 500))
    camera = flat_camera(module.W, module.H)
    draw = torch.Generator().manual_seed(1)
    gradient = torch.rand(3, camera.height, camera.width, generator=draw)
    tiled = to_tiles(gradient, camera, TILE)
    prototype = warm_up(module, splats, tiled)
    screen, order = screen_of(*splats)
    rules = {path: settings_of(path, "rasterizer.cull=tight", f"rasterizer.tile_size={TILE}") for path in bench.paths}
    agreement = {path: differences(screen, order, rules[path], prototype, gradient) for path in bench.paths}
    for path, found in agreement.items():
        refuse_disagreement(path, found, rules[path], camera.width * camera.height)
    jobs = {path: blending(screen, camera, settings, gradient) for path, settings in rules.items()}
    timings = take_turns({"prototype": drawn_by(prototype, tiled), **jobs}, bench.device, bench.patience)
    pairs = {path: count_pairs(blend_screen(screen, camera, rules[path])[1]) for path in bench.paths}
    rows = prototype_rows(timings, pairs | {"prototype": len(prototype.splat)})
    own = module.measure(len(screen.ids), TILE, bench.pick(5, 1))
    return section(
        bench,
        "Prototype",
        PROTOTYPE_COLUMNS,
        rows,
        f"{len(screen.ids):,} random screen splats, {camera.width}x{camera.height}, {TILE} px tiles, the same for all, "
        f"in turn; no projection. The prototype's own measure() afterwards, alone: {own['total']:.0f} ms.",
        *[agreement_note(path, found) for path, found in agreement.items()],
    )


PROTOTYPE_COLUMNS = [
    ["path", "path"],
    ["pairs", "pairs"],
    ["pair_ms", "pair ms"],
    ["gather_ms", "gather ms"],
    ["forward_ms", "forward ms"],
    ["backward_ms", "backward ms"],
    ["total_ms", "all ms"],
    ["forward_rate", "forward M eval/s"],
    ["share", "of the prototype"],
    ["eager_ratio", "eager / this"],
    ["eager_blend_ratio", "without pairing"],
]


def prototype_rows(timings: dict[str, Timing], pairs: dict[str, int]) -> list[Row]:
    """Times of each, as shares of the prototype's and against eager."""
    rows = []
    for path, timing in timings.items():
        phases = {f"{phase}_ms": timing.median(phase) for phase in timing.rounds[0]}
        rate = pairs[path] * TILE**2 / phases["forward_ms"] / 1e3
        share = timing.total / timings["prototype"].total
        rows.append(
            {"path": path, "pairs": pairs[path], **phases}
            | {"total_ms": timing.total, "forward_rate": rate, "share": share}
            | against_eager(timing, timings)
        )
    return rows


def against_eager(timing: Timing, timings: dict[str, Timing]) -> Row:
    """How many times as long eager takes for everything, and for forward + backward alone."""
    eager = timings.get("eager", timing)
    if eager is timing:
        return {}
    blend = [each.median("forward") + each.median("backward") for each in (eager, timing)]
    return {"eager_ratio": eager.total / timing.total, "eager_blend_ratio": blend[0] / blend[1]}


def agreement_note(path: str, found: Row) -> str:
    """What the check of the pictures found."""
    stray = f", {found['stray']} pixels with an alpha at the cut-off differ more" if found["stray"] else ""
    return (
        f"{path}: the picture is the prototype's to {found['error']:.1e} at the {found['going']:.0%} of pixels that do "
        f"not saturate{stray}; to {found['stopped_error']:.1e} at the others, where the stop rules differ; gradient of "
        f"the colours to {found['gradient_error']:.1e} (relative)."
    )
