"""Files that are wholly there or not at all; tables of CSV."""

import csv
from pathlib import Path

import pytest

from gsx.core.files import csv_text, replace_file, replacing


def test_two_writers_of_one_file_do_not_share_a_temporary_one(tmp_path: Path) -> None:
    """Also where both have the same process number, as in two containers."""
    path = tmp_path / "state.json"
    with replacing(path) as first:
        first.write_text("first")
        with replacing(path) as second:
            assert first != second
            second.write_text("second")
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_what_fails_half_way_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    replace_file(tmp_path / "a.txt", b"whole")
    with pytest.raises(TypeError), replacing(tmp_path / "a.txt") as path, path.open("wb") as stream:
        stream.writelines([b"ha", None])  # type: ignore[list-item]
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [("a.txt", b"whole")]


def test_what_cannot_be_written_is_named_as_it_was_asked_for(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as error:
        replace_file(tmp_path / "missing" / "report.html", b"whole")
    assert error.value.filename == str(tmp_path / "missing" / "report.html")


def test_columns_without_a_value_are_empty_and_others_are_left_out() -> None:
    rows = [{"run": "a, b", "psnr": -1.5, "more": "left out"}, {"run": "c", "psnr": None}, {"run": "d"}]
    read = list(csv.DictReader(csv_text(("run", "psnr"), rows).splitlines()))
    assert read == [{"run": "a, b", "psnr": "-1.5"}, {"run": "c", "psnr": ""}, {"run": "d", "psnr": ""}]
