"""Gaussians: as the rasterizer draws them, and as a standard file holds them."""

from dataclasses import dataclass

from torch import Tensor

from gsx.core.shapes import Float


@dataclass(frozen=True, eq=False, kw_only=True)
class Splats:
    """Explicit Gaussians, differentiable in every field. N splats with C channels; N may be 0."""

    means: Float[Tensor, "N 3"]
    """World positions."""
    scales: Float[Tensor, "N 3"]
    """Standard deviations along the principal axes, world units, >= 0."""
    quats: Float[Tensor, "N 4"]
    """Rotations (w, x, y, z); need not be unit, a zero quaternion is the identity."""
    log_opacities: Float[Tensor, "N"]
    """ln of the opacity, <= 0. From logsigmoid of the raw parameter, never the log of a rounded probability."""
    colours: Float[Tensor, "N C"]
    """Colour or any other channels to blend."""

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True, eq=False, kw_only=True)
class Gaussians:
    """Explicit Gaussians in the raw parameters of a standard splat file."""

    means: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    opacity_logits: Float[Tensor, "N"]
    sh_dc: Float[Tensor, "N 3"]
    sh_rest: Float[Tensor, "N B 3"]
