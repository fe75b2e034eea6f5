"""The collector of cycles is off while a program starts."""

import gc
from types import SimpleNamespace

import pytest

from gsx.core.collector import collecting_nothing, loading


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


def test_what_a_program_loads_is_never_walked_through_but_nothing_that_is_made_later(monkeypatch) -> None:
    kept: list[bool] = []
    monkeypatch.setattr(gc, "freeze", lambda: kept.append(gc.isenabled()))
    monkeypatch.setattr("gsx.core.collector.sys", SimpleNamespace(modules={"torch": SimpleNamespace()}))
    with loading():
        assert not gc.isenabled()
    assert gc.isenabled()
    assert kept == [], "torch is there: this process has begun long ago"
    monkeypatch.setattr("gsx.core.collector.sys", SimpleNamespace(modules={}))
    with loading():
        pass
    assert kept == [False], "before the collector may walk once"
