"""glibc's allocator: memory that a step frees is kept for the next step, instead of being returned page by page."""

import ctypes
import os
import sys
from contextlib import suppress

TRIM_THRESHOLD, MMAP_MAX = -1, -4
"""glibc's options (malloc.h)."""
MOST_KEPT = 1 << 30
"""Bytes of free memory at the end of the heap above which they are returned to the system."""
CHOSEN = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_MAX_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
"""Variables by which users choose for themselves."""


def return_freed_memory() -> None:
    """Lets glibc return all free pages to the system; using them again costs faults.

    For changes of the sizes of tensors: new sizes do not fit into the gaps that old ones leave.
    """
    if sys.platform.startswith("linux"):
        with suppress(AttributeError, OSError):
            ctypes.CDLL(None).malloc_trim(0)


def keep_freed_memory() -> None:
    """Lets glibc take large tensors from its heap, and keep up to MOST_KEPT bytes of what is freed at its end.

    A step frees and allocates hundreds of MB; by default each page of a large block costs a fault. Other C libraries
    are left alone.
    """
    if not sys.platform.startswith("linux") or any(name in os.environ for name in CHOSEN):
        return
    with suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.gnu_get_libc_version  # noqa: B018  # another library's options may mean something else
        library.mallopt(MMAP_MAX, 0)
        library.mallopt(TRIM_THRESHOLD, MOST_KEPT)
