"""Python's collector of reference cycles, paused where it costs time and frees next to nothing."""

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
    """Pauses the collector while a program imports torch, and freezes the imported objects.

    Half of the walks through them come at exit. If torch is imported already, nothing is frozen. OpenImageIO must be
    imported later: its binding complains about objects left at exit.
    """
    first = "torch" not in sys.modules
    with gc_paused():
        yield
        if first:
            gc.freeze()
