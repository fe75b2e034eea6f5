"""Small networks that learn from one scene: initial weights, the training loop, files."""

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gsx.core.files import replace_file
from gsx.core.training.regenerator import RegeneratorContext

logger = logging.getLogger(__name__)


def initialise(layer: nn.Module, generator: torch.Generator) -> None:
    """Draw a convolution's weights from the generator (He et al. 2015); biases are 0."""
    assert isinstance(layer, nn.Conv2d)
    assert layer.bias is not None
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
    nn.init.zeros_(layer.bias)


def fit(
    network: nn.Module,
    loss_of: Callable[[], Tensor],
    context: RegeneratorContext,
    steps: int,
    rate: float,
    seconds: float = 0,
) -> list[Tensor]:
    """Take Adam steps, whose rate falls as a cosine to a hundredth, for `seconds` at most (0: no limit).

    Returns the loss of each step that was taken.
    """
    optimiser = torch.optim.Adam(network.parameters(), lr=rate)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, eta_min=rate / 100)
    losses: list[Tensor] = []
    start = time.perf_counter()
    for _ in range(steps):
        context.raise_if_stopping()
        if seconds and time.perf_counter() - start > seconds:
            break
        loss = loss_of()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        decay.step()
        losses.append(loss.detach())
    return losses


def write_tensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write tensors as safetensors; OSError if the file cannot be written."""
    from safetensors.torch import save

    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, save({name: value.contiguous() for name, value in tensors.items()}))


def read_tensors(path: Path) -> dict[str, Any] | None:
    """Read what `write_tensors` wrote; None if the file is damaged."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        return load(path.read_bytes())
    except (OSError, SafetensorError) as error:
        logger.warning("%s cannot be read (%s): it is learnt again", path, error)
        return None
