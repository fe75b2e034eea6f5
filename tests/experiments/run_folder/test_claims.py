"""One process at a time trains in a run folder: the other is told who does, and nothing is touched."""

import errno
import os
import platform
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import Begin
from tiny import tiny_settings, words

from gsx.builtin import plugins
from gsx.cli import main
from gsx.core.errors import InputError
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run
from gsx.experiments.run_folder import claims
from gsx.experiments.run_folder.claims import LOCK, claimed, claimed_name, is_at
from gsx.experiments.runs.job import train

HOLD = """
import sys, time
from pathlib import Path
from gsx.experiments.run_folder.claims import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_second_is_told_who_is_first_and_nothing_stays_behind(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    who = f"process {os.getpid()} on {platform.node()} since 20"
    for claim, path in ((claimed, run / LOCK), (claimed_name, tmp_path / f".run{LOCK}")):
        with claim(run):
            assert path.is_file()
            with pytest.raises(InputError, match=f"{run} is in use by {who}"), claim(run):
                pytest.fail("two had it")
        assert not path.exists()
        with claim(run):
            pass


def test_the_claim_of_a_killed_process_is_void(begin: Begin, tmp_path: Path) -> None:
    process = begin([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    with pytest.raises(InputError, match=f"process {process.pid} "), claimed(tmp_path):
        pytest.fail("two had it")
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (tmp_path / LOCK).is_file()
    with claimed(tmp_path):
        pass


def test_the_new_lock_file_is_taken_where_the_old_one_was_removed_before_it_was_locked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its holder lets go and removes it between our opening and our locking, and another process makes a new one."""
    locked = list[int]()

    def lock(descriptor: int, blocking: bool) -> bool:
        if not locked:
            (tmp_path / LOCK).unlink()
            (tmp_path / LOCK).write_text("")
        locked.append(descriptor)
        return True

    monkeypatch.setattr(claims, "lock_descriptor", lock)
    with claims.locked(tmp_path / LOCK, tmp_path, needed=True) as stream:
        assert len(locked) == 2
        assert is_at(tmp_path / LOCK, stream)


def test_a_link_in_place_of_a_lock_is_neither_followed_nor_emptied(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    (tmp_path / LOCK).symlink_to(tmp_path / "letter.txt")
    with pytest.raises(InputError, match=r"lock file .*\.lock of .* cannot be opened"):
        claimed(tmp_path).__enter__()
    assert (tmp_path / "letter.txt").read_text() == "dear"


def test_a_lock_of_another_user_is_refused_with_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    (tmp_path / LOCK).touch()
    monkeypatch.setattr("gsx.experiments.run_folder.claims.os.open", refused)  # root may open everything
    with pytest.raises(InputError, match=rf"of {(tmp_path / LOCK).owner()} cannot be opened .* \(chmod u\+rwx"):
        claimed(tmp_path).__enter__()


def test_without_locks_a_run_goes_on_and_says_so_and_a_shared_name_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def no_locks(descriptor: int, blocking: bool) -> bool:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(claims, "lock_descriptor", no_locks)
    with caplog.at_level("WARNING", logger="gsx"), claimed(tmp_path):
        assert "file system without locks: check that no other process trains in it" in caplog.text
    with pytest.raises(InputError, match="No locks available"), claimed_name(tmp_path / "run"):
        pytest.fail("taken for granted")


class Meanwhile:
    """Listener: asks for the same folder in the middle of training."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.codes = folder, list[int]()

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        if run.step == 2:
            before = (self.folder / "config.yaml").read_bytes()
            self.codes = [main(["resume", str(self.folder)]), main(words(self.folder, "seed=1"))]
            assert (self.folder / "config.yaml").read_bytes() == before


def test_a_run_under_way_is_neither_resumed_nor_begun_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, loaded = tmp_path / "run", plugins()
    second = Meanwhile(folder)
    with loaded.listening([second]):
        assert train(tiny_settings(folder, "iterations=4"), loaded, []) == 0
    assert second.codes == [2, 2]
    said = capsys.readouterr().err
    assert f"{folder} is in use by process {os.getpid()} on " in said
    assert f"'{folder}' is not empty" in said
    assert not (folder / LOCK).exists()
