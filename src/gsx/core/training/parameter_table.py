"""What a model learns: rows of parameters with their Adam state, edited together, and networks that all rows share.

Every parameter of a table has one row per primitive and its own Adam group. Rows are appended with zero moments, unless
others are given, and removed with their moments; a group's step count is never reset (3D-GS). A parameter touched by
surgery is a new leaf without gradient, so the optimiser leaves it alone until the next backward pass, as in the
published code.
"""

from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from gsx.core.errors import CheckpointError, ConfigError
from gsx.core.shapes import Bool

ADAM_EPSILON = 1e-15
"""Gradients of a mean loss are tiny (3D-GS, training_setup)."""


def group_named(optimiser: torch.optim.Adam, name: str) -> dict:
    """The group of one parameter or network."""
    return next(group for group in optimiser.param_groups if group["name"] == name)


@dataclass(eq=False)
class Networks:
    """Networks that all primitives share, and the Adam that moves them, with a group for each, at rate 0 at first."""

    modules: nn.Module
    """A network for each child; a learning rate is set by its name."""
    colour: nn.Module
    """Of them the one that makes colours, which pseudo views may leave alone."""
    optimiser: torch.optim.Adam = field(init=False)

    def __post_init__(self) -> None:
        parts = dict(self.modules.named_children())
        if outside := [name for name, _ in self.modules.named_parameters() if name.partition(".")[0] not in parts]:
            raise ConfigError(
                f"{' and '.join(outside)} of a backbone's networks would never learn: each child of `modules` has a "
                "learning rate, so put parameters into one, for example nn.ModuleDict({'colour': network})"
            )
        groups = [{"params": list(part.parameters()), "name": name, "lr": 0.0} for name, part in parts.items()]
        self.optimiser = torch.optim.Adam(groups, eps=ADAM_EPSILON, fused=True)

    def names(self) -> list[str]:
        """Names of the networks."""
        return [group["name"] for group in self.optimiser.param_groups]

    def set_rate(self, name: str, rate: float) -> None:
        """Learning rate of one network."""
        group_named(self.optimiser, name)["lr"] = rate

    def named(self) -> Iterator[tuple[str, Parameter]]:
        """Parameters by the names that they are saved under."""
        return ((f"heads.{name}", parameter) for name, parameter in self.modules.named_parameters())

    def buffers(self) -> Iterator[tuple[str, Tensor]]:
        """What networks keep beside parameters (means of a batch norm ...), by the names that it is saved under."""
        state = self.modules.state_dict(keep_vars=True).items()
        return (
            (f"buffers.{name}", value)
            for name, value in state
            if isinstance(value, Tensor) and not isinstance(value, Parameter)
        )


@dataclass(eq=False)
class ParameterTable:
    """Everything a model learns and knows: N rows of each parameter and of what belongs to them, and networks."""

    parameters: dict[str, Parameter]
    columns: dict[str, Tensor] = field(default_factory=dict)
    """Values with N rows that are not learnt, but drawn with: levels, filter sizes, positions on a grid."""
    statistics: dict[str, Tensor] = field(default_factory=dict)
    """Values with N rows that density control gathers; new rows begin with 0."""
    networks: Networks | None = None
    record: dict[str, Tensor] = field(default_factory=dict)
    """What density control has found and decided so far, without rows; entries may be added at any step."""
    pace: float = 1.0
    """All learning rates are multiplied by it (`training.cooldown`)."""
    optimiser: torch.optim.Adam = field(init=False)

    def __post_init__(self) -> None:
        groups = [{"params": [parameter], "name": name, "lr": 0.0} for name, parameter in self.parameters.items()]
        self.optimiser = torch.optim.Adam(groups, eps=ADAM_EPSILON, fused=True)

    def __len__(self) -> int:
        return len(next(iter(self.parameters.values())))

    @property
    def device(self) -> torch.device:
        """The device of all tensors."""
        return next(iter(self.parameters.values())).device

    def __getitem__(self, name: str) -> Tensor:
        return ChainMap[str, Tensor](self.parameters, self.columns, self.statistics)[name]  # type: ignore[arg-type]

    def set_rate(self, name: str, rate: float) -> None:
        """Learning rate of one parameter."""
        self.group(name)["lr"] = rate

    def group(self, name: str) -> dict:
        """The Adam group of one parameter."""
        return group_named(self.optimiser, name)


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


def append_rows(table: ParameterTable, rows: dict[str, Tensor], squares: Mapping[str, Tensor] | None = None) -> None:
    """Append rows to every parameter and column; `rows` names all of them. Moments and statistics begin with 0, second
    moments with `squares` where these are given."""
    count = len(next(iter(rows.values())))
    for name in table.parameters:
        edit(table, name, appending(rows[name]), appending(torch.zeros_like(rows[name])))
    for name, moments in (squares or {}).items():
        table.optimiser.state[table.parameters[name]]["exp_avg_sq"][-count:] = moments
    for name, column in table.columns.items():
        table.columns[name] = torch.cat([column, rows[name]])
    for name, sums in table.statistics.items():
        table.statistics[name] = torch.cat([sums, sums.new_zeros(count, *sums.shape[1:])])


def keep_rows(table: ParameterTable, kept: Bool[Tensor, "N"]) -> None:
    """Keep the marked rows of every parameter, with their moments, of every column, and of the statistics."""
    for name in table.parameters:
        edit(table, name, lambda old: old[kept], lambda moment: moment[kept])
    for name, column in table.columns.items():
        table.columns[name] = column[kept]
    for name, sums in table.statistics.items():
        table.statistics[name] = sums[kept]


def detached_rows(table: ParameterTable) -> dict[str, Tensor]:
    """All parameters and columns by name, without gradient: what `append_rows` wants rows of."""
    return {name: parameter.detach() for name, parameter in table.parameters.items()} | table.columns


def second_moments(table: ParameterTable) -> dict[str, Tensor]:
    """Those of Adam by the name of the parameter, of parameters that have learnt."""
    states = {name: table.optimiser.state.get(parameter) for name, parameter in table.parameters.items()}
    return {name: state["exp_avg_sq"] for name, state in states.items() if state}


def reset_column(table: ParameterTable, name: str, values: Tensor) -> None:
    """Replace all values of one parameter and zero its moments."""
    edit(table, name, lambda old: values, torch.zeros_like)


def adam_tensors(name: str, parameter: Parameter, optimiser: torch.optim.Adam) -> dict[str, Tensor]:
    """Adam's step count and moments of one parameter, by the names they are saved under; none before its first step."""
    return {f"adam.{name}.{key}": value for key, value in optimiser.state.get(parameter, {}).items()}


def restore_adam(
    name: str, parameter: Parameter, optimiser: torch.optim.Adam, tensors: dict[str, Tensor], device: torch.device
) -> None:
    """Take back what `adam_tensors` gave."""
    if f"adam.{name}.step" in tensors:
        shapes = {"step": torch.Size(), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
        state = {key: saved(f"adam.{name}.{key}", shape, tensors) for key, shape in shapes.items()}
        optimiser.state[parameter] = {key: value.to(device) for key, value in state.items()}


def saved(name: str, shape: torch.Size, tensors: dict[str, Tensor]) -> Tensor:
    """A tensor of a checkpoint.

    Raises:
        CheckpointError: there is none of that shape.
    """
    if name not in tensors or tensors[name].shape != shape:
        raise CheckpointError(f"the checkpoint holds no {name} of shape {list(shape)}: remove it to use an older one")
    return tensors[name]


def named_parameters(table: ParameterTable) -> list[tuple[str, Parameter]]:
    """Name and value of everything that is learnt, in the same order on every process."""
    return [*table.parameters.items(), *(table.networks.named() if table.networks else ())]


def gradients(table: ParameterTable) -> dict[str, Tensor]:
    """Gradients by name, of the parameters that have one."""
    return {name: parameter.grad for name, parameter in named_parameters(table) if parameter.grad is not None}


def shared_colour(table: ParameterTable) -> list[Parameter]:
    """Parameters of colour that all primitives share; pseudo views may leave them alone."""
    return [] if table.networks is None else list(table.networks.colour.parameters())


def zero_grad(table: ParameterTable) -> None:
    """Clear all gradients without moving anything."""
    for _, parameter in named_parameters(table):
        parameter.grad = None


def take_adam_step(table: ParameterTable) -> None:
    """Move everything that has a gradient by the learning rates set, times the table's pace; then clear the
    gradients."""
    networks = [] if table.networks is None else [table.networks.optimiser]
    for optimiser in [table.optimiser, *networks]:
        with paced(optimiser, table.pace):
            optimiser.step()
    zero_grad(table)


@contextmanager
def paced(optimiser: torch.optim.Optimizer, pace: float) -> Iterator[None]:
    """Learning rates are multiplied by that for a while."""
    rates = [group["lr"] for group in optimiser.param_groups]
    try:
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = pace * rate
        yield
    finally:
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate


def size_of(table: ParameterTable) -> tuple[int, int]:
    """(rows, bytes of what a render needs: parameters, columns and networks)."""
    needed = [*(parameter for _, parameter in named_parameters(table)), *table.columns.values()]
    return len(table), sum(value.numel() * value.element_size() for value in needed)


# -- checkpoints -------------------------------------------------------------------------------------------------------


RECORD = "record."
"""Before the names that entries of a record are saved under."""


def table_tensors(table: ParameterTable) -> dict[str, Tensor]:
    """Everything of a table, by the names it is saved under."""
    out = {f"columns.{name}": column for name, column in table.columns.items()}
    out |= {f"statistics.{name}": sums for name, sums in table.statistics.items()}
    out |= {f"{RECORD}{name}": found for name, found in table.record.items()}
    for name, parameter in table.parameters.items():
        out[f"parameters.{name}"] = parameter.detach()
        out |= adam_tensors(name, parameter, table.optimiser)
    if (networks := table.networks) is not None:
        for name, parameter in networks.named():
            out[name] = parameter.detach()
            out |= adam_tensors(name, parameter, networks.optimiser)
        out |= {name: buffer.detach() for name, buffer in networks.buffers()}
    return out


def restored_table(like: ParameterTable, tensors: dict[str, Tensor]) -> ParameterTable:
    """The table that `table_tensors` saw, whatever its number of rows, with all that `like` has and its learning rates.
    Of the record all that was saved comes back, whether `like` has it by now or not.

    Raises:
        CheckpointError: something of it was not saved: the run had other options.
    """
    if "sh_dc" in like.parameters and "parameters.sh_dc" not in tensors:  # as it was called once
        tensors = {name.replace(".sh_constant", ".sh_dc"): value for name, value in tensors.items()}
    found = {kind: saved_rows(kind, vars(like)[kind], tensors) for kind in ("parameters", "columns", "statistics")}
    device = like.device
    rows = {kind: {name: value.to(device) for name, value in values.items()} for kind, values in found.items()}
    parameters = {name: Parameter(value) for name, value in rows["parameters"].items()}
    written = {name[len(RECORD) :]: value.to(device) for name, value in tensors.items() if name.startswith(RECORD)}
    record = written | {name: written.get(name, found).to(found) for name, found in like.record.items()}
    table = ParameterTable(parameters, rows["columns"], rows["statistics"], like.networks, record)
    for name, parameter in table.parameters.items():
        table.set_rate(name, like.group(name)["lr"])
        restore_adam(name, parameter, table.optimiser, tensors, device)
    if (networks := table.networks) is not None:
        for name, parameter in networks.named():
            parameter.data.copy_(saved(name, parameter.shape, tensors))
            restore_adam(name, parameter, networks.optimiser, tensors, device)
        for name, buffer in networks.buffers():
            buffer.copy_(saved(name, buffer.shape, tensors))
    return table


def saved_rows(kind: str, like: dict[str, Tensor], tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The saved values of one kind, by name; older checkpoints hold some statistics as columns."""
    kinds = (kind, "columns") if kind == "statistics" else (kind,)
    names = {name: next((f"{k}.{name}" for k in kinds if f"{k}.{name}" in tensors), "") for name in like}
    missing = [name for name, key in names.items() if not key]
    if missing:
        raise CheckpointError(
            f"the checkpoint holds no {' and no '.join(missing)}: it was trained with other options of the backbone; "
            "go on with those, or train anew"
        )
    return {name: tensors[key] for name, key in names.items()}
