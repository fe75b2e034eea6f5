"""State of a run in memory, to go back to after steps on trial."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.training.parameter_table import RECORD, restore_table, table_tensors
from gsx.core.training.run import Run


@dataclass(frozen=True, eq=False, kw_only=True)
class RunState:
    """Content of a checkpoint, in memory."""

    step: int
    table: Mapping[str, Tensor]
    """Tensors of the model by their names in checkpoints."""
    modules: Mapping[str, Mapping[str, Tensor]]
    """Tensors of each module."""
    generator: Tensor
    """State of the run's generator."""
    order: tuple[int, ...]
    """Indices left in the sampler's order."""
    orders: int
    """Number of orders drawn."""


def copied(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns copies of tensors."""
    return {name: value.detach().clone() for name, value in tensors.items()}


def state_of(run: Run) -> RunState:
    """Copies the state of a run."""
    return RunState(
        step=run.step,
        table=copied(table_tensors(run.backbone.table)),
        modules={name: copied(module.state_dict()) for name, module in run.modules.items()},
        generator=run.generator.get_state(),
        order=tuple(run.sampler.order),
        orders=run.sampler.orders,
    )


def return_to(run: Run, state: RunState) -> None:
    """Brings a run back to a state; the state stays usable."""
    table = run.backbone.table
    table.record = {name: entry for name, entry in table.record.items() if RECORD + name in state.table}
    run.backbone.table = restore_table(table, copied(state.table))
    for name, module in run.modules.items():
        module.load_state_dict(copied(state.modules[name]))
    run.generator.set_state(state.generator)
    run.sampler.order, run.sampler.orders = list(state.order), state.orders
    run.step = state.step


def finite(run: Run) -> bool:
    """Checks that all parameters of a run's model are finite."""
    return all(bool(torch.isfinite(value).all()) for value in run.backbone.table.parameters.values())
