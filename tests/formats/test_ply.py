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


FACES = b"property list uchar int vertex_indices\n"
TRIANGLES = [(0, 1, 0), (1, 0, 1)]


def corners(faces: list[tuple[int, ...]], order: str) -> bytes:
    return b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("faces", [[], TRIANGLES, [(0, 1), (0, 1, 0, 1, 0), (1,)]], ids=["none", "triangles", "mixed"])
def test_elements_before_the_vertices_are_skipped(tmp_path: Path, order: str, faces: list[tuple[int, ...]]) -> None:
    layout = b"binary_little_endian" if order == "<" else b"binary_big_endian"
    head = b"ply\nformat " + layout + b" 1.0\nelement camera 1\nproperty double fx\nproperty uchar id\n"
    head += f"element face {len(faces)}\n".encode() + FACES
    head += b"element vertex 2\nproperty float x\nproperty short level\nelement edge 9\nproperty list int int all\n"
    body = struct.pack(f"{order}dB", 1e9, 7) + corners(faces, order) + struct.pack(f"{order}fhfh", 1.5, -2, -0.25, 300)
    (tmp_path / "a.ply").write_bytes(head + b"end_header\n" + body)
    columns = read_ply(tmp_path / "a.ply")
    assert {name: column.tolist() for name, column in columns.items()} == {"x": [1.5, -0.25], "level": [-2, 300]}
    assert columns["x"].dtype == np.float32
    for end in range(len(head + b"end_header\n"), len(head + b"end_header\n" + body)):
        (tmp_path / "a.ply").write_bytes((head + b"end_header\n" + body)[:end])
        with pytest.raises(InputError, match=r"it ends (within|after)"):
            read_ply(tmp_path / "a.ply")


def test_text_with_faces_before_the_vertices(tmp_path: Path) -> None:
    text = "ply\nformat ascii 1.0\nelement face 2\nproperty list uchar int vertex_indices\nelement vertex 2\n"
    text += "property float x\nend_header\n3 0 1 0\n\n4 0 1 0 1\n0.5\n-7\n"
    (tmp_path / "a.ply").write_text(text)
    assert read_ply(tmp_path / "a.ply")["x"].tolist() == [0.5, -7]


def test_a_list_longer_than_the_file_is_refused(tmp_path: Path) -> None:
    head = b"ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list int int all\nelement vertex 0\n"
    for length in (-1, 2**31 - 1):
        (tmp_path / "a.ply").write_bytes(head + b"property int x\nend_header\n" + struct.pack("<i", length))
        with pytest.raises(InputError, match="it ends within its element 'face'"):
            read_ply(tmp_path / "a.ply")


ASCII = HEADER.replace(b"binary_little_endian", b"ascii")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no complete PLY header"),
        (b"solid cube\nend_header\n", "no complete PLY header"),
        (b"ply\nformat ascii 1.0\nend_header\n", "no vertices, its elements are: none"),
        (b"ply\nformat ascii 1.0\nelement\nend_header\n", "names no element with its number"),
        (b"ply\nformat ascii 1.0\nelement vertex\nend_header\n", "names no element with its number"),
        (b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\nend_header\n", "names no element"),
        (HEADER[:40], "no complete PLY header"),
        (HEADER + b"\0" * 9, "ends after 1 of 2 rows of 'vertex'"),
        (HEADER.replace(b"little", b"middle"), "format binary_middle_endian"),
        (HEADER.replace(b"vertex", b"face"), "no vertices, its elements are: face"),
        (HEADER.replace(b"property float x", b"property list uchar int x"), "lists in vertex property 'x'"),
        (HEADER.replace(b"property float x", b"property list float int x"), "'property list float int x' in element"),
        (HEADER.replace(b"property float x", b"property half x"), "'property half x' in element 'vertex'"),
        (HEADER.replace(b"property float x\nproperty uchar red\n", b""), "no property of element 'vertex'"),
        (HEADER.replace(b"red", b"x"), "no property of element 'vertex', or one twice"),
        (HEADER.replace(b"end_header", b"element vertex 2\nproperty int y\nend_header"), "two elements 'vertex'"),
        (ASCII + b"1 2\n", "ends after 1 of 2 rows of 'vertex'"),
        (ASCII + b"1 2\n3 red\n", "unreadable row of 'vertex'"),
        (ASCII + b"1 2\n3\n", "unreadable row of 'vertex'"),
        (ASCII + b"1 2\n# 3 4\n", "unreadable row of 'vertex'"),
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
    with pytest.raises(ValueError, match="shape mismatch"):
        write_ply(tmp_path / "a.ply", {"x": np.zeros(2), "y": np.zeros(3)})
    with pytest.raises(KeyError, match="i8"):
        write_ply(tmp_path / "a.ply", {"x": np.zeros(2, np.int64)})
    assert not list(tmp_path.iterdir())


def test_comments_are_one_line_of_ascii(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"x": np.zeros(1, np.float32)}, ["scene 客厅 \udcff\nelement vertex 5"])
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].splitlines()
    assert header[2] == rb"comment scene \u5ba2\u5385 \udcff element vertex 5"
    assert len(read_ply(tmp_path / "a.ply")["x"]) == 1
