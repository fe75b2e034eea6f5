"""Wall time of this process."""

import os
import time
from pathlib import Path

IMPORTED = time.monotonic()
"""Monotonic time of the first import."""
STARTED = 21
"""Position of the start of a process in /proc/self/stat, after its name (proc(5), field 22), clock ticks."""


def process_start() -> float:
    """Returns the start of this process in seconds of `time.monotonic`; the first import where it is unknown."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[STARTED - 2])
        uptime = float(Path("/proc/uptime").read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return IMPORTED
    return time.monotonic() - max(0.0, uptime - ticks / os.sysconf("SC_CLK_TCK"))
