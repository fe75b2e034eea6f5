"""Learned state of a model: rows of parameters with their Adam state, and networks that all rows share.

Every parameter has one row per primitive and its own Adam group. Appended rows get zero moments by default, removed
rows lose theirs; a group's step count is never reset (3D-GS). An edited parameter is a new leaf without gradient, so
Adam leaves it alone until the next backward pass, as in the published code.
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
RECORD = "record."
"""Prefix of the record's entries in checkpoints."""


def adam(groups: Mapping[str, list[Parameter]]) -> torch.optim.Adam:
    """Returns an Adam with a named group for each list of parameters, at rate 0."""
    named = [{"params": parameters, "name": name, "lr": 0.0} for name, parameters in groups.items()]
    return torch.optim.Adam(named, eps=ADAM_EPSILON, fused=True)


def group_of(optimiser: torch.optim.Adam, name: str) -> dict:
    """Returns the group of one parameter or network."""
    return next(group for group in optimiser.param_groups if group["name"] == name)


@dataclass(eq=False)
class Networks:
    """Networks that all primitives share, with an Adam group for each, at first at rate 0."""

    modules: nn.Module
    """Each child is a network with a learning rate of its own."""
    colour: nn.Module
    """The colour network among them; pseudo views may leave it alone."""
    optimiser: torch.optim.Adam = field(init=False)

    def __post_init__(self) -> None:
        parts = dict(self.modules.named_children())
        if outside := [name for name, _ in self.modules.named_parameters() if name.partition(".")[0] not in parts]:
            raise ConfigError(
                f"{' and '.join(outside)} of a backbone's networks would never learn: each child of `modules` has a "
                "learning rate, so put parameters into one, for example nn.ModuleDict({'colour': network})"
            )
        self.optimiser = adam({name: list(part.parameters()) for name, part in parts.items()})

    def names(self) -> list[str]:
        """Returns the names of the networks."""
        return [group["name"] for group in self.optimiser.param_groups]

    def set_rate(self, name: str, rate: float) -> None:
        """Sets the learning rate of one network."""
        group_of(self.optimiser, name)["lr"] = rate

    def named(self) -> Iterator[tuple[str, Parameter]]:
        """Yields parameters with their names in checkpoints."""
        return ((f"heads.{name}", parameter) for name, parameter in self.modules.named_parameters())

    def buffers(self) -> Iterator[tuple[str, Tensor]]:
        """Yields buffers (means of a batch norm ...) with their names in checkpoints."""
        state = self.modules.state_dict(keep_vars=True).items()
        return (
            (f"buffers.{name}", value)
            for name, value in state
            if isinstance(value, Tensor) and not isinstance(value, Parameter)
        )


@dataclass(eq=False)
class ParameterTable:
    """Learned state of a model: N rows of each parameter, column and statistic, networks, and a record."""

    parameters: dict[str, Parameter]
    columns: dict[str, Tensor] = field(default_factory=dict)
    """Fixed values with N rows that rendering needs: levels, filter sizes, positions on a grid."""
    statistics: dict[str, Tensor] = field(default_factory=dict)
    """Values with N rows that density control accumulates; 0 in new rows."""
    networks: Networks | None = None
    record: dict[str, Tensor] = field(default_factory=dict)
    """State of density control without rows; entries may be added at any step."""
    pace: float = 1.0
    """Factor of all learning rates (`training.cooldown`)."""
    former_names: Mapping[str, str] = field(default_factory=dict)
    """Names of parameters in old checkpoints, by current name."""
    optimiser: torch.optim.Adam = field(init=False)

    def __post_init__(self) -> None:
        self.optimiser = adam({name: [parameter] for name, parameter in self.parameters.items()})

    def __len__(self) -> int:
        return len(next(iter(self.parameters.values())))

    @property
    def device(self) -> torch.device:
        """Device of all tensors."""
        return next(iter(self.parameters.values())).device

    def __getitem__(self, name: str) -> Tensor:
        return ChainMap[str, Tensor](self.parameters, self.columns, self.statistics)[name]  # type: ignore[arg-type]

    def set_rate(self, name: str, rate: float) -> None:
        """Sets the learning rate of one parameter."""
        self.group(name)["lr"] = rate

    def group(self, name: str) -> dict:
        """Returns the Adam group of one parameter."""
        return group_of(self.optimiser, name)


# -- rows --------------------------------------------------------------------------------------------------------------


def edit(
    table: ParameterTable, name: str, change: Callable[[Tensor], Tensor], moments: Callable[[Tensor], Tensor]
) -> None:
    """Applies `change` to a parameter and `moments` to its Adam moments."""
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
    """Returns a function that appends `new` to the rows of a tensor."""
    return lambda old: torch.cat([old, new])


def append_rows(table: ParameterTable, rows: dict[str, Tensor]) -> None:
    """Appends rows to all parameters and columns, with zero statistics and moments."""
    count = len(next(iter(rows.values())))
    for name in table.parameters:
        edit(table, name, appending(rows[name]), appending(torch.zeros_like(rows[name])))
    for name, column in table.columns.items():
        table.columns[name] = torch.cat([column, rows[name]])
    for name, sums in table.statistics.items():
        table.statistics[name] = torch.cat([sums, sums.new_zeros(count, *sums.shape[1:])])


def keep_rows(table: ParameterTable, kept: Bool[Tensor, "N"]) -> None:
    """Keeps the marked rows of all parameters (with moments), columns and statistics."""
    for name in table.parameters:
        edit(table, name, lambda old: old[kept], lambda moment: moment[kept])
    for values in (table.columns, table.statistics):
        values |= {name: value[kept] for name, value in values.items()}


def reset_column(table: ParameterTable, name: str, values: Tensor) -> None:
    """Replaces the values of one parameter and zeroes its moments."""
    edit(table, name, lambda old: values, torch.zeros_like)


def detached_rows(table: ParameterTable) -> dict[str, Tensor]:
    """Returns all parameters and columns by name, detached."""
    return {name: parameter.detach() for name, parameter in table.parameters.items()} | table.columns


# -- steps -------------------------------------------------------------------------------------------------------------


def named_parameters(table: ParameterTable) -> list[tuple[str, Parameter]]:
    """Returns all learned parameters with their names, in the same order on every process."""
    return [*table.parameters.items(), *(table.networks.named() if table.networks else ())]


def gradients(table: ParameterTable) -> dict[str, Tensor]:
    """Returns the gradients by parameter name."""
    return {name: parameter.grad for name, parameter in named_parameters(table) if parameter.grad is not None}


def shared_colour(table: ParameterTable) -> list[Parameter]:
    """Returns the parameters of the colour network; pseudo views may leave them alone."""
    return [] if table.networks is None else list(table.networks.colour.parameters())


def zero_grad(table: ParameterTable) -> None:
    """Clears all gradients."""
    for _, parameter in named_parameters(table):
        parameter.grad = None


def take_adam_step(table: ParameterTable) -> None:
    """Takes an Adam step, with learning rates times the table's pace, and clears the gradients."""
    networks = [] if table.networks is None else [table.networks.optimiser]
    for optimiser in [table.optimiser, *networks]:
        with scaled_rates(optimiser, table.pace):
            optimiser.step()
    zero_grad(table)


@contextmanager
def scaled_rates(optimiser: torch.optim.Optimizer, pace: float) -> Iterator[None]:
    """Multiplies the learning rates by `pace` inside the block."""
    rates = [group["lr"] for group in optimiser.param_groups]
    try:
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = pace * rate
        yield
    finally:
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate


def size_of(table: ParameterTable) -> tuple[int, int]:
    """Returns the number of rows and the bytes of parameters, columns and networks."""
    needed = [*(parameter for _, parameter in named_parameters(table)), *table.columns.values()]
    return len(table), sum(value.numel() * value.element_size() for value in needed)


# -- checkpoints -------------------------------------------------------------------------------------------------------


def learned_parameters(table: ParameterTable) -> Iterator[tuple[str, str, Parameter, torch.optim.Adam]]:
    """Yields (key in checkpoints, name, parameter, optimiser) of all learned parameters."""
    for name, parameter in table.parameters.items():
        yield f"parameters.{name}", name, parameter, table.optimiser
    if table.networks is not None:
        for name, parameter in table.networks.named():
            yield name, name, parameter, table.networks.optimiser


def table_tensors(table: ParameterTable) -> dict[str, Tensor]:
    """Returns all tensors of a table by their names in checkpoints."""
    out = {f"columns.{name}": column for name, column in table.columns.items()}
    out |= {f"statistics.{name}": sums for name, sums in table.statistics.items()}
    out |= {f"{RECORD}{name}": entry for name, entry in table.record.items()}
    for key, name, parameter, optimiser in learned_parameters(table):
        out[key] = parameter.detach()
        out |= {f"adam.{name}.{entry}": value for entry, value in optimiser.state.get(parameter, {}).items()}
    if table.networks is not None:
        out |= {name: buffer.detach() for name, buffer in table.networks.buffers()}
    return out


def restore_table(like: ParameterTable, tensors: dict[str, Tensor]) -> ParameterTable:
    """Restores the table of a checkpoint, with any number of rows, and learning rates and networks of `like`.

    Raises:
        CheckpointError: a tensor is missing, as in a run with other options.
    """
    for name, former in like.former_names.items():
        if name in like.parameters and f"parameters.{name}" not in tensors:
            tensors = {key.replace(f".{former}", f".{name}"): value for key, value in tensors.items()}
    rows = {kind: saved_rows(kind, vars(like)[kind], tensors) for kind in ("parameters", "columns", "statistics")}
    rows = {kind: {name: value.to(like.device) for name, value in values.items()} for kind, values in rows.items()}
    parameters = {name: Parameter(value) for name, value in rows["parameters"].items()}
    record = {key[len(RECORD) :]: value.to(like.device) for key, value in tensors.items() if key.startswith(RECORD)}
    record |= {name: record.get(name, entry).to(entry) for name, entry in like.record.items()}
    table = ParameterTable(
        parameters, rows["columns"], rows["statistics"], like.networks, record, former_names=like.former_names
    )
    for name in table.parameters:
        table.set_rate(name, like.group(name)["lr"])
    for key, name, parameter, optimiser in learned_parameters(table):
        parameter.data.copy_(saved(key, parameter.shape, tensors))
        restore_adam(name, parameter, optimiser, tensors)
    for name, buffer in table.networks.buffers() if table.networks is not None else ():
        buffer.copy_(saved(name, buffer.shape, tensors))
    return table


def restore_adam(name: str, parameter: Parameter, optimiser: torch.optim.Adam, tensors: dict[str, Tensor]) -> None:
    """Restores Adam's step count and moments of one parameter, if there are any."""
    if f"adam.{name}.step" in tensors:
        shapes = {"step": torch.Size(), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
        state = {key: saved(f"adam.{name}.{key}", shape, tensors) for key, shape in shapes.items()}
        optimiser.state[parameter] = {key: value.to(parameter.device) for key, value in state.items()}


def saved(key: str, shape: torch.Size, tensors: dict[str, Tensor]) -> Tensor:
    """Returns a tensor of a checkpoint; CheckpointError: there is none of that shape."""
    if key not in tensors or tensors[key].shape != shape:
        raise CheckpointError(f"the checkpoint holds no {key} of shape {list(shape)}: remove it to use an older one")
    return tensors[key]


def saved_rows(kind: str, like: dict[str, Tensor], tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Returns the saved values of a kind by name; older checkpoints have some statistics as columns."""
    kinds = (kind, "columns") if kind == "statistics" else (kind,)
    names = {name: next((f"{k}.{name}" for k in kinds if f"{k}.{name}" in tensors), "") for name in like}
    missing = [name for name, key in names.items() if not key]
    if missing:
        raise CheckpointError(
            f"the checkpoint holds no {' and no '.join(missing)}: it was trained with other options of the backbone; "
            "resume with those, or train anew"
        )
    return {name: tensors[key] for name, key in names.items()}
