"""Networks that learn from one scene: initial weights, the training loop, files, pairs of render and photograph."""

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gsx.core.data.masks import where_counted
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.files import replace_file
from gsx.core.training.regenerator import RegeneratorContext

logger = logging.getLogger(__name__)
Pair = tuple[Tensor, Tensor]
"""(render, photograph), [3, h, w] each, display values."""
OWN_EVERY = 6
"""One own render of the run is added per so many pairs: restorers shall hardly change it (usual: 10 to 20 %)."""


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


def held_out_pairs(context: RegeneratorContext, share: float) -> list[Pair]:
    """Pair each training view with the render of a model that was not fitted to it (`RegeneratorContext.held_out`)."""
    return [pair_of(render, view) for render, view in zip(context.held_out(share), context.views, strict=True)]


def with_own(pairs: Sequence[Pair], context: RegeneratorContext, numbers: Sequence[int]) -> list[Pair]:
    """Return the pairs of these training views, and for every `OWN_EVERY`-th of them one with the run's own render."""
    views = [context.views[number] for number in numbers[::OWN_EVERY]]
    return [
        *(pairs[number] for number in numbers),
        *(pair_of(context.render(view.camera).cpu(), view) for view in views),
    ]


def pair_of(render: Tensor, view: View) -> Pair:
    """Pair a render with its photo; masked pixels of the photo hold the render, so that nothing is learnt there."""
    return render, where_counted(view.image(), render.cpu(), view.counted())


def random_part(pairs: Sequence[Pair], size: tuple[int, int], generator: torch.Generator) -> Pair:
    """Cut one random window of that (height, width) out of a render and its photo, mirrored at random."""
    pair = pairs[int(torch.randint(len(pairs), (), generator=generator))]
    top, left = (
        int(torch.randint(whole - part + 1, (), generator=generator))
        for whole, part in zip(pair[0].shape[1:], size, strict=True)
    )
    window = Window(left=left, top=top, width=size[1], height=size[0])
    flips = [2] if bool(torch.randint(2, (), generator=generator)) else []
    render, photo = (window.cut(image).flip(flips) for image in pair)
    return render, photo


def mean_square(pairs: Iterable[Pair]) -> float:
    """Return the mean squared difference of pictures and photos."""
    errors = [float((image - photo).square().mean()) for image, photo in pairs]
    return sum(errors) / len(errors)
