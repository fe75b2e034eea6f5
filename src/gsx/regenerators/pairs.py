"""Renders and the photographs they should have been: what restorers learn from, and are measured on."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from gsx.core.window import Window

Pair = tuple[Tensor, Tensor]
"""(render, photograph), [3, h, w] each, display values."""


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
