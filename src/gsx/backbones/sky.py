"""Gaussians far away that stand behind the scene, and what density control leaves alone of them."""

import logging

import torch
from torch import Tensor

from gsx.core.data.scene import PointCloud, Scene
from gsx.core.data.sky import sky_of
from gsx.core.shapes import Bool
from gsx.core.training.parameter_table import ParameterTable

logger = logging.getLogger(__name__)

SKY_OPACITY = 0.98
"""At first: nothing near has to be made up in its place."""
OPEN = 0.01
"""`sky=auto`: share of the pixels that look past the scene, from which on something stands behind it."""
NO_POINTS = PointCloud(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))


def sky_behind(scene: Scene, when: str) -> PointCloud:
    """Points of what stands behind a scene; with `auto` none where photographs hardly look past it."""
    found, share = sky_of(scene)
    wanted = when == "always" or share >= OPEN
    verdict = f"{len(found):,} Gaussians far away stand behind it" if wanted else "nothing stands behind it"
    logger.info("sky: %.1f %% of the pixels of training views look past the scene: %s", 100 * share, verdict)
    return found if wanted else NO_POINTS


def beneath_sky(table: ParameterTable) -> Bool[Tensor, "N"]:
    """Rows of the scene itself: those of the sky neither grow nor are too large."""
    if "sky" in table.columns:
        return table["sky"] == 0
    return torch.ones(len(table), dtype=torch.bool, device=table["means"].device)
