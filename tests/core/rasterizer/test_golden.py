"""Projection, harmonics, pictures and gradients against another implementation: tests/golden/make.py names it."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from reference_rasterizer import render_reference
from safetensors import safe_open
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.projection import project

FILE = Path(__file__).parents[2] / "golden" / "gsplat.safetensors"
with safe_open(FILE, "pt") as opened:
    TOLD = opened.metadata()
    TENSORS = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
DEGREES = json.loads(TOLD["degrees"])
SPLATS = ("means", "scales", "quats", "opacities", "sh")
POSE = ("rotation", "translation")

WIDE = 1e-9
"""Between two in float64: alphas below 1e-12 are left out where the other lists them all. Measured: up to 7e-11."""
NARROW = 1e-5
"""Of float32: 30 splats over one another at offsets up to 40 px, each rounded to 6e-8. Measured: 7e-7 of a picture's
largest value, 2e-6 of a gradient's norm."""


@dataclass(frozen=True, eq=False)
class Inputs:
    """The stored inputs of one case, collecting gradients."""

    values: dict[str, Tensor]
    degree: int

    @classmethod
    def of(cls, case: str, dtype: torch.dtype) -> "Inputs":
        names = (*SPLATS, *POSE, "intrinsics")
        leaves = {name: TENSORS[f"{case}.{name}"].to(dtype, copy=True).requires_grad_() for name in names}
        return cls(leaves, DEGREES[case])

    def camera(self) -> Camera:
        _, height, width = TENSORS["weights"].shape
        fx, fy, cx, cy = self.values["intrinsics"].tolist()
        pose = {name: self.values[name] for name in POSE}
        return Camera(**pose, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    def colours(self) -> Tensor:
        """As a backbone makes them."""
        means, sh = self.values["means"], self.values["sh"]
        return colours_of(sh[:, :1], sh[:, 1:], means - self.camera().centre.detach().to(means), self.degree)

    def splats(self) -> Splats:
        means, scales, quats, opacities = (self.values[name] for name in SPLATS[:4])
        return Splats(means=means, scales=scales, quats=quats, log_opacities=opacities.log(), colours=self.colours())


def rules_of(case: str) -> RasterSettings:
    return RasterSettings(**json.loads(TOLD["settings"])[case])


def close(found: Tensor, case: str, name: str, tolerance: float) -> None:
    """Largest error against the largest value."""
    true = TENSORS[f"{case}.{name}"]
    error = float((found.detach().double() - true).abs().max() / true.abs().max())
    assert error <= tolerance, f"{case} {name}: {error:.1e}"


def gradients_close(inputs: Inputs, case: str, names: tuple[str, ...], tolerance: float) -> None:
    for name in names:
        true, found = TENSORS[f"{case}.gradient.{name}"], inputs.values[name].grad
        assert found is not None, name
        error = float((found.double() - true).norm() / true.norm())
        assert error <= tolerance, f"{case} gradient of {name}: {error:.1e}"


def check_pictures(image: Tensor, depth: Tensor, alpha: Tensor, case: str, tolerance: float) -> None:
    """Compare, then send back the weights that the stored gradients were taken with."""
    for name, found in (("image", image), ("depth", depth), ("alpha", alpha)):
        close(found, case, name, tolerance)
    together = torch.cat([image, depth[None], alpha[None]])
    (together * TENSORS["weights"].to(together)).sum().backward()


def test_the_file_says_what_made_it() -> None:
    assert TOLD["made_by"].startswith("gsplat 1.5.3 ")
    assert len(DEGREES) == 6
    assert FILE.stat().st_size < 300_000


@pytest.mark.parametrize("case", DEGREES)
def test_projection_is_that_of_another_implementation(case: str) -> None:
    inputs = Inputs.of(case, torch.float64)
    splats = inputs.splats()
    screen = project(splats, inputs.camera(), rules_of(case))
    assert screen.ids.tolist() == list(range(len(splats)))
    first, middle, last = screen.conic_factors.unbind(1)
    # U^T U is half the inverse covariance
    conics = 2 * torch.stack([first * first, first * middle, middle * middle + last * last], 1)
    for name, found in (("means2d", screen.means), ("depths", screen.depths), ("conics", conics)):
        close(found, case, name, WIDE)
    if rules_of(case).compensate:
        close((screen.log_opacities - splats.log_opacities).exp(), case, "compensations", WIDE)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, NARROW), (torch.float64, WIDE)])
@pytest.mark.parametrize("case", DEGREES)
def test_colours_of_every_degree_are_those_of_another_implementation(
    case: str, dtype: torch.dtype, tolerance: float
) -> None:
    close(Inputs.of(case, dtype).colours(), case, "colours", tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, NARROW), (torch.float64, WIDE)])
@pytest.mark.parametrize("case", DEGREES)
def test_pictures_and_all_gradients_are_those_of_another_implementation(
    case: str, dtype: torch.dtype, tolerance: float
) -> None:
    inputs = Inputs.of(case, dtype)
    drawn = rasterize(
        inputs.splats(), inputs.camera(), rules_of(case), intrinsics=inputs.values["intrinsics"], depth=True
    )
    assert drawn.depth is not None
    check_pictures(drawn.image, drawn.depth, drawn.alpha, case, tolerance)
    gradients_close(inputs, case, (*SPLATS, *POSE, "intrinsics"), tolerance)


@pytest.mark.parametrize("case", DEGREES)
def test_the_float64_reference_is_that_of_another_implementation(case: str) -> None:
    inputs = Inputs.of(case, torch.float64)
    image, alpha, depth = render_reference(inputs.splats(), inputs.camera(), rules_of(case))
    check_pictures(image, depth, alpha, case, WIDE)
    gradients_close(inputs, case, (*SPLATS, *POSE), WIDE)
