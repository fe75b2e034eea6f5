"""A training module of a third party: one tint per photo, a code that is decoded to a colour matrix."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsx.core.plugins import Registry, hookimpl
from gsx.core.quality.colour_matrix import transform_colours
from gsx.core.training.learned_module import LearnedModule
from gsx.core.training.module import ModuleContext


@dataclass(frozen=True, kw_only=True)
class TintOptions:
    size: int = 4
    """Numbers in a code."""
    rate: float = 0.005
    """Learning rate of Adam."""


class Tint(LearnedModule):
    def __init__(self, options: TintOptions, context: ModuleContext) -> None:
        photos, generator = [view.name for view in context.scene.train], torch.Generator().manual_seed(0)
        self.index = {name: number for number, name in enumerate(photos)}
        codes, decoder = torch.zeros(len(photos), options.size), torch.randn(12, options.size, generator=generator)
        super().__init__(options, context, options.rate, codes=codes, decoder=decoder)

    def before_step(self, run: Any) -> dict[str, float]:
        return {"tint": float(self.learned["codes"].detach().std())}

    def transform_render(self, image: Tensor, view: Any, photo: Any, window: Any, learning: bool) -> Tensor:
        code = self.learned["decoder"] @ self.learned["codes"][self.index[view.name]]
        matrix = torch.eye(3, 4, device=code.device) + code.view(3, 4)
        return transform_colours(image.to(code.device), matrix if learning else matrix.detach())

    @classmethod
    def summary(cls, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        spreads = [line["tint"] for line in lines if "tint" in line]
        return {"tint": {"spread": spreads[-1]}} if spreads else {}

    @classmethod
    def remarks(cls, evaluation: Mapping[str, Any]) -> Iterator[str]:
        if "tint" in evaluation:
            yield f"tints of photos have a spread of {evaluation['tint']['spread']:.3f}"


@hookimpl
def gsx_register(registry: Registry) -> None:
    registry.add("module", "tint", Tint, TintOptions)


@hookimpl
def gsx_config_paths() -> list[str]:
    return ["pkg://gsx_tint.conf"]
