"""Python's collector of reference cycles, where it costs and finds next to nothing."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def collecting_nothing() -> Iterator[None]:
    """Without the collector: while a program starts nearly all that is made stays, a million objects of torch among
    them, and would be walked through again and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
