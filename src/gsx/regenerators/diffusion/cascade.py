"""The paper's choice of upscaler by scale: x2 by one model, x4 by another, x8 by both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request
from gsx.regenerators.diffusion.model_specs import SD_X2_LATENT, SD_X4
from gsx.regenerators.diffusion.options import UpscalerOptions
from gsx.regenerators.diffusion.redraw import Diffusion


@dataclass(frozen=True, kw_only=True)
class CascadeOptions:
    """Options; values in conf/regenerator/upscale/sd_by_scale.yaml."""

    name: str
    x2: UpscalerOptions
    x4: UpscalerOptions


def rungs(scale: int) -> list[int]:
    """Factors whose product is the scale, the larger first (the paper: x8 is x4, then x2); x1 has none."""
    power = scale.bit_length() - 1
    if scale != 1 << power:
        raise ConfigError(f"regenerator sd_by_scale enlarges x2, x4, x8, not x{scale}: change the augmenter's scales")
    return [4] * (power // 2) + [2] * (power % 2)


class Cascade:
    """Two upscalers; only those that the scales need are looked for and loaded."""

    def __init__(self, options: CascadeOptions) -> None:
        self.models = {
            2: Diffusion(replace(SD_X2_LATENT, part="x2"), options.x2),
            4: Diffusion(replace(SD_X4, part="x4"), options.x4),
        }
        self.needed: set[int] = set()

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """The models that will be needed are there."""
        self.needed |= {factor for scale in scales for factor in rungs(scale)}
        for factor in sorted(self.needed):
            self.models[factor].check(views, [factor], moved)

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Opens them."""
        return {
            f"x{factor}_{name}": value
            for factor in sorted(self.needed)
            for name, value in self.models[factor].prepare(context).items()
        }

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Each picture, in order, by one model after the other."""
        images = {number: request.image for number, request in enumerate(requests)}
        ways = [rungs(request.scale) for request in requests]
        for turn in range(max(map(len, ways), default=0)):
            for factor, model in self.models.items():
                due = [n for n, way in enumerate(ways) if way[turn : turn + 1] == [factor]]
                asked = [replace(requests[n], image=images[n], scale=factor) for n in due]
                images |= dict(zip(due, model.regenerate(asked), strict=True))
        return [images[number] for number in range(len(requests))]
