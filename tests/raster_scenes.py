"""Random scenes for the rasterizer's tests, and what is measured on them."""

import json
import os
import random
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from reference_rasterizer import render_reference
from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.core.data.camera import Camera, look_at
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, Rendering, rasterize
from gsx.engine.compositors import COMPOSITORS


def any_path(**options: Any) -> RasterSettings:
    """Settings with all compositors of gsx; `random`, which checks of shapes draw from, keeps its state."""
    state = random.getstate()
    try:
        return RasterSettings(**options, compositors=COMPOSITORS)
    finally:
        random.setstate(state)


def random_splats(count: int = 150, seed: int = 0, channels: int = 3, size: float = 0.08) -> Splats:
    """Anisotropic splats of about `size` scene units within a few units of the origin."""
    g = torch.Generator().manual_seed(seed)
    return Splats(
        means=torch.randn(count, 3, generator=g),
        scales=size * torch.exp(torch.randn(count, 3, generator=g) * 0.7),
        quats=torch.randn(count, 4, generator=g),
        log_opacities=logsigmoid(2 * torch.randn(count, generator=g)),
        colours=torch.rand(count, channels, generator=g),
    )


def soft_splats(seed: int = 0, count: int = 6) -> Splats:
    """Large float64 splats whose alphas stay off every threshold, so that finite differences mean something."""
    splats = changed(random_splats(count, seed), dtype=torch.float64)
    scales = torch.tensor([0.5, 0.7, 0.4], dtype=torch.float64).expand(count, 3)
    return changed(splats, scales=scales.clone(), log_opacities=torch.full_like(splats.log_opacities, -0.7))


SMOOTH = RasterSettings(cull="tight", alpha_min=1e-9, tile_size=4, chunk=4)
"""Rules without steps on `soft_splats`."""


def front_camera(width: int = 70, height: int = 52) -> Camera:
    """Looks at the origin from four units away."""
    return look_at([0, -4, 1], [0, 0, 0], fov_x=0.9, width=width, height=height)


def changed(splats: Splats, *, dtype: torch.dtype | None = None, **fields: Tensor) -> Splats:
    """A copy with other fields or in another dtype."""
    return Splats(**{name: value.to(dtype or value.dtype) for name, value in (vars(splats) | fields).items()})


def leaves(splats: Splats, dtype: torch.dtype | None = None) -> Splats:
    """The same values, collecting gradients."""
    fields = {name: value.to(dtype or value.dtype).clone().requires_grad_() for name, value in vars(splats).items()}
    return Splats(**fields)


def gradients(splats: Splats) -> dict[str, Tensor]:
    """What `leaves` have collected."""
    return {name: torch.zeros_like(value) if value.grad is None else value.grad for name, value in vars(splats).items()}


def loss_of(image: Tensor, depth: Tensor | None) -> Tensor:
    """A mean with another weight at every value."""
    weight = torch.rand(image.shape, generator=torch.Generator().manual_seed(image.shape[0])).to(image)
    return (image * weight).mean() + (0 if depth is None else 0.1 * depth.mean())


@dataclass(frozen=True)
class Truth:
    """The float64 reference's picture and gradients of `loss_of`."""

    image: Tensor
    gradients: Mapping[str, Tensor]


def truth_of(splats: Splats, camera: Camera, rules: RasterSettings, depth: bool = True) -> Truth:
    live = leaves(splats, torch.float64)
    image, _, distances = render_reference(live, camera, rules)
    loss_of(image, distances if depth else None).backward()
    return Truth(image.detach(), gradients(live))


@dataclass(frozen=True)
class Errors:
    """Of a picture against the truth."""

    largest: float
    mean: float
    gradient: float
    """|error| / |truth| of the field where that is largest."""


def render_with_gradients(
    splats: Splats, camera: Camera, rules: RasterSettings, factor: float = 1.0, depth: bool = True
) -> tuple[Rendering, dict[str, Tensor]]:
    """A rendering, and the gradients of `factor` times its `loss_of`."""
    live = leaves(splats)
    rendering = rasterize(live, camera, rules, depth=depth)
    (factor * loss_of(rendering.image, rendering.depth)).backward()
    return rendering, gradients(live)


def errors_of(splats: Splats, camera: Camera, rules: RasterSettings, truth: Truth, depth: bool = True) -> Errors:
    rendering, found = render_with_gradients(splats, camera, rules, depth=depth)
    error = (rendering.image.detach() - truth.image).abs()
    relative = [float((found[name] - true).norm() / true.norm()) for name, true in truth.gradients.items()]
    return Errors(float(error.max()), float(error.mean()), max(relative))


def run_script(script: str, *arguments: str) -> Any:
    """What a Python script prints as JSON in a process of its own; it can import this module."""
    paths = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", script, *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout)
