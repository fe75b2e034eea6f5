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
    """Options of conf/regenerator/upscale/sd_by_scale.yaml."""

    name: str
    x2: UpscalerOptions
    x4: UpscalerOptions


def factors_of(scale: int) -> list[int]:
    """Factor a scale into 4s and then a 2 (the paper: x8 is x4, then x2); ConfigError: it is no power of two."""
    power = scale.bit_length() - 1
    if scale != 1 << power:
        raise ConfigError(f"regenerator sd_by_scale enlarges x2, x4, x8, not x{scale}: change the augmenter's scales")
    return [4] * (power // 2) + [2] * (power % 2)


class Cascade:
    """Two upscalers, of which only those that the scales need are located and loaded."""

    def __init__(self, options: CascadeOptions) -> None:
        self.models = {
            2: Diffusion(replace(SD_X2_LATENT, part="x2"), options.x2),
            4: Diffusion(replace(SD_X4, part="x4"), options.x4),
        }
        self.needed: set[int] = set()

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError or InputError if a scale cannot be reached or a model is missing."""
        self.needed |= {factor for scale in scales for factor in factors_of(scale)}
        for factor in sorted(self.needed):
            self.models[factor].check(views, [factor], moved)

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Open the models that are needed."""
        prepared = {factor: self.models[factor].prepare(context) for factor in sorted(self.needed)}
        return {f"x{factor}_{name}": value for factor, metrics in prepared.items() for name, value in metrics.items()}

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Enlarge each picture by one model after the other."""
        images = [request.image for request in requests]
        chains = [factors_of(request.scale) for request in requests]
        for turn in range(max(map(len, chains), default=0)):
            for factor, model in self.models.items():
                due = [n for n, chain in enumerate(chains) if chain[turn : turn + 1] == [factor]]
                results = model.regenerate([replace(requests[n], image=images[n], scale=factor) for n in due])
                for n, result in zip(due, results, strict=True):
                    images[n] = result
        return images
