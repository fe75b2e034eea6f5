"""What people see while they wait."""

import io
import os
from pathlib import Path

import pytest

from gsx.experiments.runs import progress
from gsx.experiments.runs.progress import Countdown, Line, clock


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Clock:
    hand = Clock()
    monkeypatch.setattr(progress, "time", hand)
    return hand


def shown(stream: io.StringIO, time: Clock, seconds: float) -> list[str]:
    """Lines of ten equal parts that take so long each."""
    countdown = Countdown("evaluating", 10.0)
    for part in range(10):
        time.now += seconds
        countdown.advance(1.0, f"view {part}")
    return stream.getvalue().replace("\r", "\n").split("\n")


def test_elsewhere_lines_come_seldom_and_the_last_always(time: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", stream := io.StringIO())
    lines = shown(stream, time, 2.0)
    assert lines == [
        "evaluating 10%  view 0  ETA 0:18",
        "evaluating 40%  view 3  ETA 0:12",
        "evaluating 70%  view 6  ETA 0:06",
        "evaluating 100%  view 9  ETA 0:00",
        "",
    ]


def test_on_a_terminal_one_line_is_written_over(time: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", terminal := Terminal())
    lines = shown(terminal, time, 60.0)
    assert [line.split("  ETA ")[1].strip() for line in lines[1:4]] == ["9:00", "8:00", "7:00"]
    assert terminal.getvalue().count("\n") == 1, "the last line is left standing"
    assert len(lines[1]) <= len(lines[10])


def test_a_line_is_not_longer_than_its_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", terminal := Terminal())
    monkeypatch.setattr(terminal, "fileno", lambda: 2)
    monkeypatch.setattr("os.get_terminal_size", lambda number: os.terminal_size((21, 9)))
    Line().show("step 12/900  4.9 it/s  ETA 3:05")
    assert terminal.getvalue() == "\rstep 12/900  4.9 it/"
    monkeypatch.setattr("sys.stderr", elsewhere := io.StringIO())
    Line().show("step 12/900  4.9 it/s  ETA 3:05")
    assert elsewhere.getvalue() == "step 12/900  4.9 it/s  ETA 3:05\n"


def test_parts_that_are_larger_take_longer(time: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", terminal := Terminal())
    countdown = Countdown("evaluating", 21.0)
    time.now += 5.0
    countdown.advance(1.0, "x1")
    assert terminal.getvalue().endswith("ETA 1:40")  # 5 s for 1 of 21
    time.now += 20.0
    countdown.advance(4.0, "x2")
    assert terminal.getvalue().endswith("ETA 1:20")  # 25 s for 5 of 21


def test_clocks() -> None:
    assert [clock(seconds) for seconds in (0, 61.9, 3600, -1)] == ["0:00", "1:01", "1:00:00", "0:00"]


def test_an_evaluation_shows_its_progress(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tiny import tiny_run

    tiny_run(tmp_path / "run", ["iterations=1", "eval.zoom=[1,2]"])
    assert "evaluating 100%  test_001 x2  ETA 0:00\n" in capsys.readouterr().err
