"""The CUDA rasterizer `gsplat`, where it is installed and runs."""

from importlib.util import find_spec

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings
from gsx.core.shapes import Float


def missing(device: torch.device) -> str:
    """Why gsplat cannot be measured here; empty when it can."""
    if device.type != "cuda":
        return "it renders with CUDA only, and this run is on the CPU"
    if find_spec("gsplat") is None:
        return "it is not installed"
    return broken(device)


def broken(device: torch.device) -> str:
    """What its smallest render fails with: gsplat builds its kernels on first use, which may fail in many ways."""
    try:
        one = torch.ones(1, device=device)
        splats = Splats(
            means=torch.tensor([[0.0, 0, 2]], device=device),
            scales=one.expand(1, 3),
            quats=one.expand(1, 4),
            log_opacities=-one,
            colours=one.expand(1, 3),
        )
        camera = Camera(rotation=torch.eye(3), translation=torch.zeros(3), fx=8, fy=8, cx=8, cy=8, width=16, height=16)
        render(splats, camera, RasterSettings())
    except Exception as error:
        return f"its smallest render fails: {type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
    return ""


def render(splats: Splats, camera: Camera, settings: RasterSettings) -> Float[Tensor, "C H W"]:
    """Blended colours by gsplat, with its own tiles of 16 px; differentiable in the splats."""
    import gsplat

    like = splats.means
    pose = torch.eye(4, device=like.device)
    pose[:3, :3], pose[:3, 3] = camera.rotation.to(like), camera.translation.to(like)
    intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], device=like.device)
    colours, _, _ = gsplat.rasterization(
        splats.means,
        splats.quats,
        splats.scales,
        splats.log_opacities.exp(),
        splats.colours,
        pose[None],
        intrinsics[None],
        camera.width,
        camera.height,
        near_plane=camera.near,
        eps2d=settings.dilation,
        packed=False,
    )
    return colours[0].permute(2, 0, 1)
