"""Gaussians far away that stand behind the scene, and what density control leaves alone of them."""

import logging

import torch
from torch import Tensor

from gsx.core.data.scene import PointCloud, Scene
from gsx.core.data.sky import Sky, sky_of
from gsx.core.shapes import Bool
from gsx.core.training.parameter_table import ParameterTable

logger = logging.getLogger(__name__)

SKY_OPACITY = 0.98
"""At first: nothing near has to be made up in its place."""
WIDEST = 1.5
"""Largest size of a Gaussian of the sky at first, in spacings of directions: one whose neighbours are far off
would cover what is beside it."""
OPEN = 0.01
"""`sky=auto`: share of the pixels that look past the scene, from which on something stands behind it."""
NOTHING = Sky(points=PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)), spacing=1.0, share=0.0)


def sky_behind(scene: Scene, when: str) -> Sky:
    """What stands behind a scene; with `auto` nothing where photographs hardly look past it."""
    found = sky_of(scene)
    wanted = when == "always" or found.share >= OPEN
    verdict = f"{len(found.points):,} Gaussians far away stand behind it" if wanted else "nothing stands behind it"
    logger.info("sky: %.1f %% of the pixels of training views look past the scene: %s", 100 * found.share, verdict)
    return found if wanted else NOTHING


def not_sky(table: ParameterTable) -> Bool[Tensor, "N"]:
    """Rows of the scene itself: density control neither splits sky nor prunes it for its size."""
    if "sky" in table.columns:
        return table["sky"] == 0
    return torch.ones(len(table), dtype=torch.bool, device=table["means"].device)
