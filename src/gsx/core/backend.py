"""Backends run kernels, the tensor functions of rendering and losses; a compositor may bring one that compiles."""

from collections.abc import Callable
from typing import Any


class Backend:
    """Backend in plain torch; base class of backends that compile kernels."""

    compiled = False
    """True: kernels are compiled; some have one form for compilers and another for eager torch."""

    def available(self, device: str) -> bool:
        """Returns whether the backend works on a kind of device."""
        return True

    def on(self, device: str, learning: bool = False) -> "Backend":
        """Returns the backend for a kind of device; `learning`: True for kernels with gradients."""
        return self

    def kernel(self, function: Callable[..., Any], *last: Any, variant: tuple[Any, ...] = ()) -> Callable[..., Any]:
        """Binds the last arguments of a function. Compiled kernels need at least two rows.

        Args:
            function: Kernel.
            last: Values of its last arguments, constants of the compiled code.
            variant: Properties of the other arguments that need code of their own.
        """
        return (lambda *first: function(*first, *last)) if last else function


EAGER = Backend()
