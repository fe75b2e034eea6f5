"""The collector of cycles: off while a program starts, and given nothing to do where it ends."""

import gc
import subprocess
import sys

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


ENDING = """
import atexit, gc
atexit.register(lambda: print(gc.get_freeze_count() > 1000))
from gsx.core.collector import end_at_once
end_at_once()
end_at_once()
atexit.register(print, "what else is to be done is done")
"""


def test_all_is_frozen_when_a_process_ends() -> None:
    ended = subprocess.run([sys.executable, "-c", ENDING], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines() == ["what else is to be done is done", "True"]
