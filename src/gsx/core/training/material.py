"""What a regenerator may learn from, taken from a run: training views, and what the model shows as it is now."""

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.evaluation.evaluator import render_tiled
from gsx.core.rasterizer import rasterize
from gsx.core.shapes import Float
from gsx.core.training.halves import TILE_PIXELS, held_out_renders
from gsx.core.training.regenerator import Material
from gsx.core.training.run import Run


@torch.no_grad()
def rendered(run: Run, camera: Camera) -> Float[Tensor, "3 h w"]:
    """The model as it is now."""
    run.backbone.begin(max(1, run.step))
    return render_tiled(run.backbone.splats(camera), camera, run.raster, run.background, TILE_PIXELS).image


@torch.no_grad()
def coverage(run: Run, camera: Camera) -> float:
    """Mean alpha of the model as it is now, 0 to 1: how much of the picture shows the scene."""
    run.backbone.begin(max(1, run.step))
    return float(rasterize(run.backbone.splats(camera), camera, run.raster).alpha.mean())


def material_of(run: Run, seed: int) -> Material:
    """Everything but held-out views."""
    return Material(
        views=run.scene.train,
        reduction=run.scene.reduction,
        render=lambda camera: rendered(run, camera),
        held_out=lambda share: held_out_renders(run, share, seed),
        step=run.step,
        seed=seed,
        device=run.device,
        folder=run.folder / "regenerators",
    )
