"""The collector of cycles is off while a program starts."""

import gc
from pathlib import Path
from types import SimpleNamespace

import pytest

from gsx.engine.collector import gc_paused, loading


def test_it_is_off_within_and_as_it_was_behind_also_after_an_error() -> None:
    assert gc.isenabled()
    with gc_paused():
        assert not gc.isenabled()
        with gc_paused():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ValueError, match="in between"), gc_paused():
        raise ValueError("in between")
    assert gc.isenabled()


def test_what_a_program_loads_is_never_walked_through_but_nothing_that_is_made_later(monkeypatch) -> None:
    kept: list[bool] = []
    monkeypatch.setattr(gc, "freeze", lambda: kept.append(gc.isenabled()))
    monkeypatch.setattr("gsx.engine.collector.sys", SimpleNamespace(modules={"torch": SimpleNamespace()}))
    with loading():
        assert not gc.isenabled()
    assert gc.isenabled()
    assert kept == [], "torch is there: this process has begun long ago"
    monkeypatch.setattr("gsx.engine.collector.sys", SimpleNamespace(modules={}))
    with loading():
        pass
    assert kept == [False], "before the collector may walk once"


def test_what_complains_of_objects_that_stay_is_imported_where_it_is_used() -> None:
    sources = list((Path(__file__).parents[2] / "src" / "gsx").rglob("*.py"))
    lines = [line for source in sources for line in source.read_text().splitlines() if "import OpenImageIO" in line]
    assert lines
    assert all(line.startswith("    ") for line in lines)
