"""Where cached results live, and what their keys depend on."""

import os
from pathlib import Path

import pytest

from gsx.core.cache import cache_folder, content_key, file_stamp, make_folder, trim
from gsx.core.errors import InputError


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


def test_what_was_used_longest_ago_makes_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of five folders of 100 bytes, but never the one at hand, though it is the oldest."""
    monkeypatch.setenv("GSX_CACHE", str(tmp_path))
    folders = [cache_folder("warm_starts", name) for name in "abcde"]
    for age, folder in enumerate(folders):
        make_folder(folder)
        (folder / "state").write_bytes(bytes(100))
        os.utime(folder, (1000 - age, 1000 - age))
    make_folder(cache_folder("other", "z"))
    assert trim("warm_starts", 500, folders[4]) == []
    assert trim("warm_starts", 320, folders[4]) == [folders[3], folders[2]]
    assert [folder.is_dir() for folder in folders] == [True, True, False, False, True]
    assert trim("warm_starts", 0, folders[4]) == [folders[1], folders[0]]
    assert cache_folder("other", "z").is_dir()
