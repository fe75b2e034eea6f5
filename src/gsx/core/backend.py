"""How kernels run, functions of tensors that rendering and losses consist of: here as plain torch.

A compositor may bring a backend that compiles them (`gsx.engine`). Whoever calls a kernel asks the backend for it.
"""

from collections.abc import Callable
from typing import Any


class Backend:
    """Runs kernels as they stand; the base class of backends that compile them."""

    compiled = False
    """Whether kernels are compiled: some have a form for compilers, and another for eager torch."""

    def available(self, device: str) -> bool:
        """Returns whether kernels can run this way on a kind of device."""
        return True

    def on(self, device: str, learning: bool = False) -> "Backend":
        """Returns the backend for a kind of device; `learning`: for kernels that are compiled with gradients only."""
        return self

    def kernel(self, function: Callable[..., Any], *last: Any, variant: tuple[Any, ...] = ()) -> Callable[..., Any]:
        """Returns `function` with these values of its last arguments; `variant`: of the others, what changes the code.

        Compiled kernels take at least two rows.
        """
        return (lambda *given: function(*given, *last)) if last else function


EAGER = Backend()
