"""Writes gsplat.safetensors: pictures and gradients by gsplat 1.5.3, an implementation that shares no code with ours.

    pip install --no-deps gsplat==1.5.3 nerfacc==0.5.3 && python tests/golden/make.py

No test runs it. Covariances, projection, compensation, harmonics and alphas are gsplat's plain-torch functions
(gsplat/cuda/_torch_impl.py), transmittance and sums are nerfacc's, which gsplat calls for them; gradients are those of
autograd through that code, all in float64. What is ours: the random inputs, and the list of splats at every pixel,
nearest first, which gsplat makes on a GPU.

Where the two conventions differ, the cases keep away. gsplat clamps alpha at 0.999 (ours 0.99; opacities here are below
0.9), lets a splat reach 3.33 sigma along each axis (ours: the tiles of a 3-sigma square, or all that shows; here every
splat is listed at every pixel) and has its near plane at 0.01 (ours 0.2; depths here are above 1). Its CUDA code drops
alphas below 1/255, as ours does by default: case `published` lists none of those, the other cases list all. The 0.5 and
the clamp at 0 of colours are its caller's and are repeated here.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest.mock import patch

import nerfacc
import torch
from gsplat.cuda._torch_impl import (
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _quat_to_rotmat,
    _spherical_harmonics,
    accumulate,
)
from safetensors.torch import save_file
from torch import Tensor

FILE = Path(__file__).parent / "gsplat.safetensors"
WIDTH, HEIGHT = 24, 20
COUNT = 30
INTRINSICS = (31.0, 27.0, 10.75, 11.5)  # fx, fy, cx, cy: px differ in size, the axis meets no middle
SMOOTH = {"cull": "tight", "alpha_min": 1e-12, "transmittance_stop": 0.0}
"""Our rules under which every splat is drawn at every pixel."""
MIP = SMOOTH | {"dilation": 0.1, "compensate": True}


@dataclass(frozen=True, kw_only=True)
class Case:
    """One picture."""

    seed: int
    degree: int
    size: float = 0.25
    """Typical standard deviation, scene units; 8 px a unit."""
    opacities: tuple[float, float] = (0.05, 0.9)
    eps2d: float = 0.3
    antialiased: bool = False
    alpha_min: float = 0.0
    """Alphas below are not listed."""
    settings: dict[str, Any]
    """Our rasterizer settings that mean the same."""


CASES = {f"degree_{degree}": Case(seed=degree, degree=degree, settings=SMOOTH) for degree in range(4)} | {
    "antialiased": Case(seed=4, degree=1, size=0.04, eps2d=0.1, antialiased=True, settings=MIP),
    # where an opacity is below 0.35, alpha is below 1/255 past 3 sigma: the published squares cut nothing that is drawn
    "published": Case(seed=5, degree=1, opacities=(0.05, 0.35), alpha_min=1 / 255, settings={}),
}


def inputs_of(case: Case) -> dict[str, Tensor]:
    """Leaves of float64 with values that float32 holds: a cloud 4 units before a camera that is turned every way."""
    g = torch.Generator().manual_seed(case.seed)
    low, high = case.opacities
    rotation = _quat_to_rotmat(torch.tensor([0.8, -0.3, 0.4, 0.35], dtype=torch.float64))
    spots = torch.randn(COUNT, 3, generator=g, dtype=torch.float64) * torch.tensor([0.6, 0.5, 0.7])
    values = {
        "means": spots @ rotation + torch.tensor([0.3, -0.2, 0.5]),
        "scales": case.size * torch.exp(0.5 * torch.randn(COUNT, 3, generator=g)),
        "quats": torch.randn(COUNT, 4, generator=g),
        "opacities": low + (high - low) * torch.rand(COUNT, generator=g),
        "sh": 0.3 * torch.randn(COUNT, (case.degree + 1) ** 2, 3, generator=g),
        "intrinsics": torch.tensor(INTRINSICS),
        "rotation": rotation,
        "translation": torch.tensor([0.1, -0.05, 4.0]) - (rotation @ torch.tensor([0.3, -0.2, 0.5]).double()).float(),
    }
    exact = {name: value if name == "rotation" else value.float() for name, value in values.items()}
    return {name: value.double().requires_grad_() for name, value in exact.items()}


def projected(case: Case, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    """What gsplat makes of the cloud before the one camera."""
    view = torch.cat([inputs["rotation"], inputs["translation"][:, None]], 1)
    view = torch.cat([view, view.new_tensor([[0, 0, 0, 1]])])
    fx, fy, cx, cy = inputs["intrinsics"]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    lens = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).view(3, 3)
    covariances = _quat_scale_to_covar_preci(inputs["quats"], inputs["scales"], compute_preci=False)[0]
    _, means2d, depths, conics, compensations = _fully_fused_projection(
        inputs["means"],
        covariances,
        view[None],
        lens[None],
        WIDTH,
        HEIGHT,
        eps2d=case.eps2d,
        calc_compensations=case.antialiased,
    )
    found = {"means2d": means2d[0], "depths": depths[0], "conics": conics[0]}
    return found | ({"compensations": compensations[0]} if case.antialiased else {})


def colours_of(case: Case, inputs: dict[str, Tensor]) -> Tensor:
    """As in gsplat/rendering.py; the camera's centre is held, as it is by what hands splats to our rasterizer."""
    centre = -(inputs["rotation"].T @ inputs["translation"]).detach()
    raw = _spherical_harmonics(case.degree, inputs["means"] - centre, inputs["sh"])
    assert float((raw.detach() + 0.5).abs().min()) > 1e-5, "a colour at the clamp: choose another seed"
    return torch.clamp_min(raw + 0.5, 0.0)


def listed(case: Case, screen: dict[str, Tensor], opacities: Tensor) -> tuple[Tensor, Tensor]:
    """(splat, pixel) of every alpha that is drawn, by pixels, the nearest splat first."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    order = torch.argsort(screen["depths"])
    offset = torch.stack([x.flatten(), y.flatten()], 1)[:, None] - screen["means2d"][order]
    a, b, c = screen["conics"][order].unbind(1)
    dx, dy = offset.unbind(2)
    alpha = opacities[order] * torch.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)
    assert float(alpha.max()) < 0.95
    assert case.alpha_min == 0 or float((alpha / case.alpha_min - 1).abs().min()) > 1e-4, "an alpha at the threshold"
    assert case.alpha_min == 0 or float((1 - alpha).prod(1).min()) > 1e-3, "a pixel near the transmittance stop"
    pixels, places = (alpha >= case.alpha_min).nonzero(as_tuple=True)
    return order[places], pixels


def padded(rays: Tensor, count: int) -> tuple[Tensor, int]:
    """The place of every sample on its ray, and the longest ray; `rays` is sorted."""
    lengths = torch.bincount(rays, minlength=count)
    starts = torch.cumsum(lengths, 0) - lengths
    return torch.arange(len(rays)) - starts[rays], int(lengths.max())


@contextmanager
def batched_nerfacc() -> Iterator[None]:
    """nerfacc multiplies flat lists of samples on GPUs only; it gets the same samples as a row for each ray."""
    original = nerfacc.render_weight_from_alpha

    def batched(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        places, longest = padded(ray_indices, n_rays)
        rows = alphas.new_zeros(n_rays, longest).index_put((ray_indices, places), alphas)
        weights, transmittances = original(rows)
        return weights[ray_indices, places], transmittances[ray_indices, places]

    with patch.object(nerfacc, "render_weight_from_alpha", batched):
        yield


def blended(case: Case, screen: dict[str, Tensor], colours: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """gsplat's picture of colours and depth, (4, H, W), and its alpha, (H, W)."""
    ids, pixels = listed(case, {name: value.detach() for name, value in screen.items()}, opacities.detach())
    channels = torch.cat([colours, screen["depths"][:, None]], 1)
    with batched_nerfacc():
        picture, alpha = accumulate(
            screen["means2d"][None],
            screen["conics"][None],
            opacities[None],
            channels[None],
            ids,
            pixels,
            torch.zeros_like(ids),
            WIDTH,
            HEIGHT,
        )
    return picture[0].permute(2, 0, 1), alpha[0, :, :, 0]


def tensors_of(case: Case, weights: Tensor) -> dict[str, Tensor]:
    """Inputs, all that gsplat makes of them, and gradients of sum(weights * (image, depth, alpha))."""
    inputs = inputs_of(case)
    screen, colours = projected(case, inputs), colours_of(case, inputs)
    assert float(screen["depths"].detach().min()) > 1
    picture, alpha = blended(case, screen, colours, inputs["opacities"] * screen.get("compensations", 1.0))
    (torch.cat([picture, alpha[None]]) * weights.double()).sum().backward()
    gradients = {f"gradient.{name}": value.grad for name, value in inputs.items()}
    # rotation apart, the values are float32's own
    given = {name: value if name == "rotation" else value.float() for name, value in inputs.items()}
    made = {"colours": colours, "image": picture[:3], "depth": picture[3], "alpha": alpha}
    return given | screen | made | gradients


def main() -> None:
    weights = torch.rand(5, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(100))
    made = {name: tensors_of(case, weights) for name, case in CASES.items()}
    tensors = {f"{name}.{key}": value for name, values in made.items() for key, value in values.items()}
    tensors["weights"] = weights
    told = {
        "made_by": f"gsplat {version('gsplat')} (plain torch), nerfacc {version('nerfacc')}, torch {torch.__version__}",
        "degrees": json.dumps({name: case.degree for name, case in CASES.items()}),
        "settings": json.dumps({name: case.settings for name, case in CASES.items()}),
        "conventions": " ".join((__doc__ or "").split("\n\n")[-1].split()),
    }
    save_file({name: value.detach().contiguous() for name, value in tensors.items()}, FILE, metadata=told)
    print(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
