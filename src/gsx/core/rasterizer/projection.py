"""World Gaussians to screen Gaussians, stable by construction (docs/numerics.md; 3D-GS sections 3.1 and 3.2)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.camera import Camera
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Bool, Float, Int
from gsx.core.splats import Splats


@dataclass(frozen=True, eq=False, kw_only=True)
class ScreenSplats:
    """M splats in front of the camera. Positions in pixels of the camera's frame, pixel centres at +0.5."""

    ids: Int[Tensor, "M"]
    """Row of the splat in the input."""
    means: Float[Tensor, "M 2"]
    depths: Float[Tensor, "M"]
    """Camera z, scene units."""
    covariances: Float[Tensor, "M 3"]
    """xx, xy, yy after dilation, px^2."""
    factors: Float[Tensor, "M 3"]
    """(u0, u1, u2): half the inverse covariance is U^T U with U = [[u0, u1], [0, u2]]."""
    log_opacities: Float[Tensor, "M"]
    channels: Float[Tensor, "M C"]
    dropped: int
    """Splats left out because a value of theirs is not finite."""


def rotate_back(quats: Float[Tensor, "M 4"], vectors: Float[Tensor, "M V 3"]) -> Float[Tensor, "M V 3"]:
    """R(q)^T v for quaternions (w, x, y, z) of any length; a zero quaternion is the identity."""
    unit = torch.nn.functional.normalize(quats, dim=1, eps=1e-12)[:, None, :].expand(-1, vectors.shape[1], -1)
    w, axis = unit[..., :1], unit[..., 1:]
    twice_cross = 2 * torch.linalg.cross(axis, vectors)
    return vectors - w * twice_cross + torch.linalg.cross(axis, twice_cross)


def clamped_slopes(
    camera_points: Float[Tensor, "M 3"], camera: Camera, margin: float
) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """x/z and y/z, clamped to the frame widened by `margin` half-extents: asymmetric for off-centre cameras."""
    frame = camera.frame

    def clamp(slope: Tensor, focal: float, centre: float, size: int) -> Tensor:
        extra = margin * size / (2 * focal)
        return slope.clamp(-centre / focal - extra, (size - centre) / focal + extra)

    slopes = camera_points[:, :2] / camera_points[:, 2:]
    return (
        clamp(slopes[:, 0], camera.fx, camera.cx + frame.left, frame.width),
        clamp(slopes[:, 1], camera.fy, camera.cy + frame.top, frame.height),
    )


def screen_axes(
    splats: Splats, camera_points: Float[Tensor, "M 3"], ids: Int[Tensor, "M"], camera: Camera, margin: float
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Rows p, q of J W R diag(s): the screen covariance is [[p.p, p.q], [p.q, q.q]], semi-definite however rounded."""
    slope_x, slope_y = clamped_slopes(camera_points, camera, margin)
    world_to_camera = camera.rotation.to(camera_points)
    inverse_depth = 1 / camera_points[:, 2]
    row_x = (camera.fx * inverse_depth)[:, None] * (world_to_camera[0] - slope_x[:, None] * world_to_camera[2])
    row_y = (camera.fy * inverse_depth)[:, None] * (world_to_camera[1] - slope_y[:, None] * world_to_camera[2])
    rows = rotate_back(splats.quats[ids], torch.stack([row_x, row_y], 1)) * splats.scales[ids][:, None, :]
    return rows[:, 0], rows[:, 1]


def covariance_and_factor(
    p: Float[Tensor, "M 3"], q: Float[Tensor, "M 3"], dilation: float
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Dilated covariance (xx, xy, yy) and the factor U; the determinant by Lagrange's identity, never negative."""
    pp, pq, qq = (p * p).sum(1), (p * q).sum(1), (q * q).sum(1)
    area = torch.linalg.cross(p, q).square().sum(1)
    determinant = area + dilation * (pp + qq) + dilation**2
    xx, yy = pp + dilation, qq + dilation
    u0 = (yy / (2 * determinant)).sqrt()
    u1 = -pq / (2 * determinant * yy).sqrt()
    u2 = (2 * yy).rsqrt()
    return torch.stack([xx, pq, yy], 1), torch.stack([u0, u1, u2], 1)


@torch.no_grad()
def usable(splats: Splats) -> Bool[Tensor, "N"]:
    """False for splats with a value that is not finite (an opacity of 0, ln -inf, is fine): they are not drawn."""
    total = splats.means.sum(1) + splats.scales.sum(1) + splats.quats.sum(1) + splats.colours.sum(1)
    return torch.isfinite(total) & (splats.log_opacities < torch.inf)


@torch.no_grad()
def in_front(splats: Splats, camera: Camera) -> Bool[Tensor, "N"]:
    """Splats deeper than the near plane. Selecting comes before any division (spec 12)."""
    rotation, translation = camera.rotation.to(splats.means), camera.translation.to(splats.means)
    return splats.means @ rotation[2] + translation[2] > camera.near


def project(splats: Splats, camera: Camera, settings: RasterSettings) -> ScreenSplats:
    """The usable splats in front of the near plane as the camera sees them; differentiable in every input."""
    finite = usable(splats)
    ids = (finite & in_front(splats, camera)).nonzero()[:, 0]
    points = splats.means[ids] @ camera.rotation.T.to(splats.means) + camera.translation.to(splats.means)
    focal = points.new_tensor([camera.fx, camera.fy])
    centre = points.new_tensor([camera.cx + camera.frame.left, camera.cy + camera.frame.top])
    p, q = screen_axes(splats, points, ids, camera, settings.jacobian_margin)
    covariances, factors = covariance_and_factor(p, q, settings.dilation)
    return ScreenSplats(
        ids=ids,
        means=points[:, :2] / points[:, 2:] * focal + centre,
        depths=points[:, 2],
        covariances=covariances,
        factors=factors,
        log_opacities=splats.log_opacities[ids],
        channels=splats.colours[ids],
        dropped=len(finite) - int(finite.sum()),
    )
