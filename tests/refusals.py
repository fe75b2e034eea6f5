"""Inputs that are refused."""

from collections.abc import Callable

import pytest

from gsx.core.errors import InputError


def refused(match: str, load: Callable[..., object], *arguments: object) -> None:
    """Assert that a call raises InputError with a message that matches."""
    with pytest.raises(InputError, match=match):
        load(*arguments)
