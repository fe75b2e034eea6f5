"""Python's collector of reference cycles, where it costs and finds next to nothing."""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_paused() -> Iterator[None]:
    """Without the collector: while a program starts nearly all that is made stays, a million objects of torch among
    them, and would be walked through again and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def loading() -> Iterator[None]:
    """`gc_paused` while a program imports torch and all else: its objects stay, and are never walked through
    again, of which half comes where Python ends. Where torch is there already there are other objects, too, which are
    to be collected: then nothing more.

    OpenImageIO must come later: its binding complains of objects that are still there in the end.
    """
    first = "torch" not in sys.modules
    with gc_paused():
        yield
        if first:
            gc.freeze()
