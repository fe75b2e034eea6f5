"""Regenerators that learn nothing: Lanczos' filter, identity, the truth as upper bound, any function of a picture."""

import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.resize import resize, to_uint8
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError, first_line
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request

TRIAL = 64
"""Largest side of the picture that a function is tried on before training, px."""


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


@contextmanager
def working_directory_importable() -> Iterator[None]:
    """Let modules of the working directory be imported; installed ones come first."""
    folder = os.getcwd()
    sys.path.append(folder)
    try:
        yield
    finally:
        del sys.path[len(sys.path) - 1 - sys.path[::-1].index(folder)]


@dataclass(frozen=True, kw_only=True)
class CalledOptions:
    """Options of conf/regenerator/*/callable.yaml."""

    name: str
    function: str
    """package.module:function, called as f(image, scale=, prompt=, seed=, strength=, **arguments) with image [3, h, w]
    in [0, 1]; it returns [3, scale h, scale w]."""
    arguments: dict[str, Any]

    def named_code(self) -> str:
        """Return the name of the function."""
        return self.function


class Called(Fixed):
    """A call of one function for each picture."""

    options: CalledOptions

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError if the function cannot be imported, or fails on a part of the first view at a scale."""
        function = self.function()
        for scale in scales if views else []:
            problem = self.problem(function, trial_picture(views[0]), scale)
            if problem:
                raise ConfigError(
                    f"regenerator callable: {self.options.function} tried with scale={scale} {problem}: "
                    + remedy(scale, [other for other in scales if other != scale])
                )

    def problem(self, function: Callable[..., Tensor], image: Float[Tensor, "3 h w"], scale: int) -> str:
        """Call the function once, and return what is wrong with its result; empty: nothing."""
        try:
            with torch.random.fork_rng(devices=[]):  # a trial leaves the numbers of training as they are
                result = function(image, scale=scale, prompt="", seed=0, strength=0.0, **self.options.arguments)
        except Exception as error:  # a user's function may raise anything
            return f"raised {type(error).__name__}: {first_line(error)}"
        height, width = image.shape[1:]
        return defect(result, (3, scale * height, scale * width))

    def function(self) -> Callable[..., Tensor]:
        """Import the function."""
        module, colon, name = self.options.function.partition(":")
        try:
            with working_directory_importable():
                found = getattr(import_module(module), name) if colon else None
        except Exception as error:  # a user's module may raise anything
            raise ConfigError(
                f"regenerator callable: function={self.options.function} cannot be imported ({error})"
            ) from error
        if not callable(found):
            raise ConfigError(
                f"regenerator callable: function is '{self.options.function}'; give package.module:function"
            )
        return found

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Return the function's results, in order."""
        function, more = self.function(), self.options.arguments
        return [
            function(r.image, scale=r.scale, prompt=r.prompt, seed=r.seed, strength=r.strength, **more)
            for r in requests
        ]


def trial_picture(view: View) -> Float[Tensor, "3 h w"]:
    """Cut the middle of a photo, TRIAL px wide and high at most."""
    image = view.image()
    height, width = (min(side, TRIAL) for side in image.shape[1:])
    top, left = (image.shape[1] - height) // 2, (image.shape[2] - width) // 2
    return image[:, top : top + height, left : left + width]


def defect(result: Any, shape: tuple[int, int, int]) -> str:
    """Return in which way a result is no picture of that shape; empty: it is one."""
    if not isinstance(result, Tensor):
        return f"returned {type(result).__name__}, not a tensor {list(shape)}"
    if result.shape != shape:
        return f"returned a tensor {list(result.shape)}, not {list(shape)}"
    if not result.is_floating_point():
        return f"returned {str(result.dtype).removeprefix('torch.')}, not display values in [0, 1]"
    if not bool(result.isfinite().all()):
        return f"returned {int((~result.isfinite()).sum())} values that are not finite"
    return ""


def remedy(scale: int, others: Sequence[int]) -> str:
    """Return what to do about a scale at which the function fails; `others`: further scales of the augmenter."""
    ways = [f"augmenter.NAME.scales={list(others)} leaves out {scale}"] if others else []
    ways.append("return the image itself for scale=1" if scale == 1 else f"correct the function for scale={scale}")
    return ", or ".join(ways)
