"""Zstandard streams, by Python's module (3.14 and later) or the package zstandard."""

from importlib import import_module
from io import BytesIO
from typing import Any

from gsx.core.errors import InputError

LEVEL = 12
"""Level of compression, as in Niantic's library."""
PIECE = 1 << 20
"""Bytes decompressed at a time: a stream's header may state any size."""


def zstd_module() -> Any:
    """Returns the installed module; InputError: there is none."""
    for name in ("compression.zstd", "zstandard"):
        try:
            return import_module(name)
        except ImportError:
            continue
    raise InputError("version 4 holds Zstandard streams, for which a package is missing: pip install 'gsx[spz]'")


def compress(data: bytes) -> bytes:
    """Compresses data to one frame."""
    module = zstd_module()
    if hasattr(module, "ZstdFile"):
        return bytes(module.compress(data, level=LEVEL))
    return bytes(module.ZstdCompressor(level=LEVEL).compress(data))


def decompress(data: bytes, size: int) -> bytes:
    """Decompresses a stream of `size` bytes; InputError: it is damaged, or has another size."""
    module = zstd_module()
    try:
        plain = hasattr(module, "ZstdFile")
        opened = module.ZstdFile(BytesIO(data)) if plain else module.ZstdDecompressor().stream_reader(data)
        with opened as stream:
            pieces, left = [], size
            while left and (piece := stream.read(min(left, PIECE))):
                pieces.append(piece)
                left -= len(piece)
            if left or stream.read(1):
                raise InputError(f"a Zstandard stream does not have {size:,} bytes: copy or export it anew")
    except (module.ZstdError, EOFError) as error:
        raise InputError(f"a Zstandard stream is damaged ({error}): copy or export it anew") from None
    return b"".join(pieces)
