"""Pairs of render and photograph that restorers learn from and are measured on."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from gsx.core.data.masks import where_counted
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.training.regenerator import RegeneratorContext

Pair = tuple[Tensor, Tensor]
"""(render, photograph), [3, h, w] each, display values."""
OWN_EVERY = 6
"""One own render of the run is added per so many pairs: restorers shall hardly change it (usual: 10 to 20 %)."""


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
