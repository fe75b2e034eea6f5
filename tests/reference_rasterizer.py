"""The slow float64 truth: every splat at every pixel, written from the equations (3D-GS, forward.cu), no tiles.

Shares no code with the fast path; O(splats x pixels) memory. Differentiable by plain autograd.
"""

from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, Frame
from gsx.core.gaussians.quaternions import rotation_matrices
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.settings import WINDOW_TILE, RasterSettings
from gsx.core.shapes import Bool, Float


def whole(camera: Camera) -> Camera:
    """The camera whose raster is the frame that `camera` was cropped from."""
    frame = camera.frame
    cx, cy = camera.cx + frame.left, camera.cy + frame.top
    return replace(camera, cx=cx, cy=cy, width=frame.width, height=frame.height, cut_from=None)


def frame_pixels(camera: Camera) -> Float[Tensor, "H W 2"]:
    """Pixel centres of the camera's raster on its frame."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    return torch.stack([x + camera.frame.left, y + camera.frame.top], -1).double()


def screen_roots(
    splats: Splats, points: Float[Tensor, "N 3"], camera: Camera, settings: RasterSettings
) -> Float[Tensor, "N 5 2"]:
    """A with A^T A = J W Sigma W^T J^T + dilation (3D-GS, computeCov2D)."""
    x, y, z = points.unbind(1)
    widen_x = settings.jacobian_margin * camera.width / (2 * camera.fx)
    widen_y = settings.jacobian_margin * camera.height / (2 * camera.fy)
    x = z * (x / z).clamp(-camera.cx / camera.fx - widen_x, (camera.width - camera.cx) / camera.fx + widen_x)
    y = z * (y / z).clamp(-camera.cy / camera.fy - widen_y, (camera.height - camera.cy) / camera.fy + widen_y)
    zero = torch.zeros_like(z)
    row_x = torch.stack([camera.fx / z, zero, -camera.fx * x / z**2], 1)
    row_y = torch.stack([zero, camera.fy / z, -camera.fy * y / z**2], 1)
    jacobian = torch.stack([row_x, row_y], 1) @ camera.rotation.double()
    spread = rotation_matrices(splats.quats.double()) @ torch.diag_embed(splats.scales.double())
    dilation = (dilations(camera, settings)[0] ** 0.5 * torch.eye(2, dtype=torch.float64)).expand(len(points), 2, 2)
    return torch.cat([(jacobian @ spread).mT, dilation], 1)


def dilations(camera: Camera, settings: RasterSettings) -> tuple[float, float]:
    """(what is drawn by, what was trained by, in px^2 of this camera) of cameras finer or coarser than in training."""
    zoom = max(camera.fx, camera.fy) / settings.training_focal if settings.training_focal > 0 else 1.0
    trained = settings.dilation * zoom * zoom
    if settings.zoomed == "resampled":
        return trained - 0.1 * zoom * zoom + 0.1, trained
    return (trained if settings.zoomed == "magnified" and zoom > 1 else settings.dilation), trained


def squared_distances(roots: Float[Tensor, "N 5 2"], offset: Float[Tensor, "N H W 2"]) -> Float[Tensor, "N H W"]:
    """d^T (A^T A)^-1 d = |R^-T d|^2 with A = Q R: the inverse of a needle's covariance would lose half the digits."""
    triangle = torch.linalg.qr(roots).R[:, None, None]
    first = offset[..., 0] / triangle[..., 0, 0]
    second = (offset[..., 1] - triangle[..., 0, 1] * first) / triangle[..., 1, 1]
    return first.square() + second.square()


def compensation(roots: Float[Tensor, "N 5 2"]) -> Float[Tensor, "N"]:
    """sqrt(|S| / |S + dilation I|), a ratio of products of singular values; S comes without the dilation's rows."""
    return torch.linalg.svdvals(roots[:, :3]).prod(1) / torch.linalg.svdvals(roots).prod(1)


def windows(
    means: Float[Tensor, "N 2"], covariances: Float[Tensor, "N 2 2"], xy: Float[Tensor, "H W 2"], frame: Frame
) -> Bool[Tensor, "N H W"]:
    """Pixels inside those of the frame's 16 px tiles that the published 3-sigma square touches (3D-GS, forward.cu)."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    middle = (a + c) / 2
    largest = middle + torch.sqrt((middle**2 - (a * c - b * b)).clamp_min(0.1))
    radius = torch.ceil(3 * largest.sqrt())[:, None]
    first = torch.trunc((means - 0.5 - radius) / WINDOW_TILE)[:, None, None]
    last = torch.trunc((means - 0.5 + radius + WINDOW_TILE - 1) / WINDOW_TILE)[:, None, None]
    tile = torch.floor(xy / WINDOW_TILE)
    tiles = torch.ceil(torch.tensor([frame.width, frame.height]) / WINDOW_TILE)
    return ((tile >= first.clamp(min=0)) & (tile < last.minimum(tiles))).all(-1)


def alpha_maps(
    splats: Splats, camera: Camera, settings: RasterSettings, xy: Float[Tensor, "H W 2"]
) -> tuple[Float[Tensor, "M H W"], Tensor]:
    """Alpha of every splat in front of the camera at every pixel, nearest splat first, and their rows."""
    points = splats.means.double() @ camera.rotation.double().T + camera.translation.double()
    rows = (points[:, 2] > camera.near).nonzero()[:, 0]
    rows = rows[torch.argsort(points[rows, 2].float(), stable=True)]
    points = points[rows]
    chosen = Splats(**{name: getattr(splats, name)[rows] for name in splats.__dataclass_fields__})
    roots = screen_roots(chosen, points, camera, settings)
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    means = points[:, :2] / points[:, 2:] * focal + torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    distance = squared_distances(roots, xy - means[:, None, None])
    alpha = torch.exp(chosen.log_opacities.double()[:, None, None] - distance / 2)
    if settings.compensate:
        alpha = alpha * compensation(roots)[:, None, None]
    if settings.zoomed == "resampled":
        trained = dilations(camera, settings)[1] ** 0.5 * torch.eye(2, dtype=torch.float64)
        widened = torch.cat([roots[:, :3], trained.expand_as(roots[:, 3:])], 1)
        factor = torch.linalg.svdvals(widened).prod(1) / torch.linalg.svdvals(roots).prod(1)
        opacity = chosen.log_opacities.double().exp()
        factor = torch.minimum(factor, torch.maximum(opacity, torch.full_like(opacity, settings.alpha_max)) / opacity)
        alpha = alpha * factor[:, None, None]
    clamped = alpha + (alpha.clamp(max=settings.alpha_max) - alpha).detach()  # straight-through (3D-GS, backward.cu)
    keep = clamped >= settings.alpha_min
    if settings.cull == "published":
        keep = keep & windows(means, roots.mT @ roots, xy, camera.frame)
    return torch.where(keep, clamped, 0.0), rows


def render_reference(
    splats: Splats, camera: Camera, settings: RasterSettings, *, background: Float[Tensor, "C"] | None = None
) -> tuple[Float[Tensor, "C H W"], Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """(image, alpha, depth) in float64; `depth` is the blending-weighted sum of camera z. A crop sees its frame."""
    alpha, rows = alpha_maps(splats, whole(camera), settings, frame_pixels(camera))
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weight = alpha * before * (after >= settings.transmittance_stop)
    depth = splats.means.double()[rows] @ camera.rotation.double()[2] + camera.translation.double()[2]
    image = torch.einsum("nhw,nc->chw", weight, splats.colours.double()[rows])
    coverage = weight.sum(0)
    if background is not None:
        image = image + (1 - coverage) * background.double()[:, None, None]
    return image, coverage, torch.einsum("nhw,n->hw", weight, depth)
