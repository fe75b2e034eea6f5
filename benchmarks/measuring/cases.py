"""Scenes of random splats with known sizes on the screen, and the jobs that draw them."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.rasterizer.projection import ScreenSplats, project
from gsx.core.shapes import Float
from measuring import naive, rival
from measuring.adapter import blend_pairs, count_pairs, learnable, leaves_of, pair_screen
from measuring.watches import Job, Watch

SMALLEST, LARGEST = 0.5, 6.0
"""Standard deviations along a splat's axes before dilation, px; uniform in the logarithm."""
NEAREST, FARTHEST = 1.0, 11.0
"""Depths, scene units; uniform."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """Random splats on a raster."""

    splats: int
    width: int
    height: int
    size: float = 1.0
    """Factor on the sizes of the splats."""
    seed: int = 0

    @property
    def raster(self) -> str:
        """Its size in words."""
        return f"{self.width}x{self.height}"


def camera_of(case: Case) -> Camera:
    """A camera at the origin that looks along z, 53 degrees wide."""
    return Camera(
        rotation=torch.eye(3),
        translation=torch.zeros(3),
        fx=case.width,
        fy=case.width,
        cx=case.width / 2,
        cy=case.height / 2,
        width=case.width,
        height=case.height,
    )


def splats_of(case: Case, device: torch.device) -> Splats:
    """Splats all over the raster, at random depths and angles, opacity 0.02 to 0.97; leaves that need gradients."""
    draw = torch.Generator().manual_seed(case.seed)
    camera, n = camera_of(case), case.splats
    depth = NEAREST + (FARTHEST - NEAREST) * torch.rand(n, 1, generator=draw)
    slopes = (torch.rand(n, 2, generator=draw) - 0.5) * torch.tensor([case.width, case.height]) / camera.fx
    pixels = case.size * SMALLEST * torch.exp(torch.rand(n, 3, generator=draw) * math.log(LARGEST / SMALLEST))
    fields = {
        "means": torch.cat([slopes, torch.ones(n, 1)], 1) * depth,
        "scales": pixels * depth / camera.fx,
        "quats": torch.randn(n, 4, generator=draw),
        "log_opacities": (0.02 + 0.95 * torch.rand(n, generator=draw)).log(),
        "colours": torch.rand(n, 3, generator=draw),
    }
    return Splats(**{name: value.to(device).requires_grad_() for name, value in fields.items()})


def gradient_of(case: Case, device: torch.device) -> Float[Tensor, "3 H W"]:
    """A gradient for the picture, uniform in [0, 1)."""
    draw = torch.Generator().manual_seed(case.seed + 1)
    return torch.rand(3, case.height, case.width, generator=draw).to(device)


def pairs_of(case: Case, device: torch.device, settings: RasterSettings) -> int:
    """Splat-tile pairs of a case."""
    with torch.no_grad():
        camera = camera_of(case)
        return count_pairs(pair_screen(project(splats_of(case, device), camera, settings), camera, settings))


def picture(path: str, splats: Splats, camera: Camera, settings: RasterSettings) -> Float[Tensor, "3 H W"]:
    """The picture by a way of drawing: eager, compiled, naive or gsplat."""
    if path == "naive":
        return naive.render(project(splats, camera, settings), camera, settings)
    if path == "gsplat":
        return rival.render(splats, camera, settings)
    return rasterize(splats, camera, settings).image


def drawing(path: str, case: Case, device: torch.device, settings: RasterSettings) -> Job:
    """A job that draws a case and sends a gradient back: phases `forward` and `backward`."""
    splats, camera, gradient = splats_of(case, device), camera_of(case), gradient_of(case, device)

    def job(watch: Watch) -> None:
        for leaf in vars(splats).values():
            leaf.grad = None
        watch.begin()
        image = picture(path, splats, camera, settings)
        watch.lap("forward")
        image.backward(gradient)
        watch.lap("backward")

    return job


def blending(screen: ScreenSplats, camera: Camera, settings: RasterSettings, gradient: Float[Tensor, "3 H W"]) -> Job:
    """A job of everything behind projection: phases `pair`, `forward` and `backward`."""
    screen = learnable(screen)
    leaves = leaves_of(screen)

    def job(watch: Watch) -> None:
        watch.begin()
        pairs = pair_screen(screen, camera, settings)
        watch.lap("pair")
        image = blend_pairs(screen, pairs, camera, settings)
        watch.lap("forward")
        torch.autograd.grad(image, leaves, gradient)
        watch.lap("backward")

    return job
