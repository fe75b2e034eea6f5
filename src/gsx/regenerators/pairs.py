"""Renders and the photographs they should have been: what restorers learn from, and are measured on."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from gsx.core.data.masks import where_counted
from gsx.core.data.window import Window
from gsx.core.training.regenerator import RegeneratorContext

Pair = tuple[Tensor, Tensor]
"""(render, photograph), [3, h, w] each, display values."""
OWN_EVERY = 6
"""Of so many pairs to learn from one more shows the run's own render, which is to be left alone more (usual: 10 to
20 %)."""


def held_out_pairs(context: RegeneratorContext, share: float) -> list[Pair]:
    """Every training view as a model shows it that was not fitted to it (`RegeneratorContext.held_out`); what of a
    photograph does not count shows the render, so that nothing is learnt there."""
    renders = context.held_out(share)
    shown = zip(renders, context.views, strict=True)
    return [(render, where_counted(view.image(), render.cpu(), view.counted())) for render, view in shown]


def with_own(pairs: Sequence[Pair], context: RegeneratorContext, numbers: Sequence[int]) -> list[Pair]:
    """The pairs of training views of these numbers, and beside some of them the run's own renders."""
    views = [context.views[number] for number in numbers[::OWN_EVERY]]
    own = [(context.render(view.camera).cpu(), view) for view in views]
    learnt = [(render, where_counted(view.image(), render, view.counted())) for render, view in own]
    return [*(pairs[number] for number in numbers), *learnt]


def random_part(pairs: Sequence[Pair], size: tuple[int, int], generator: torch.Generator) -> Pair:
    """The same part, of that (height, width), of a render and its photograph, mirrored at random."""
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
    """Mean squared difference of pictures and photographs."""
    errors = [float((image - photo).square().mean()) for image, photo in pairs]
    return sum(errors) / len(errors)
