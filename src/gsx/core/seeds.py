"""Seeds derived from names and numbers."""

import hashlib


def derived_seed(*parts: object) -> int:
    """Returns a seed that depends on all parts, the same on every machine."""
    return int.from_bytes(hashlib.sha256(repr(parts).encode()).digest()[:7], "big")
