"""Training modules that learn tensors of their own by Adam, beside the model."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsx.core.training.module import ModuleContext, TrainingModule


class LearnedModule(TrainingModule):
    """A module with learned tensors: they take part in backward, get an Adam step after the model's, and are saved."""

    def __init__(self, options: Any, context: ModuleContext, rate: float, **tensors: Tensor) -> None:
        super().__init__(options, context)
        self.learned = {name: value.to(context.device).requires_grad_() for name, value in tensors.items()}
        """Learned tensors by name."""
        self.optimizer = torch.optim.Adam(self.learned.values(), lr=rate)

    def zero_grad(self) -> None:
        """Drop gradients."""
        self.optimizer.zero_grad()

    def optimizer_step(self, step: int) -> None:
        """Take an Adam step."""
        self.optimizer.step()

    def supports(self, ranks: int) -> bool:
        """Returns whether one process trains: gradients of modules are not exchanged."""
        return ranks == 1

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the learned tensors and Adam's state."""
        tensors = {name: value.detach() for name, value in self.learned.items()}
        for name, value in self.learned.items():
            tensors |= {f"adam.{name}.{key}": kept for key, kept in self.optimizer.state[value].items()}
        return tensors

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on from the tensors of a checkpoint; empty: from the start."""
        for name, value in self.learned.items() if tensors else ():
            value.data.copy_(tensors[name])
            prefix = f"adam.{name}."
            state = {key.removeprefix(prefix): kept for key, kept in tensors.items() if key.startswith(prefix)}
            self.optimizer.state[value] = {key: kept.clone().to(device_of(key, value)) for key, kept in state.items()}


def device_of(key: str, value: Tensor) -> torch.device:
    """Returns where Adam keeps an entry of its state: the number of steps stays on the CPU."""
    return torch.device("cpu") if key == "step" else value.device
