"""Seeds that do not depend on what was drawn before."""

import hashlib


def derived_seed(*parts: object) -> int:
    """A seed that depends on all parts, the same on every machine."""
    return int.from_bytes(hashlib.sha256(repr(parts).encode()).digest()[:7], "big")
