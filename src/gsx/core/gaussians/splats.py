"""Gaussians as input of the rasterizer, and as parameters of a standard splat file."""

from dataclasses import dataclass

from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.core.data.camera import offsets_from
from gsx.core.gaussians.sh import colours_of, degree_of
from gsx.core.shapes import Float


@dataclass(frozen=True, eq=False, kw_only=True)
class Splats:
    """N Gaussians with C channels for the rasterizer, differentiable in every field; N may be 0."""

    means: Float[Tensor, "N 3"]
    """World positions."""
    scales: Float[Tensor, "N 3"]
    """Standard deviations along the principal axes, world units, >= 0."""
    quats: Float[Tensor, "N 4"]
    """Rotations (w, x, y, z) of any length; the zero quaternion is the identity."""
    log_opacities: Float[Tensor, "N"]
    """ln of the opacity, <= 0, from logsigmoid of the raw parameter."""
    colours: Float[Tensor, "N C"]
    """Colour or other channels to blend."""

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True, eq=False, kw_only=True)
class Gaussians:
    """N Gaussians in the raw parameters of a standard splat file, with B harmonics besides the constant one."""

    means: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    opacity_logits: Float[Tensor, "N"]
    sh_dc: Float[Tensor, "N 3"]
    sh_rest: Float[Tensor, "N B 3"]


def splats_of(gaussians: Gaussians, camera_centre: Float[Tensor, "3"]) -> Splats:
    """Returns the splats for a camera at `camera_centre`, with all bands of harmonics."""
    degree, offsets = degree_of(gaussians.sh_rest.shape[1]), offsets_from(gaussians.means, camera_centre)
    return Splats(
        means=gaussians.means,
        scales=gaussians.log_scales.exp(),
        quats=gaussians.quats,
        log_opacities=logsigmoid(gaussians.opacity_logits),
        colours=colours_of(gaussians.sh_dc[:, None], gaussians.sh_rest, offsets, degree),
    )
