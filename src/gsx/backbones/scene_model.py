"""What free Gaussians and anchors share as models of a scene."""

from collections.abc import Sequence

from torch import Tensor

from gsx.backbones.capacity import Capacity
from gsx.backbones.mip import Filter
from gsx.backbones.sky import far_away
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import BackboneContext
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.pseudo_views import PseudoView


class SceneModel:
    """A model with a capacity and a filter."""

    table: ParameterTable
    context: BackboneContext
    capacity: Capacity
    filter: Filter

    def validation_window(self, view: View, step: int) -> Window | None:
        """Returns the window that capacity is measured by."""
        return self.capacity.validation_window(self.table, view, step)

    def pseudo_views_made(self, views: Sequence[PseudoView], step: int) -> None:
        """Hands new pseudo views to the filter."""
        self.filter.pseudo_views_made(views)

    def behind_scene(self, means: Float[Tensor, "M 3"]) -> Bool[Tensor, "M"]:
        """Marks splats that stand where a sky does."""
        return far_away(means, self.context.scene)
