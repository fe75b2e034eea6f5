"""The processes of one run as torchrun numbers them, and which of them writes messages. Imports no torch."""

import os
import sys
from contextlib import suppress


def processes() -> int:
    """Returns how many processes torchrun has started for this run; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", 1)) if "LOCAL_RANK" in os.environ else 1


def speaks() -> bool:
    """Checks whether this process writes messages: of torchrun's the first."""
    return processes() == 1 or os.environ["RANK"] == "0"


def say(text: str, *, as_error: bool = False) -> None:
    """Writes to standard output or standard error, once for all processes; a closed terminal loses messages."""
    if not speaks():
        return
    if not as_error:
        sys.stdout.write(text)
        return
    with suppress(OSError):
        sys.stderr.write(text)
        sys.stderr.flush()
