"""Row surgery on parameters and their Adam state together, and the statistics that decide about it.

Every parameter of a table has one row per primitive and its own Adam group. Rows are appended with zero moments and
removed with their moments; a group's step count is never reset (spec 7, "Adam state"). A parameter touched by surgery
is a new leaf without gradient, so the optimiser leaves it alone until the next backward pass, as in the published code.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.core.rasterizer import ScreenStatistics
from gsx.core.shapes import Bool, Float, Int

ADAM_EPSILON = 1e-15
"""3D-GS: gradients of a mean loss are tiny (spec 6)."""


@dataclass(eq=False)
class Table:
    """Named parameters with N rows each, and the Adam that moves them."""

    parameters: dict[str, Parameter]
    optimiser: torch.optim.Adam = field(init=False)

    def __post_init__(self) -> None:
        groups = [{"params": [parameter], "name": name, "lr": 0.0} for name, parameter in self.parameters.items()]
        self.optimiser = torch.optim.Adam(groups, eps=ADAM_EPSILON, fused=True)

    def __len__(self) -> int:
        return len(next(iter(self.parameters.values())))

    def __getitem__(self, name: str) -> Parameter:
        return self.parameters[name]

    def set_rate(self, name: str, rate: float) -> None:
        """Learning rate of one parameter."""
        self.group(name)["lr"] = rate

    def group(self, name: str) -> dict:
        """The Adam group of one parameter."""
        return next(group for group in self.optimiser.param_groups if group["name"] == name)


def edit(table: Table, name: str, change: Callable[[Tensor], Tensor], moments: Callable[[Tensor], Tensor]) -> None:
    """Replace a parameter by `change` of it and its Adam moments by `moments` of them."""
    old = table.parameters[name]
    new = Parameter(change(old.detach()).contiguous())
    state = table.optimiser.state.pop(old, None)
    if state:
        table.optimiser.state[new] = {
            "step": state["step"],
            "exp_avg": moments(state["exp_avg"]).contiguous(),
            "exp_avg_sq": moments(state["exp_avg_sq"]).contiguous(),
        }
    table.group(name)["params"] = [new]
    table.parameters[name] = new


def appending(new: Tensor) -> Callable[[Tensor], Tensor]:
    """A function that appends `new` to the rows of a tensor."""
    return lambda old: torch.cat([old, new])


def append_rows(table: Table, rows: dict[str, Tensor]) -> None:
    """Append rows to every parameter; `rows` names all of them. New rows start with zero moments."""
    for name in table.parameters:
        edit(table, name, appending(rows[name]), appending(torch.zeros_like(rows[name])))


def keep_rows(table: Table, kept: Bool[Tensor, "N"]) -> None:
    """Keep the marked rows of every parameter, with their moments."""
    for name in table.parameters:
        edit(table, name, lambda old: old[kept], lambda moment: moment[kept])


def reset_column(table: Table, name: str, values: Tensor) -> None:
    """Replace all values of one parameter and zero its moments."""
    edit(table, name, lambda old: values, torch.zeros_like)


@dataclass(eq=False)
class Statistics:
    """Per-primitive sums over the training renders since the last density event."""

    gradient: Float[Tensor, "N"]
    """Sum of the norm of the screen gradient in NDC units."""
    count: Int[Tensor, "N"]
    """Renders in which the primitive was visible."""

    @staticmethod
    def zeros(count: int, device: torch.device | str) -> "Statistics":
        """Fresh statistics of `count` primitives."""
        return Statistics(torch.zeros(count, device=device), torch.zeros(count, dtype=torch.int32, device=device))

    def add(self, screen: ScreenStatistics) -> None:
        """Count one render in after its backward pass: a norm per view, visible primitives only (spec 4)."""
        visible = screen.visible
        rows = screen.ids[visible]
        self.gradient.index_add_(0, rows, screen.ndc_gradient(screen.shift)[visible].norm(dim=1).to(self.gradient))
        self.count[rows] += 1

    def mean_gradient(self) -> Float[Tensor, "N"]:
        """Mean norm over the renders that saw the primitive; 0 for unseen ones."""
        return self.gradient / self.count.clamp_min(1)
