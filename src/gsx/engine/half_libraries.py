"""Compiled libraries that a killed linker left unfinished: torch would load them, and some end the process."""

import os
import struct
from contextlib import suppress
from pathlib import Path

HEADER = struct.Struct("<4x1x1x34xQ10xHH2x")
"""ELF header, 64 bits: place of the section table, size and number of its entries. The table ends the file."""


def remove_half_libraries() -> None:
    """Removes unfinished libraries from torch's cache, if gsx has chosen its folder.

    A linker at work in another process writes the header last, just before the table.
    """
    folder = os.environ.get("TORCHINDUCTOR_CACHE_DIR")
    for library in Path(folder).rglob("*.so") if folder else ():
        with suppress(OSError):  # another process has removed it, or owns it
            if is_unfinished(library):
                library.unlink()


def is_unfinished(library: Path) -> bool:
    """Checks if a 64-bit ELF library ends before its section table; False for other files."""
    with library.open("rb") as stream:
        start = stream.read(HEADER.size)
    if len(start) < HEADER.size or start[:5] != b"\x7fELF\x02":
        return False
    table, entry, count = HEADER.unpack(start)
    return library.stat().st_size < int(table) + int(entry) * int(count)
