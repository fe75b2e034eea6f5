"""The collector of cycles is off while a program starts."""

import gc

import pytest

from gsx.core.collector import collecting_nothing


def test_it_is_off_within_and_as_it_was_behind_also_after_an_error() -> None:
    assert gc.isenabled()
    with collecting_nothing():
        assert not gc.isenabled()
        with collecting_nothing():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ValueError, match="in between"), collecting_nothing():
        raise ValueError("in between")
    assert gc.isenabled()
