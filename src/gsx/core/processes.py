"""The processes of one run as torchrun numbers them, and which of them is heard. Without torch."""

import os
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    pass


def processes() -> int:
    """How many processes torchrun has started for this run; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", 1)) if "LOCAL_RANK" in os.environ else 1


def speaks() -> bool:
    """Whether this process is the one that is heard: of torchrun's the first."""
    return processes() == 1 or os.environ["RANK"] == "0"


def say(text: str, stream: TextIO) -> None:
    """Write to a stream, once for all processes."""
    if speaks():
        stream.write(text)
