"""PLY in and out: bytes worked by hand, and files as other programs write them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from gsx.core.errors import InputError
from gsx.formats.ply import length_of, read_ply, write_ply

HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nproperty uchar red\nend_header\n"


def test_bytes_written_are_those_of_the_format(tmp_path: Path) -> None:
    columns = {"x": np.array([1.5, -2.0], np.float32), "red": np.array([7, 255], np.uint8)}
    write_ply(tmp_path / "a.ply", columns)
    assert (tmp_path / "a.ply").read_bytes() == HEADER + struct.pack("<fBfB", 1.5, 7, -2.0, 255)


def test_round_trip_keeps_values_types_and_order(tmp_path: Path) -> None:
    columns = {
        "y": np.array([np.pi, -1e300]),
        "label": np.array([-3, 2**31 - 1], np.int32),
        "x": np.array([np.nan, np.inf], np.float32),
    }
    write_ply(tmp_path / "a.ply", columns, comments=["made by a test"])
    assert b"\ncomment made by a test\n" in (tmp_path / "a.ply").read_bytes()
    back = read_ply(tmp_path / "a.ply")
    assert list(back) == ["y", "label", "x"]
    for name, column in columns.items():
        assert back[name].dtype == column.dtype
        np.testing.assert_array_equal(back[name], column)


def test_big_endian_columns_are_written_little_endian(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"x": np.array([1.0, 2.0], ">f4")})
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply")["x"], np.array([1.0, 2.0], np.float32))


def test_ascii_with_faces_and_windows_line_ends(tmp_path: Path) -> None:
    text = (
        "ply\r\nformat ascii 1.0\r\ncomment element of surprise\r\nelement vertex 2\r\nproperty float32 x\r\n"
        "property uint8 red\r\nelement face 1\r\nproperty list uchar int vertex_index\r\nend_header\r\n"
        "0.25 3\r\n-1e3 255\r\n3 0 1 0\r\n"
    )
    (tmp_path / "a.ply").write_bytes(text.encode())
    columns = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(columns["x"], np.array([0.25, -1000], np.float32))
    np.testing.assert_array_equal(columns["red"], np.array([3, 255], np.uint8))


def test_a_comment_may_hold_the_word_that_ends_the_header(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"x": np.array([2.5], np.float32)}, ["what follows end_header is binary"])
    assert read_ply(tmp_path / "a.ply")["x"].tolist() == [2.5]
    content = (tmp_path / "a.ply").read_bytes()
    assert length_of(content) == len(content)


def test_no_vertices(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"x": np.empty(0, np.float32)})
    assert read_ply(tmp_path / "a.ply")["x"].shape == (0,)
    (tmp_path / "b.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    assert read_ply(tmp_path / "b.ply")["x"].shape == (0,)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no complete PLY header"),
        (b"solid cube\nend_header\n", "no complete PLY header"),
        (b"ply\nformat ascii 1.0\nelement\nend_header\n", "does not begin with vertices"),
        (b"ply\nformat ascii 1.0\nelement vertex\nend_header\n", "does not begin with vertices"),
        (b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\nend_header\n", "does not begin with vertices"),
        (HEADER[:40], "no complete PLY header"),
        (HEADER + b"\0" * 9, "ends after 1 of 2 vertices"),
        (HEADER.replace(b"little", b"big"), "binary_big_endian"),
        (HEADER.replace(b"vertex", b"face"), "does not begin with vertices"),
        (HEADER.replace(b"property float x", b"property list uchar int x"), "property list uchar int x"),
        (HEADER.replace(b"property float x\nproperty uchar red\n", b""), "no vertex property or one twice"),
        (HEADER.replace(b"red", b"x"), "no vertex property or one twice"),
        (HEADER.replace(b"binary_little_endian", b"ascii") + b"1 2\n", "ends after 1 of 2 vertices"),
        (HEADER.replace(b"binary_little_endian", b"ascii") + b"1 2\n3 red\n", "unreadable vertex"),
        (HEADER.replace(b"binary_little_endian", b"ascii") + b"1 2\n3\n", "unreadable vertex"),
    ],
)
def test_unusable_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_ply(tmp_path / "a.ply")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.ply' does not exist"):
        read_ply(tmp_path / "nowhere.ply")


def test_unwritable_files_leave_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "folder.ply").mkdir()
    for name in ("folder.ply", "no_folder/a.ply"):
        with pytest.raises(InputError, match="cannot be written"):
            write_ply(tmp_path / name, {"x": np.zeros(2)})
    assert [path.name for path in tmp_path.iterdir()] == ["folder.ply"]


def test_unequal_columns_leave_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="one length"):
        write_ply(tmp_path / "a.ply", {"x": np.zeros(2), "y": np.zeros(3)})
    with pytest.raises(ValueError, match="i8"):
        write_ply(tmp_path / "a.ply", {"x": np.zeros(2, np.int64)})
    assert not list(tmp_path.iterdir())


def test_comments_are_one_line_of_ascii(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"x": np.zeros(1, np.float32)}, ["scene 客厅 \udcff\nelement vertex 5"])
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].splitlines()
    assert header[2] == rb"comment scene \u5ba2\u5385 \udcff element vertex 5"
    assert len(read_ply(tmp_path / "a.ply")["x"]) == 1
