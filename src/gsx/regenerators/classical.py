"""Regenerators that learn nothing: Lanczos enlargement, identity, and the truth itself as an upper bound."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from gsx.core.data.resize import resize, to_uint8
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request


@dataclass(frozen=True, kw_only=True)
class PlainOptions:
    """Options of regenerators without a setting."""

    name: str


class Fixed:
    """A regenerator that learns nothing from the scene."""

    def __init__(self, options: Any) -> None:
        self.options = options

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Return no metrics."""
        return {}


class Resampled(Fixed):
    """Enlargement by Lanczos' filter with three lobes."""

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Return each picture `scale` times as large."""
        return [enlarged(request) for request in requests]


def enlarged(request: Request) -> Float[Tensor, "3 H W"]:
    """Enlarge a picture by Lanczos' filter, through 8 bits."""
    height, width = request.result_size
    return resize(to_uint8(request.image), width, height, "lanczos").float() / 255


class Unchanged(Fixed):
    """The baseline of a restorer: it returns its input."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError for a scale above 1."""
        refuse_enlarging("identity", scales)

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 h w"]]:
        """Return each picture as it is."""
        return [request.image for request in requests]


def refuse_enlarging(name: str, scales: Sequence[int]) -> None:
    """Raise ConfigError if a restorer would have to enlarge."""
    if max(scales) > 1:
        raise ConfigError(
            f"regenerator {name} cannot enlarge x{max(scales)}: choose another for that role, or augmenter scales=[1]"
        )


class Oracle(Fixed):
    """The true pixels: the ceiling of any regenerator, and a test of alignment. Its results are no results."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError if a photo is too coarse, or other places than those of photos are to be drawn."""
        for view in views:
            finest = view.source.max_zoom(view.camera)
            if max(scales) > finest:
                raise ConfigError(
                    f"regenerator oracle: the photograph of '{view.name}' is not {max(scales)} times finer than the "
                    f"training image; train at scene.downscale={max(scales)} or more"
                )
            if moved and finest < math.inf:
                raise ConfigError(
                    "regenerator oracle has no truth for places without a photo: set variants=0 of the augmenter"
                )

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Return the true pictures."""
        return [truth(request) for request in requests]


def truth(request: Request) -> Float[Tensor, "3 H W"]:
    """Return the truth for a request's camera at `scale` times the density."""
    height, width = request.result_size
    return request.view.source.image(request.camera.resize(width, height)).float() / 255
