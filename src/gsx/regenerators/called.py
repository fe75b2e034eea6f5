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
from gsx.core.training.regenerator import Request
from gsx.regenerators.classical import Fixed


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
        """Raise ConfigError if the function cannot be imported."""
        self.function()

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
