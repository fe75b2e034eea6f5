"""Python's collector of reference cycles, paused where it costs time and finds next to nothing."""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_paused() -> Iterator[None]:
    """Pauses the collector: while a program starts, nearly all objects stay, and each walk through them is wasted."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def loading() -> Iterator[None]:
    """Pauses the collector while a program imports torch, and keeps it from walking through these objects ever again.

    Half of such walks come where Python ends. Where torch is there already, other objects are to be collected: then
    they are only paused. OpenImageIO must be imported later: its binding complains of objects left in the end.
    """
    first = "torch" not in sys.modules
    with gc_paused():
        yield
        if first:
            gc.freeze()
