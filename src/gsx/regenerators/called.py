"""Any function of a picture as a regenerator: the shortest way to try one."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request


@contextmanager
def beside_the_user() -> Iterator[None]:
    """Modules of the working directory can be imported, those that are installed come first."""
    here = os.getcwd()
    sys.path.append(here)
    try:
        yield
    finally:
        del sys.path[len(sys.path) - 1 - sys.path[::-1].index(here)]


@dataclass(frozen=True, kw_only=True)
class CalledOptions:
    """Options; values in conf/regenerator/*/callable.yaml."""

    name: str
    function: str
    """package.module:function, called as f(image, scale=, prompt=, seed=, strength=, **arguments) with image [3, h, w]
    in [0, 1]; it returns [3, scale h, scale w]."""
    arguments: dict[str, Any]

    def named_code(self) -> str:
        """The function."""
        return self.function


class Called:
    """Calls a function for each picture."""

    def __init__(self, options: CalledOptions) -> None:
        self.options = options

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """The function can be found."""
        self.function()

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Nothing to learn."""
        return {}

    def function(self) -> Callable[..., Tensor]:
        """The function."""
        module, colon, name = self.options.function.partition(":")
        try:
            with beside_the_user():
                found = getattr(import_module(module), name) if colon else None
        except Exception as error:  # whatever a user's module raises
            raise ConfigError(
                f"regenerator callable: function={self.options.function} cannot be imported ({error})"
            ) from error
        if not callable(found):
            raise ConfigError(
                f"regenerator callable: function is '{self.options.function}'; give package.module:function"
            )
        return found

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Each picture, in order."""
        function = self.function()
        return [
            function(
                r.image, scale=r.scale, prompt=r.prompt, seed=r.seed, strength=r.strength, **self.options.arguments
            )
            for r in requests
        ]
