"""Signals at random moments, one or two of them: whatever they leave, the same command ends in the same bits."""

import os
import random
import shutil
import signal
import time
from pathlib import Path

import pytest

from faults.children import command, in_child, preload, run_in_child
from faults.record import record, some
from faults.verbs import VERBS, model_by_name, orphans

pytestmark = [pytest.mark.faults, pytest.mark.usefixtures("signals")]

RUN = VERBS["reuse"].words
PARTS, RUNS = 15, 20
"""Shares of the suite, and runs of each."""
SIGNALS = [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP]
LONGEST = 2.5
"""Seconds within which a signal comes; a run takes about as long."""


def interrupted(place: Path, choice: random.Random) -> tuple[list[signal.Signals], int]:
    """A run that is sent one or two signals; returns which, and how it ended."""
    sent = [choice.choice(SIGNALS) for _ in range(choice.choice([1, 1, 2]))]
    delays = [choice.uniform(0, LONGEST), choice.uniform(0, 0.3)]
    begun = time.monotonic()
    sender = os.fork()
    if sender == 0:
        try:
            send(place, sent, delays)
        finally:
            os._exit(0)
    ended = in_child(lambda: announced(place), place)
    os.waitpid(sender, 0)
    assert time.monotonic() - begun < 120, "it has to end"
    return sent, ended.code


def announced(place: Path) -> int:
    """The run, whose process says its number."""
    (place.parent / f"{place.name}.pid").write_text(str(os.getpid()))
    return command(RUN)


def send(place: Path, sent: list[signal.Signals], delays: list[float]) -> None:
    """Send signals to the process that said its number, with delays before them."""
    said = place.parent / f"{place.name}.pid"
    until = time.monotonic() + 30
    while not (said.exists() and said.read_text()) and time.monotonic() < until:
        time.sleep(0.01)
    for number, delay in zip(sent, delays, strict=False):
        time.sleep(delay)
        try:
            os.kill(int(said.read_text()), number)
        except (ProcessLookupError, ValueError):
            return


@pytest.mark.parametrize("part", range(PARTS))
def test_signals_at_random_moments(tmp_path: Path, part: int) -> None:
    choice = random.Random(part)
    preload(RUN, tmp_path / "first")
    assert run_in_child(RUN, tmp_path / "whole").code == 0
    expected = model_by_name(tmp_path / "whole")
    with record("signals (KILL, TERM, INT, HUP; one or two) at random moments", part, seed=part) as counts:
        for number in some(range(RUNS)):
            place = tmp_path / f"run_{number}"
            sent, code = interrupted(place, choice)
            assert code in (0, 2, 130, 128 + signal.SIGTERM, *(-name for name in SIGNALS)), (number, sent, code)
            again = run_in_child(RUN, place)
            assert again.code == 0, (number, sent, again.said)
            assert model_by_name(place) == expected, (number, sent)
            assert orphans(place) == [], (number, sent)
            counts.cases += 1
            shutil.rmtree(place)
