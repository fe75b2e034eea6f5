"""Training modules with learned tensors."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsx.core.training.module import ModuleContext, TrainingModule


class LearnedModule(TrainingModule):
    """Training module whose tensors are learned by Adam, after the model's step, and saved in checkpoints."""

    def __init__(self, options: Any, context: ModuleContext, rate: float, **tensors: Tensor) -> None:
        super().__init__(options, context)
        self.learned = {name: value.to(context.device).requires_grad_() for name, value in tensors.items()}
        """Learned tensors by name."""
        self.optimizer = torch.optim.Adam(self.learned.values(), lr=rate)

    def zero_grad(self) -> None:
        """Clears gradients."""
        self.optimizer.zero_grad()

    def optimizer_step(self, step: int) -> None:
        """Takes an Adam step."""
        self.optimizer.step()

    def supports(self, ranks: int) -> bool:
        """Returns True for one process: gradients of modules are not exchanged."""
        return ranks == 1

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the learned tensors and Adam's state."""
        tensors = {name: value.detach() for name, value in self.learned.items()}
        for name, value in self.learned.items():
            tensors |= {f"adam.{name}.{key}": kept for key, kept in self.optimizer.state[value].items()}
        return tensors

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores the tensors of a checkpoint; empty: keeps the initial ones."""
        for name, value in self.learned.items() if tensors else ():
            value.data.copy_(tensors[name])
            prefix = f"adam.{name}."
            state = {key.removeprefix(prefix): kept for key, kept in tensors.items() if key.startswith(prefix)}
            self.optimizer.state[value] = {key: kept.clone().to(device_of(key, value)) for key, kept in state.items()}


def device_of(key: str, value: Tensor) -> torch.device:
    """Returns the device of an entry of Adam's state: the step count stays on the CPU."""
    return torch.device("cpu") if key == "step" else value.device
