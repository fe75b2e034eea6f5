"""Photographs that are the same, and how little is read to tell."""

from pathlib import Path

import pytest
from refusals import refused
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.scenes import splits
from gsx.scenes.splits import BLOCK, alike, digest, digest_of_parts, refuse_shared, size


class Source:
    """Of a view: nothing but its file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def image(self, camera: Camera) -> Tensor:
        raise AssertionError("nothing is decoded")

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def refusals(train: list[Path], test: list[Path], folder: Path) -> str:
    """What is said of them; empty: nothing."""
    try:
        refuse_shared(views(*train), views(*test), folder)
    except InputError as error:
        return str(error)
    return ""


def views(*photos: Path) -> list[View]:
    camera = look_at((0, 0, 0), (1, 0, 0), fov_x=1, width=8, height=8)
    return [View(photo.name, camera, Source(photo)) for photo in photos]


def written(folder: Path, **contents: bytes) -> list[Path]:
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return [folder / name for name in contents]


def test_only_files_of_equal_size_on_both_sides_are_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Equal sizes among what is trained on alone do not matter."""
    train = written(tmp_path, a=b"1", b=b"2", c=b"33")
    test = written(tmp_path, d=b"444", e=b"55")
    opened: list[str] = []

    def noted(path: Path) -> bytes:
        opened.append(path.name)
        return digest(path)

    monkeypatch.setattr(splits, "digest_of_parts", noted)
    monkeypatch.setattr(splits, "digest", noted)
    refuse_shared(views(*train), views(*test), tmp_path)
    assert sorted(opened) == ["c", "e"]


def test_only_what_is_alike_at_three_places_is_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = written(tmp_path, one=b"1", other=b"2")
    monkeypatch.setattr(splits, "digest", None)
    refuse_shared(views(one), views(other), tmp_path)


def test_files_that_differ_where_only_a_whole_reading_shows_it_are_not_the_same(tmp_path: Path) -> None:
    long = bytes(8 * BLOCK)
    odd = bytearray(long)
    odd[2 * BLOCK] = 1
    one, other, twin = written(tmp_path, one=long, other=bytes(odd), twin=long)
    assert digest_of_parts(one) == digest_of_parts(other)
    assert refusals([one], [other], tmp_path) == ""
    assert f"1 test photographs of '{tmp_path}' are trained on, too ('{one}' is '{twin}'" in refusals(
        [one], [other, twin], tmp_path
    )


def test_files_as_short_as_a_block_are_compared(tmp_path: Path) -> None:
    one, other, empty, void = written(tmp_path, one=b"ab", other=b"ac", empty=b"", void=b"")
    assert refusals([one], [other], tmp_path) == ""
    assert f"'{empty}' is '{void}'" in refusals([one, empty], [other, void], tmp_path)


def test_a_photo_that_vanishes_is_a_sentence(tmp_path: Path) -> None:
    gone = tmp_path / "gone.png"
    refused(r"Image '.*gone\.png' cannot be read \(No such file or directory\): restore", alike, ([gone], [gone]), size)
