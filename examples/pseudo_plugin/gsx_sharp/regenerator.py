"""A regenerator: bicubic enlargement and an unsharp mask."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from gsx.core.training.regenerator import RegeneratorContext, Request


@dataclass(frozen=True, kw_only=True)
class SharpOptions:
    name: str
    amount: float


class Sharpened:
    def __init__(self, options: SharpOptions) -> None:
        self.options = options

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        return {}  # nothing to learn from the scene

    def regenerate(self, requests: Sequence[Request]) -> list[Tensor]:
        return [self.sharpened(request) for request in requests]

    def sharpened(self, request: Request) -> Tensor:
        large = interpolate(request.image[None], scale_factor=request.scale, mode="bicubic")
        soft = avg_pool2d(pad(large, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
        return (large + self.options.amount * (large - soft))[0].clamp(0, 1)
