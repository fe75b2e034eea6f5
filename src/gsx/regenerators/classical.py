"""Regenerators without anything to learn: Lanczos enlargement, identity, and the truth itself as an upper bound."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from gsx.core.data.resize import resize, to_uint8
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request


@dataclass(frozen=True, kw_only=True)
class PlainOptions:
    """Nothing to choose."""

    name: str


class Resampled:
    """Enlarges by Lanczos' filter with three lobes."""

    def __init__(self, options: PlainOptions) -> None:
        self.options = options

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Nothing to learn."""
        return {}

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Each picture, `scale` times as large."""
        return [enlarged(request) for request in requests]


def enlarged(request: Request) -> Float[Tensor, "3 H W"]:
    """By Lanczos, through 8 bits."""
    height, width = request.result_size
    return resize(to_uint8(request.image), width, height, "lanczos").float() / 255


class Unchanged:
    """Gives back what it is given: the baseline of a restorer."""

    def __init__(self, options: PlainOptions) -> None:
        self.options = options

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Nothing to learn."""
        return {}

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """It cannot enlarge."""
        refuse_enlarging("identity", scales)

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 h w"]]:
        """Each picture as it is."""
        return [request.image for request in requests]


def refuse_enlarging(name: str, scales: Sequence[int]) -> None:
    """Raises ConfigError if a restorer is asked to enlarge."""
    if max(scales) > 1:
        raise ConfigError(
            f"regenerator {name} cannot enlarge x{max(scales)}: choose another for that role, or augmenter scales=[1]"
        )


class Oracle:
    """The true pixels: the ceiling of any regenerator, and a test of alignment. No result of it is a result."""

    def __init__(self, options: PlainOptions) -> None:
        self.options = options

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Nothing to learn."""
        return {}

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Photographs must be fine enough, and show no place but their own."""
        for view in views:
            finest = view.source.max_zoom(view.camera)
            if max(scales) > finest:
                raise ConfigError(
                    f"regenerator oracle: the photograph of '{view.name}' is not {max(scales)} times finer than the "
                    f"training image; train at scene.downscale={max(scales)} or more"
                )
            if moved and finest < math.inf:
                raise ConfigError(
                    "regenerator oracle knows no truth beside the photographs: set variants=0 of the augmenter"
                )

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """What the scene truly shows."""
        return [truth(request) for request in requests]


def truth(request: Request) -> Float[Tensor, "3 H W"]:
    """The truth that the camera of a request sees at `scale` times the density."""
    height, width = request.result_size
    return request.view.source.image(request.camera.resize(width, height)).float() / 255
