"""What a step frees is kept for the next, instead of being given back and asked for again page by page."""

import ctypes
import os
import sys
from contextlib import suppress

TRIM_THRESHOLD, MMAP_MAX = -1, -4
"""Names of glibc's options (malloc.h)."""
MOST_KEPT = 1 << 30
"""Bytes of free memory at the end of the heap, beyond which they are given back."""
CHOSEN = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_MAX_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
"""Variables by which users choose for themselves."""


def keep_freed_memory() -> None:
    """Have glibc take large tensors from its heap as well, and keep up to MOST_KEPT bytes of what is freed at its end,
    for the rest of this process.

    A training step frees and asks again for hundreds of MB; by default large blocks come from the kernel each time, and
    each of their pages costs a fault. Nothing happens where the C library is another.
    """
    if not sys.platform.startswith("linux") or any(name in os.environ for name in CHOSEN):
        return
    with suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.gnu_get_libc_version  # noqa: B018  # another library's options may mean something else
        library.mallopt(MMAP_MAX, 0)
        library.mallopt(TRIM_THRESHOLD, MOST_KEPT)
