"""A standard splat file for all views, made from a model that decodes its splats anew for every camera.

Each splat is followed over the training cameras. It keeps its mean opacity (0 where it is not drawn), its mean
covariance, and harmonics fitted to its colours by least squares, weighted by opacity, with a ridge on the higher
bands. Its level of detail is that of the cameras, as they are or zoomed.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsx.core.data.camera import Camera, offsets_from
from gsx.core.errors import InputError
from gsx.core.gaussians.quaternions import quaternions_of, rotation_matrices
from gsx.core.gaussians.sh import BAND_0, harmonics
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.shapes import Float, Int
from gsx.core.training.backbone import Bakeable
from gsx.core.training.run import Run
from gsx.formats.smoothing import logit_of_log

DEGREE = 2
"""Degree of the harmonics."""
RIDGE = 0.03
"""Ridge in units of one camera that draws the splat at full opacity, times l (l + 1) for band l."""
FAINTEST = 1 / 255
"""Splats of a lower mean opacity are left out: nothing draws them (3D-GS)."""
MOST_CAMERAS = 200
"""Training cameras, evenly over all."""


@dataclass(eq=False)
class Sums:
    """Sums over cameras for S splats with B basis functions."""

    visits: Float[Tensor, "S"]
    weights: Float[Tensor, "S"]
    """Sums of opacities."""
    means: Float[Tensor, "S 3"]
    covariances: Float[Tensor, "S 3 3"]
    normal: Float[Tensor, "S B B"]
    """Weighted products of basis functions."""
    right: Float[Tensor, "S B 3"]
    """Weighted products of basis functions and colours."""

    @classmethod
    def of(cls, slots: int, device: torch.device) -> "Sums":
        """Return sums over no camera."""
        size = (DEGREE + 1) ** 2
        shapes = ((), (), (3,), (3, 3), (size, size), (size, 3))
        return cls(*(torch.zeros(slots, *shape, device=device) for shape in shapes))

    def add(self, splats: Splats, slots: Int[Tensor, "M"], visited: Int[Tensor, "V"], camera: Camera) -> None:
        """Add what one camera draws; `visited`: what it could have drawn."""
        weight = splats.log_opacities.exp()
        directions = normalize(offsets_from(splats.means, camera.centre), dim=1)
        basis = torch.cat([torch.full_like(weight[:, None], BAND_0), harmonics(directions, DEGREE)], 1)
        axes = rotation_matrices(splats.quats) * splats.scales[:, None]
        self.visits.index_add_(0, visited, torch.ones_like(visited, dtype=torch.float32))
        self.weights.index_add_(0, slots, weight)
        self.means[slots] = splats.means
        self.covariances.index_add_(0, slots, weight[:, None, None] * (axes @ axes.mT))
        weighted = weight[:, None] * basis
        self.normal.index_add_(0, slots, weighted[:, :, None] * basis[:, None])
        self.right.index_add_(0, slots, weighted[:, :, None] * (splats.colours - 0.5)[:, None])

    def gaussians(self) -> Gaussians:
        """Return the splats that are not too faint."""
        opacity = self.weights / self.visits.clamp_min(1)
        kept = opacity >= FAINTEST
        weights = self.weights[kept]
        scales, quats = principal_axes(self.covariances[kept] / weights[:, None, None])
        bands = torch.tensor([band for band in range(DEGREE + 1) for _ in range(2 * band + 1)], device=opacity.device)
        ridge = torch.diag((RIDGE * bands * (bands + 1)).clamp_min(1e-6))
        harmonics_ = torch.linalg.solve(self.normal[kept] + ridge, self.right[kept])
        return Gaussians(
            means=self.means[kept],
            log_scales=scales.log(),
            quats=quats,
            opacity_logits=logit_of_log(opacity[kept].clamp(max=1).log()),
            sh_dc=harmonics_[:, 0],
            sh_rest=harmonics_[:, 1:],
        )


def principal_axes(covariances: Float[Tensor, "N 3 3"]) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
    """Return (standard deviations along the principal axes, rotations as quaternions) of covariance matrices."""
    squares, axes = torch.linalg.eigh(covariances.double())
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # a rotation, not a reflection
    least = squares.amax(1, keepdim=True) * 1e-12
    return squares.maximum(least).clamp_min(1e-30).sqrt().float(), quaternions_of(axes).float()


@torch.no_grad()
def bake(run: Run, zoom: float = 1.0) -> Gaussians:
    """Return Gaussians for all views, as training cameras draw them at `zoom` times their resolution.

    Raises:
        InputError: the backbone has no identities of splats, or no camera draws any.
    """
    backbone = run.backbone
    if not isinstance(backbone, Bakeable):
        name = run.config["backbone"]["name"]
        raise InputError(f"backbone {name} cannot be baked: its splats have no identity; give --view NAME")
    sums = Sums.of(backbone.slot_count(), run.device)
    cameras = [view.camera for view in run.scene.train]
    count = min(len(cameras), MOST_CAMERAS)
    for index in range(count):
        camera = cameras[index * len(cameras) // count].zoom(zoom)
        drawn = backbone.draw(camera, run.model_step)
        sums.add(drawn.splats, *backbone.slots(drawn), camera)
    if not bool((sums.weights > 0).any()):
        raise InputError("no training camera draws any splat of this model: there is nothing to bake")
    return sums.gaussians()
