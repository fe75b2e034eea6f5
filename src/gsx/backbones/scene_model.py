"""Common base of free Gaussians and anchors."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.backbones.capacity import Capacity
from gsx.backbones.mip import Filter
from gsx.backbones.sky import far_away
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.gaussians.quaternions import make_identity_where_zero
from gsx.core.quality.losses import volume_loss
from gsx.core.shapes import Bool, Float
from gsx.core.training.backbone import BackboneContext, Drawn
from gsx.core.training.parameter_table import Networks, ParameterTable, take_adam_step
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.schedule import Schedule


class SceneModel(ABC):
    """A model with a table, a capacity and a filter."""

    table: ParameterTable
    context: BackboneContext
    capacity: Capacity
    filter: Filter
    schedule: Schedule
    volume_weight: float
    """Weight of the mean volume of the drawn Gaussians in the loss."""
    sh_degree: int
    sh_every: int
    """Published steps between SH degrees."""
    first_degree = 0
    """SH degree at the start."""

    def new_table(
        self,
        parameters: dict[str, Tensor],
        columns: dict[str, Tensor],
        statistics: dict[str, Tensor],
        networks: Networks | None = None,
    ) -> ParameterTable:
        """Builds a table on the context's device."""
        device = self.context.device
        table = ParameterTable(
            {name: Parameter(value.to(device)) for name, value in parameters.items()},
            {name: value.to(device) for name, value in columns.items()},
            statistics,
            networks,
            former_names={"sh_dc": "sh_constant"},
        )
        self.capacity.initialise(table)
        return table

    def active_degree(self, step: int) -> int:
        """Returns the SH degree at a step (3D-GS, sh_utils.py)."""
        return max(self.first_degree, min(self.sh_degree, step // max(1, self.schedule.step(self.sh_every))))

    def regulariser(self, drawn: Drawn) -> Float[Tensor, ""] | None:
        """Returns the weighted mean volume of the drawn Gaussians, 0 for none; without a weight None."""
        return volume_loss(drawn.splats.scales, self.volume_weight) if self.volume_weight else None

    def zero_filled(self) -> Iterable[Parameter]:
        """Returns the parameters that take their Adam step with a zero gradient if the loss has none: all."""
        return self.table.parameters.values()

    @abstractmethod
    def set_rates(self, step: int) -> None:
        """Sets the learning rates of a step."""

    def update(self, step: int) -> None:
        """Takes one Adam step; parameters that rest in the loss have zero gradients, as in the published code."""
        if any(parameter.grad is not None for parameter in self.table.parameters.values()):
            for parameter in self.zero_filled():
                parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        self.set_rates(step)
        take_adam_step(self.table)
        if "quats" in self.table.parameters:
            make_identity_where_zero(self.table["quats"])

    def validation_window(self, view: View, step: int) -> Window | None:
        """Returns the view's window that is held out to measure capacity."""
        return self.capacity.validation_window(self.table, view, step)

    def pseudo_views_made(self, views: Sequence[PseudoView], step: int) -> None:
        """Passes new pseudo views to the filter."""
        self.filter.pseudo_views_made(views)

    def behind_scene(self, means: Float[Tensor, "M 3"]) -> Bool[Tensor, "M"]:
        """Marks splats as far away as a sky."""
        return far_away(means, self.context.scene)
