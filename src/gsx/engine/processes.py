"""The processes of one run as torchrun numbers them, and which of them is heard. Without torch."""

import os
import sys
from contextlib import suppress


def processes() -> int:
    """How many processes torchrun has started for this run; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", 1)) if "LOCAL_RANK" in os.environ else 1


def speaks() -> bool:
    """Whether this process is the one that is heard: of torchrun's the first."""
    return processes() == 1 or os.environ["RANK"] == "0"


def say(text: str, *, as_error: bool = False) -> None:
    """Write to standard output, or to standard error, once for all processes; a closed terminal loses messages."""
    if not speaks():
        return
    if not as_error:
        sys.stdout.write(text)
        return
    with suppress(OSError):
        sys.stderr.write(text)
        sys.stderr.flush()
