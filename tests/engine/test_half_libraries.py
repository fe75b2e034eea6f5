"""Libraries that a killed linker left unfinished are removed, others stay."""

import struct
from pathlib import Path

import pytest

from gsx.engine.half_libraries import remove_half_libraries


def library(table: int, entries: int) -> bytes:
    """A 64-bit ELF header with a section table of 64-byte entries at a place."""
    start = bytearray(64)
    start[:5] = b"\x7fELF\x02"
    struct.pack_into("<Q", start, 40, table)
    struct.pack_into("<HH", start, 58, 64, entries)
    return bytes(start)


def test_unfinished_libraries_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    whole, half, other = (tmp_path / name for name in ("whole.so", "half.so", "other.so"))
    whole.write_bytes(library(100, 2).ljust(228, b"\0"))
    half.write_bytes(library(100, 2).ljust(227, b"\0"))
    other.write_bytes(b"not a library")
    remove_half_libraries()
    assert sorted(tmp_path.iterdir()) == [other, whole]
