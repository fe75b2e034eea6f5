"""Row surgery on parameters and their Adam state together, and the statistics that decide about it.

Every parameter of a table has one row per primitive and its own Adam group. Rows are appended with zero moments and
removed with their moments; a group's step count is never reset (3D-GS). A parameter touched by surgery
is a new leaf without gradient, so the optimiser leaves it alone until the next backward pass, as in the published code.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.core.errors import CheckpointError
from gsx.core.rasterizer import ScreenStatistics
from gsx.core.shapes import Bool, Float, Int

ADAM_EPSILON = 1e-15
"""Gradients of a mean loss are tiny (3D-GS, training_setup)."""


@dataclass(eq=False)
class ParameterTable:
    """Named parameters with N rows each, and the Adam that moves them."""

    parameters: dict[str, Parameter]
    columns: dict[str, Tensor] = field(default_factory=dict)
    """Values with N rows that are not learnt: levels, filter sizes, positions on a grid, statistics."""
    optimiser: torch.optim.Adam = field(init=False)

    def __post_init__(self) -> None:
        groups = [{"params": [parameter], "name": name, "lr": 0.0} for name, parameter in self.parameters.items()]
        self.optimiser = torch.optim.Adam(groups, eps=ADAM_EPSILON, fused=True)

    def __len__(self) -> int:
        return len(next(iter(self.parameters.values())))

    def __getitem__(self, name: str) -> Tensor:
        return self.parameters[name] if name in self.parameters else self.columns[name]

    def set_rate(self, name: str, rate: float) -> None:
        """Learning rate of one parameter."""
        self.group(name)["lr"] = rate

    def group(self, name: str) -> dict:
        """The Adam group of one parameter."""
        return next(group for group in self.optimiser.param_groups if group["name"] == name)


def edit(
    table: ParameterTable, name: str, change: Callable[[Tensor], Tensor], moments: Callable[[Tensor], Tensor]
) -> None:
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


def append_rows(table: ParameterTable, rows: dict[str, Tensor]) -> None:
    """Append rows to every parameter and column; `rows` names all of them. New rows start with zero moments."""
    for name in table.parameters:
        edit(table, name, appending(rows[name]), appending(torch.zeros_like(rows[name])))
    for name, column in table.columns.items():
        table.columns[name] = torch.cat([column, rows[name]])


def keep_rows(table: ParameterTable, kept: Bool[Tensor, "N"]) -> None:
    """Keep the marked rows of every parameter, with their moments, and of every column."""
    for name in table.parameters:
        edit(table, name, lambda old: old[kept], lambda moment: moment[kept])
    for name, column in table.columns.items():
        table.columns[name] = column[kept]


def detached_rows(table: ParameterTable) -> dict[str, Tensor]:
    """All parameters and columns by name, without gradient: what `append_rows` wants rows of."""
    return {name: parameter.detach() for name, parameter in table.parameters.items()} | table.columns


def room_under(cap: int, count: int) -> int:
    """Rows that may be added to `count` of them under a cap; a cap of 0 is none."""
    return max(0, cap - count) if cap else sys.maxsize


def within_room(chosen: Bool[Tensor, "N"], gradient: Float[Tensor, "N"], room: int) -> Bool[Tensor, "N"]:
    """Of the chosen rows those with the largest gradients, at most `room`."""
    if int(chosen.sum()) <= room:
        return chosen
    ranked = torch.where(chosen, gradient, -1.0).argsort(descending=True, stable=True)[:room]
    return torch.zeros_like(chosen).index_fill_(0, ranked, True)


def withheld(wanted: Bool[Tensor, "N"], chosen: Bool[Tensor, "N"]) -> dict[str, int]:
    """How many of the rows wanted a cap has kept out, for the changes of a step; nothing where it let all in."""
    count = int(wanted.sum()) - int(chosen.sum())
    return {"withheld": count} if count else {}


def reset_column(table: ParameterTable, name: str, values: Tensor) -> None:
    """Replace all values of one parameter and zero its moments."""
    edit(table, name, lambda old: values, torch.zeros_like)


def finite_rows(table: ParameterTable) -> Bool[Tensor, "N"]:
    """Rows whose parameters are finite in every value."""
    flat = [parameter.detach().reshape(len(parameter), -1) for parameter in table.parameters.values()]
    return torch.stack([torch.isfinite(values).all(1) for values in flat]).all(0)


def adam_tensors(name: str, parameter: Parameter, optimiser: torch.optim.Adam) -> dict[str, Tensor]:
    """Adam's step count and moments of one parameter, by the names they are saved under; none before its first step."""
    return {f"adam.{name}.{key}": value for key, value in optimiser.state.get(parameter, {}).items()}


def restore_adam(
    name: str, parameter: Parameter, optimiser: torch.optim.Adam, tensors: dict[str, Tensor], device: torch.device
) -> None:
    """Take back what `adam_tensors` gave."""
    if f"adam.{name}.step" in tensors:
        state = {key: tensors[f"adam.{name}.{key}"] for key in ("step", "exp_avg", "exp_avg_sq")}
        optimiser.state[parameter] = {key: value.to(device) for key, value in state.items()}


def table_tensors(table: ParameterTable) -> dict[str, Tensor]:
    """Everything of a table, by the names it is saved under."""
    out = {f"columns.{name}": column for name, column in table.columns.items()}
    for name, parameter in table.parameters.items():
        out[f"parameters.{name}"] = parameter.detach()
        out |= adam_tensors(name, parameter, table.optimiser)
    return out


def restored_table(like: ParameterTable, tensors: dict[str, Tensor], device: torch.device) -> ParameterTable:
    """The table that `table_tensors` saw, with the parameters and columns of `like`.

    Raises:
        CheckpointError: one of them was not saved: the run had other options.
    """
    wanted = [*(f"parameters.{name}" for name in like.parameters), *(f"columns.{name}" for name in like.columns)]
    missing = [name.partition(".")[2] for name in wanted if name not in tensors]
    if missing:
        raise CheckpointError(
            f"the checkpoint holds no {' and no '.join(missing)}: it was trained with other options of the backbone; "
            "go on with those, or train anew"
        )
    table = ParameterTable(
        {name: Parameter(tensors[f"parameters.{name}"].to(device)) for name in like.parameters},
        {name: tensors[f"columns.{name}"].to(device) for name in like.columns},
    )
    for name, parameter in table.parameters.items():
        restore_adam(name, parameter, table.optimiser, tensors, device)
    return table


def densification_statistics(
    screen: ScreenStatistics, drawn: Int[Tensor, "N"] | None = None, weight: float = 1.0
) -> dict[str, Tensor]:
    """Of one render after its backward pass the visible primitives, and the norms of their gradients (3D-GS).

    `drawn`: rows of the splats that were rendered; None: splat n is row n. `weight`: see `Statistics`.
    """
    visible = screen.visible
    ids = screen.ids[visible]
    seen = {
        "rows": ids if drawn is None else drawn[ids],
        "gradient": screen.ndc_gradient(screen.means2d_offset)[visible].norm(dim=1),
        "weight": screen.means2d_offset.new_tensor([weight]),
    }
    return seen if screen.absgrad is None else seen | {"absolute": screen.ndc_gradient(screen.absgrad)[visible].sum(1)}


def mean_of(sums: Float[Tensor, "*N"], counts: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """Sums over sums of weights; where nothing was counted the sum itself, which is 0."""
    return sums / torch.where(counts > 0, counts, 1.0)


@dataclass(eq=False)
class Statistics:
    """Per-primitive sums over the renders since the last density event, each counted by its weight in a step's loss.

    The photograph of a step of one view weighs 1; of n views each weighs 1 / n; a pseudo view weighs what its mean
    difference does in the loss, and photographs what is left to them. Gradients are those of the step's loss, so they
    carry that weight too: sums of both have a mean as large as that of single photographs, which published thresholds
    are made for, whatever the batch and the augmenters.
    """

    gradient: Float[Tensor, "N"]
    """Sum of the norm of the screen gradient in NDC units."""
    count: Float[Tensor, "N"]
    """Sum of the weights of the renders in which the primitive was visible: steps, where all see it."""
    absolute: Float[Tensor, "N"] | None = None
    """Sum of |g_x| + |g_y| over pixels, NDC units, where it is gathered (Mip-Splatting, densify_and_prune)."""

    @staticmethod
    def zeros(count: int, device: torch.device | str, absolute: bool = False) -> "Statistics":
        """Fresh statistics of `count` primitives."""
        sums = torch.zeros(count, device=device)
        return Statistics(sums, torch.zeros_like(sums), torch.zeros_like(sums) if absolute else None)

    def add(self, seen: dict[str, Tensor]) -> None:
        """Count in what `densification_statistics` found in one render."""
        rows = seen["rows"]
        self.gradient.index_add_(0, rows, seen["gradient"].to(self.gradient))
        self.count[rows] += seen["weight"].to(self.count)
        if self.absolute is not None and "absolute" in seen:
            self.absolute.index_add_(0, rows, seen["absolute"].to(self.absolute))

    def mean_gradient(self) -> Float[Tensor, "N"]:
        """Weighted mean norm over the renders that saw the primitive; 0 for unseen ones."""
        return mean_of(self.gradient, self.count)

    def mean_absolute(self) -> Float[Tensor, "N"]:
        """The same of the absolute gradients; 0 where they are not gathered."""
        return torch.zeros_like(self.gradient) if self.absolute is None else mean_of(self.absolute, self.count)

    def rows(self, kept: Bool[Tensor, "N"]) -> "Statistics":
        """Those of the marked primitives."""
        return Statistics(**{name: value[kept] for name, value in vars(self).items() if value is not None})

    def tensors(self) -> dict[str, Tensor]:
        """By the names they are saved under."""
        return {f"statistics.{name}": value for name, value in vars(self).items() if value is not None}

    @staticmethod
    def restored(tensors: dict[str, Tensor], device: torch.device) -> "Statistics":
        """What `tensors` gave."""
        found = {name: tensors.get(f"statistics.{name}") for name in ("gradient", "count", "absolute")}
        return Statistics(**{name: value.to(device) for name, value in found.items() if value is not None})
