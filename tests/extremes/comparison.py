"""How a case is measured: the tiled rasterizer against the float64 reference, forward and backward."""

import functools
from dataclasses import dataclass, replace

import torch
from raster_scenes import any_path
from reference_rasterizer import alpha_maps, frame_pixels, render_reference, whole
from torch import Tensor

from extremes.cases import Case
from gsx.core.data.camera import Camera
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, Rendering, rasterize
from gsx.engine.compiling import available

FLOAT64_TOLERANCE = 1e-12
"""Relative distance to a threshold within which float64 may decide either way."""


def paths() -> list[str]:
    """The paths of the rasterizer that work here."""
    return ["eager", "compiled"] if available() else ["eager"]


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What a rendering of a case was like."""

    rendering: Rendering
    gradients: dict[str, Tensor]
    image_error: float
    """Largest over the pixels that no threshold touches."""
    step: float
    """Largest image error over all pixels."""
    gradient_errors: dict[str, float]
    """|fast - truth| / |truth| of each field."""
    undecided: float
    """Share of the pixels at a threshold."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What the reference says about a case."""

    image: Tensor
    alpha: Tensor
    weights: Tensor
    """Of the image's channels and, last, the coverage in the loss; 0 at undecided pixels."""
    gradients: dict[str, Tensor]
    decided: Tensor


def rules_of(case: Case, cull: str, path: str = "eager") -> RasterSettings:
    few = {"unrolled": 2}  # compiles several times faster, and rounds alike
    return any_path(**(few | {"cull": cull, "path": path} | dict(case.rules)))


def leaves(splats: Splats, dtype: torch.dtype) -> Splats:
    """The same values in `dtype`, collecting gradients."""
    return Splats(**{name: value.to(dtype).clone().requires_grad_() for name, value in vars(splats).items()})


def gradients_of(splats: Splats, image: Tensor, alpha: Tensor, weights: Tensor) -> dict[str, Tensor]:
    """Gradients of every field of the weighted sum of the image and the coverage."""
    loss = (torch.cat([image, alpha[None]]) * weights.to(image)).sum()
    fields = vars(splats)
    if not loss.requires_grad:
        return {name: torch.zeros_like(value) for name, value in fields.items()}
    found = torch.autograd.grad(loss, list(fields.values()), allow_unused=True, materialize_grads=True)
    return dict(zip(fields, found, strict=True))


def undecided(splats: Splats, camera: Camera, rules: RasterSettings, tolerance: float) -> Tensor:
    """Pixels at which the truth would step if alpha_min or the transmittance stop moved by `tolerance`, relative [H W].

    At the cut-off a splat of alpha 1/255 comes or goes, at the stop the rest of a pixel's light; which, float32 may
    decide otherwise than float64. Nothing else is excused.
    """
    with torch.no_grad():
        lower = replace(rules, alpha_min=rules.alpha_min * (1 - tolerance))
        alpha, _ = alpha_maps(splats, whole(camera), lower, frame_pixels(camera))
        at_cut = (alpha > 0) & (alpha < rules.alpha_min * (1 + tolerance))
        behind = torch.cumprod(1 - torch.where(alpha < rules.alpha_min, 0.0, alpha), 0)
        at_stop = (behind / rules.transmittance_stop - 1).abs() < tolerance
        return (at_cut | at_stop).any(0)


@functools.cache
def truth(case: Case, cull: str, dtype: torch.dtype) -> Truth:
    """The reference's view of the splats that are not dropped in `dtype`."""
    splats, camera = case.make()
    kept = Splats(**{name: value[case.dropped_in(dtype) :] for name, value in vars(splats).items()})
    rules, slow = rules_of(case, cull), leaves(kept, torch.float64)
    image, alpha, _ = render_reference(slow, camera, rules)
    tolerance = case.tolerance if dtype == torch.float32 else FLOAT64_TOLERANCE
    decided = ~undecided(slow, camera, rules, tolerance)
    noise = torch.rand(4, *decided.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = noise * decided
    gradients = gradients_of(slow, image, alpha, weights)
    return Truth(image=image.detach(), alpha=alpha.detach(), weights=weights, gradients=gradients, decided=decided)


def relative(value: Tensor, truth: Tensor) -> float:
    """|value - truth| / |truth|; |value| where the truth is zero."""
    size = float(truth.norm())
    return float((value.double() - truth).norm()) / (size if size > 0 else 1.0)


def measure(case: Case, path: str, dtype: torch.dtype, cull: str) -> Measurement:
    """Render a case forward and backward and compare."""
    splats, camera = case.make()
    live, expected = leaves(splats, dtype), truth(case, cull, dtype)
    rendering = rasterize(live, camera, rules_of(case, cull, path))
    gradients = gradients_of(live, rendering.image, rendering.alpha, expected.weights)
    errors = (rendering.image.detach().double() - expected.image).abs().amax(0)
    skipped = case.dropped_in(dtype)
    return Measurement(
        rendering=rendering,
        gradients=gradients,
        image_error=float((errors * expected.decided).max()),
        step=float(errors.max()),
        gradient_errors={
            name: relative(value[skipped:], expected.gradients[name]) for name, value in gradients.items()
        },
        undecided=1 - float(expected.decided.double().mean()),
    )
