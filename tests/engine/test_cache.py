"""Where cached results live, and what their keys depend on."""

import os
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from gsx.core.errors import InputError
from gsx.engine.cache import (
    IN_USE,
    MANIFEST,
    add_to_manifest,
    cache_folder,
    cache_root,
    content_key,
    creation_lock,
    entries,
    file_stamp,
    in_use,
    is_intact,
    make_folder,
    trim,
)


def test_own_variable_comes_before_xdg_before_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "own"))
    assert cache_folder("sfm", "k") == tmp_path / "own" / "sfm" / "k"
    monkeypatch.delenv("GSX_CACHE")
    assert cache_folder("sfm", "k") == tmp_path / "xdg" / "gsx" / "sfm" / "k"
    monkeypatch.setenv("XDG_CACHE_HOME", "")  # the XDG specification: empty means unset
    assert cache_folder("sfm", "k") == tmp_path / "home" / ".cache" / "gsx" / "sfm" / "k"


def test_tilde_in_the_variable_is_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("GSX_CACHE", "~/kept")
    assert cache_folder("a", "b") == tmp_path / "kept" / "a" / "b"


@pytest.mark.parametrize("name", ["GSX_CACHE", "XDG_CACHE_HOME"])
def test_a_home_folder_that_there_is_not_is_no_folder_here(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GSX_CACHE", raising=False)
    monkeypatch.setenv(name, "~nosuchuser/c")
    with pytest.raises(InputError, match=r"~nosuchuser/c(/gsx)? has no home folder: set GSX_CACHE"):
        cache_folder("a", "b")


def test_naming_a_folder_does_not_create_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    assert not cache_folder("sfm", "k").exists()
    assert not (tmp_path / "cache").exists()


def test_key_is_the_sha256_of_the_parts() -> None:
    import hashlib

    assert content_key("a", 1, [2.5]) == hashlib.sha256(b"('a', 1, [2.5])").hexdigest()[:16]


@pytest.mark.parametrize(
    "other",
    [
        ("ab", "c"),
        ("a", "b", "c"),
        (
            "a",
            "bc ",
        ),
        ("a", b"bc"),
        ("bc", "a"),
        (),
    ],
)
def test_keys_tell_parts_apart(other: tuple[object, ...]) -> None:
    assert content_key("a", "bc") != content_key(*other)
    assert content_key("a", "bc") == content_key("a", "bc")


def test_stamp_changes_with_name_size_and_time(tmp_path: Path) -> None:
    file = tmp_path / "photo.jpg"
    file.write_bytes(b"1234")
    os.utime(file, ns=(0, 5))
    assert file_stamp(file) == ("photo.jpg", 4, 5)
    file.write_bytes(b"12345")
    os.utime(file, ns=(0, 6))
    assert file_stamp(file) == ("photo.jpg", 5, 6)


def test_folder_that_cannot_be_made_is_named_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"file/sub.*GSX_CACHE"):
        make_folder(tmp_path / "file" / "sub")


def test_folder_is_made_with_its_parents_and_may_exist(tmp_path: Path) -> None:
    assert make_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert make_folder(tmp_path / "a" / "b").is_dir()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def entry(name: str, used: float, size: int = 100) -> Path:
    """An entry with one file, used so many seconds after 1970."""
    file = make_folder(cache_folder(name[0], name)) / "state"
    file.write_bytes(bytes(size))
    add_to_manifest(file)
    os.utime(file.parent / MANIFEST, (used, used))
    return file.parent


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*"))


@pytest.mark.usefixtures("cache")
def test_what_was_used_longest_ago_makes_room_whatever_its_kind() -> None:
    entries = [entry(name, used) for name, used in (("a1", 300), ("b1", 100), ("a2", 200), ("c1", 400))]
    foreign = make_folder(cache_folder("compiled", "z")) / "kernel"
    foreign.write_bytes(bytes(10**4))
    each = size_of(entries[0])
    assert trim(4 * each / 1e9) == []
    assert trim(2.5 * each / 1e9) == [entries[1], entries[2]]
    assert [path.is_dir() for path in entries] == [True, False, False, True]
    foreign_manifest = make_folder(cache_folder("data", "set")) / "manifest.jsonl"
    foreign_manifest.write_text("{}")
    assert trim(0) == [entries[0], entries[3]]
    assert foreign.is_file()
    assert foreign_manifest.is_file()


def test_what_a_process_at_work_has_used_stays(cache: Path) -> None:
    now = time.time()
    before, since = entry("a1", now - 100), entry("a2", now - 100)
    program = (
        "import sys; from gsx.engine.cache import in_use\nwith in_use(): print('in', flush=True); sys.stdin.readline()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "in\n"
        assert is_intact(since / "state")  # used now, by whomever
        assert trim(0) == [before]
        other.kill()
    assert len(list((cache / IN_USE).iterdir())) == 1, "a killed process leaves its file"
    assert trim(0) == [since]
    assert list((cache / IN_USE).iterdir()) == []


def test_what_is_used_while_others_are_removed_stays(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = entry("a1", 100)
    seen = entries

    def overtaken() -> Any:
        found = seen()
        os.utime(made / MANIFEST, (200, 200))
        return found

    monkeypatch.setattr("gsx.engine.cache.entries", overtaken)
    assert trim(0) == []
    assert is_intact(made / "state")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="permissions do not hold root")
def test_what_cannot_be_removed_is_not_counted(cache: Path) -> None:
    made = entry("a1", 100)
    made.chmod(0o500)
    assert trim(0) == []
    made.chmod(0o700)
    assert trim(0) == [made]


def test_its_own_use_ends_with_the_context(cache: Path) -> None:
    with in_use():
        made = entry("a1", time.time() + 1)
        assert trim(0) == []
    assert list((cache / IN_USE).iterdir()) == []
    assert trim(0) == [made]


@pytest.mark.usefixtures("cache")
def test_a_file_is_whole_as_it_was_written_last(caplog: pytest.LogCaptureFixture) -> None:
    file = entry("a1", 0) / "state"
    assert is_intact(file)
    assert (file.parent / MANIFEST).stat().st_mtime > 1e9
    file.write_bytes(bytes(99) + b"1")
    assert not is_intact(file)
    assert "is damaged, computing it again" in caplog.text
    add_to_manifest(file)
    assert is_intact(file)
    (file.parent / MANIFEST).write_text('{"file": "state"')  # a line that was cut
    assert not is_intact(file)
    assert not is_intact(file.with_name("absent"))


def test_where_nothing_can_be_written_the_cache_is_used_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "file" / "cache"))
    with in_use():
        assert trim(0) == []


def test_where_there_is_no_home_a_place_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that is run by a number without a name."""
    for name in ("GSX_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "expanduser", homeless)
    with pytest.raises(InputError, match="GSX_CACHE"):
        cache_root()


def homeless(path: Path) -> Path:
    raise RuntimeError("Could not determine home directory.")


def test_waiting_for_another_process_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, got = tmp_path / "blend-0123.bin", list[bool]()

    def wait() -> None:
        with creation_lock(file, wait=True) as alone:
            got.append(alone)

    caplog.set_level("INFO", "gsx")
    thread = Thread(target=wait)
    with creation_lock(file) as alone:
        thread.start()
        deadline = time.monotonic() + 60
        while not caplog.messages and time.monotonic() < deadline:
            time.sleep(0.01)
        assert (alone, got) == (True, [])
    thread.join(60)
    assert (got, caplog.messages) == ([True], ["waiting for another process that makes blend ..."])
