"""What each setting of the rasterizer costs and gives: one is changed at a time, its errors are against float64."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.errors import first_line
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.settings import CHOICES
from gsx.core.shapes import Float
from gsx.core.training.render import splats_for
from gsx.experiments.reports.charts import pareto_front
from gsx.experiments.runs.open import open_run
from measuring.cases import Case, camera_of, splats_of
from measuring.watches import Job, Patience, Timing, Watch, take_turns

EXACT: dict[str, Any] = {"path": "eager", "evaluation": "float64", "accumulation": "float64"}
"""How the truth is computed; the base settings say what it is."""
VALUES: dict[str, tuple[Any, ...]] = {
    "schedule": ("chunks", "segments"),
    "tile_size": (4, 8, 16, 32),
    "chunk": (8, 16, 32),
    "cull": CHOICES["cull"],
    "pixel": CHOICES["pixel"],
    "alpha_min": (0.001, 1 / 255, 0.008, 0.016),
    "transmittance_stop": (0.0, 1e-4, 1e-3, 1e-2),
    "evaluation": CHOICES["evaluation"],
    "accumulation": CHOICES["accumulation"],
    "tile_cap": (0, 128, 512, 2048),
}
"""Values of each setting; the published ones are among them."""
OUTLIERS = 1e-4
"""Share of the pixels that may jump: rounding decides whether a splat reaches a cut-off."""
ROUND = 1e-3
"""Gradients of orientations count against at least this share of those of log-scales: round splats have none."""
COLUMNS = [
    ["setting", "setting"],
    ["forward_ms", "forward ms"],
    ["total_ms", "both ms"],
    ["ratio", "of base"],
    ["max_error", "largest error"],
    ["most_error", "of 99.99 % of the pixels"],
    ["psnr", "PSNR"],
    ["gradient", "gradient error"],
    ["field", "of"],
    ["front", "front"],
    ["failure", "failure"],
]
NOTE = (
    "Errors against a float64 picture by the rules of the base settings, display units; gradient: norm of the "
    "difference over norm, of the worst field. Front: nothing else is as fast and as exact."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """Splats without gradients, and a camera that sees them."""

    camera: Camera
    splats: Splats
    background: Float[Tensor, "3"]


def shots_of(run: Path | None, count: int, quick: bool, device: torch.device) -> tuple[list[Shot], str]:
    """Test views of a run, else random splats; and their name."""
    if run is None:
        case = Case(splats=60 if quick else 4000, width=43 if quick else 200, height=30 if quick else 136)
        splats, background = detached(splats_of(case, device)), torch.zeros(3, device=device)
        return [
            Shot(camera=camera_of(case), splats=splats, background=background)
        ], f"{case.splats:,} random splats, {case.raster} px"
    opened, _ = open_run(run, plugins(), [f"device={device.type}"])
    views = opened.scene.test or opened.train_views
    chosen = views[:: max(1, len(views) // count)][:count]
    shots = [
        Shot(camera=view.camera, splats=splats_for(opened, view.camera), background=opened.background)
        for view in chosen
    ]
    return shots, f"run {run.name} at step {opened.step:,}, views {', '.join(view.name for view in chosen)}"


def detached(splats: Splats) -> Splats:
    """The same splats without gradients."""
    return Splats(**{name: value.detach() for name, value in vars(splats).items()})


def changes_of(base: RasterSettings, paths: Sequence[str], cuda: bool) -> list[dict[str, Any]]:
    """The base settings, the other paths, then one setting at a time; schedules need the compiled path."""
    changes = [{}, *({"path": path} for path in paths if path != base.path)]
    for name, values in VALUES.items():
        if name == "schedule":
            usual = "segments" if cuda else "chunks"
            changes += [{"path": "compiled", name: v} for v in values if v != usual and "compiled" in paths]
        else:
            changes += [{name: v} for v in values if v != getattr(base, name) and suits(name, v, base)]
    return changes


def suits(name: str, value: Any, base: RasterSettings) -> bool:
    """Returns whether a value can be combined with the base settings."""
    return (name, value) != ("tile_size", 32) or base.cull == "tight"


def spelled(changes: Mapping[str, Any]) -> str:
    """Changes as `tile_size=16 alpha_min=0.008`."""
    words = (f"{name}={f'{v:.4g}' if isinstance(v, float) else v}" for name, v in changes.items())
    return " ".join(words) or "base settings"


# -- errors ----------------------------------------------------------------------------------------------------------

Drawn = dict[str, Tensor]
"""A picture as `image`, and the gradient of a fixed linear function of it by field of the splats."""


def drawn(shot: Shot, settings: RasterSettings, dtype: torch.dtype = torch.float32) -> Drawn:
    """Render, and take the gradient of the sum of random weights times pixels."""
    leaves = {name: value.detach().to(dtype).requires_grad_() for name, value in vars(shot.splats).items()}
    image = rasterize(Splats(**leaves), shot.camera, settings, background=shot.background).image
    image.backward(weights_of(image))
    slopes = {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}
    return {"image": image.detach()} | slopes


def weights_of(image: Float[Tensor, "C H W"]) -> Float[Tensor, "C H W"]:
    """Normal numbers: a gradient in which nothing cancels by symmetry."""
    return torch.randn(image.shape, generator=torch.Generator().manual_seed(0)).to(image)


def errors_of(shots: Sequence[Shot], pictures: Sequence[Drawn], truths: Sequence[Drawn]) -> dict[str, Any]:
    """Columns of a row: errors of all pixels, of most, PSNR, and of the worst gradient."""
    pairs = [(p["image"].double(), t["image"]) for p, t in zip(pictures, truths, strict=True)]
    worst = torch.cat([(image - truth).abs().amax(0).flatten() for image, truth in pairs])
    largest = worst.topk(int(OUTLIERS * len(worst)) + 1).values
    squares = statistics.fmean(float((image - truth).square().mean()) for image, truth in pairs)
    gradient, field = gradient_error(pictures, truths, [shot.splats.scales for shot in shots])
    return {
        "max_error": float(largest[0]),
        "most_error": float(largest[-1]),
        "psnr": -10 * math.log10(squares) if squares else math.inf,
        "gradient": gradient,
        "field": field,
    }


def gradient_error(
    pictures: Sequence[Drawn], truths: Sequence[Drawn], scales: Sequence[Float[Tensor, "N 3"]]
) -> tuple[float, str]:
    """Norm of the difference over norm of the truth, over all pictures, of the worst field; and that field's name."""

    def norm(parts: Sequence[Tensor]) -> float:
        return math.sqrt(math.fsum(float(part.double().square().sum()) for part in parts))

    log_scales = norm([truth["scales"] * s for truth, s in zip(truths, scales, strict=True)])
    errors = {}
    for name in truths[0].keys() - {"image"}:
        difference = norm([p[name].double() - t[name] for p, t in zip(pictures, truths, strict=True)])
        size = max(norm([t[name] for t in truths]), ROUND * log_scales if name == "quats" else 0.0)
        errors[name] = difference / size if size else (math.inf if difference else 0.0)
    field = max(errors, key=lambda name: errors[name])
    return errors[field], field


# -- times -----------------------------------------------------------------------------------------------------------


def drawing(shots: Sequence[Shot], settings: RasterSettings) -> Job:
    """A job that draws all shots and takes gradients: phases `forward` and `backward`."""

    def job(watch: Watch) -> None:
        splats = [
            Splats(**{name: v.detach().requires_grad_() for name, v in vars(shot.splats).items()}) for shot in shots
        ]
        watch.begin()
        images = [
            rasterize(own, shot.camera, settings, background=shot.background).image
            for own, shot in zip(splats, shots, strict=True)
        ]
        watch.lap("forward")
        for image in images:
            image.backward(torch.ones_like(image))
        watch.lap("backward")

    return job


def times_of(timing: Timing, base: Timing, count: int) -> dict[str, float]:
    """Columns of a row: ms a picture, and the median of ratios to the base settings within a round."""
    ratios = [sum(a.values()) / sum(b.values()) for a, b in zip(timing.rounds, base.rounds, strict=True)]
    return {
        "forward_ms": timing.median("forward") / count,
        "total_ms": timing.total / count,
        "ratio": statistics.median(ratios),
    }


def knob_rows(
    shots: Sequence[Shot], base: RasterSettings, paths: Sequence[str], patience: Patience
) -> list[dict[str, Any]]:
    """A row for each change of the settings; the first is the base."""
    device = shots[0].background.device
    truths = [drawn(shot, replace(base, **EXACT), torch.float64) for shot in shots]
    rows, jobs = list[dict[str, Any]](), dict[str, Job]()
    for change in changes_of(base, paths, device.type == "cuda"):
        row: dict[str, Any] = {"setting": spelled(change)}
        try:
            settings = replace(base, **change)
            row |= errors_of(shots, [drawn(shot, settings) for shot in shots], truths)
            jobs[row["setting"]] = drawing(shots, settings)
        except Exception as error:  # some formats are refused, or fail in a compiler: the others are measured
            if not change:
                raise
            row["failure"] = first_line(error)
        rows.append(row)
    timings = take_turns(jobs, device, patience)
    for row in rows:
        if row["setting"] in timings:
            row |= times_of(timings[row["setting"]], timings["base settings"], len(shots))
    return with_front(rows)


def with_front(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with a mark on those that no other beats; errors count by two digits."""
    measured = [row for row in rows if "failure" not in row]
    front = pareto_front([row["ratio"] for row in measured], [-float(f"{row['max_error']:.1e}") for row in measured])
    for index in front:
        measured[index]["front"] = "yes"
    return rows
