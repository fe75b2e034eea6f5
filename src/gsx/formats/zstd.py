"""Zstandard streams: by Python's own module from 3.14 on, by the package zstandard before."""

from importlib import import_module
from io import BytesIO
from typing import Any

from gsx.core.errors import InputError

LEVEL = 12
"""Level of compression, as in Niantic's library."""
PIECE = 1 << 20
"""Bytes that are decompressed at a time: no claim of a stream's header is believed."""


def zstd_module() -> Any:
    """Returns the module that there is."""
    for name in ("compression.zstd", "zstandard"):
        try:
            return import_module(name)
        except ImportError:
            continue
    raise InputError("version 4 holds Zstandard streams, for which a package is missing: pip install 'gsx[spz]'")


def compress(data: bytes) -> bytes:
    """Returns one frame."""
    module = zstd_module()
    if hasattr(module, "ZstdFile"):
        return bytes(module.compress(data, level=LEVEL))
    return bytes(module.ZstdCompressor(level=LEVEL).compress(data))


def decompress(data: bytes, size: int) -> bytes:
    """Returns the `size` bytes of a stream."""
    module = zstd_module()
    try:
        with opened(module, data) as stream:
            pieces, left = [], size
            while left and (piece := stream.read(min(left, PIECE))):
                pieces.append(piece)
                left -= len(piece)
            if left or stream.read(1):
                raise InputError(f"a Zstandard stream has not the {size:,} bytes it should: copy or export it anew")
    except (module.ZstdError, EOFError) as error:
        raise InputError(f"a Zstandard stream is damaged ({error}): copy or export it anew") from None
    return b"".join(pieces)


def opened(module: Any, data: bytes) -> Any:
    """Returns a file object that decompresses."""
    if hasattr(module, "ZstdFile"):
        return module.ZstdFile(BytesIO(data))
    return module.ZstdDecompressor().stream_reader(data)
