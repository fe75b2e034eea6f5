"""Splats of standard Gaussians for one camera."""

from torch import Tensor
from torch.nn.functional import logsigmoid

from gsx.core.data.camera import offsets_from
from gsx.core.gaussians.sh import colours_of, degree_of
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.shapes import Float


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
