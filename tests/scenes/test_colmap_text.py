"""Text models as COLMAP and other programs write them, against the same model in binary as pycolmap reads it."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from refusals import refused
from synthetic_colmap import colmap_options, synthesize, write_photos, write_scene

from gsx.core.errors import InputError
from gsx.scenes.colmap import load
from gsx.scenes.colmap_folders import count_images
from gsx.scenes.colmap_model import read_model
from gsx.scenes.colmap_text import write_as_binary

NAMES = [
    "SITE 1.png",
    "SITE 2.png",
    "7 8  9 -1.png",
    "10 20 30.png",
    "a, b\tc.png",
    "Überblick – 写真 1.png",
    "plain.png",
]
FILES = ("cameras", "images", "points3D", "rigs", "frames")


def renamed(names: list[str]) -> Any:
    reconstruction = synthesize(frames=len(names))
    for image, name in zip(reconstruction.images.values(), names, strict=True):
        image.name = name
    return reconstruction


def text_model(folder: Path, names: list[str]) -> tuple[Any, Path]:
    """A scene with a text model and photos of these names."""
    reconstruction = renamed(names)
    return reconstruction, write_scene(reconstruction, folder, text=True)


def poses(reconstruction: Any) -> dict[str, np.ndarray]:
    return {image.name: image.cam_from_world().matrix() for image in reconstruction.images.values()}


def assert_same_poses(folder: Path, expected: dict[str, np.ndarray]) -> None:
    model = read_model(folder)
    assert sorted(image.name for image in model.images) == sorted(expected)
    for image in model.images:
        found = np.column_stack([image.rotation.numpy(), image.translation.numpy()])
        np.testing.assert_allclose(found, expected[image.name], atol=1e-15)


def edit(file: Path, change: Any) -> None:
    file.write_bytes(change(file.read_bytes()))


def without_comments(content: bytes) -> bytes:
    return b"\n".join(line for line in content.split(b"\n") if not line.startswith(b"#"))


def more_comments(content: bytes) -> bytes:
    return content.replace(b"\n2 ", b"\n\n# by hand\n\n2 ", 1)


WAYS = {
    "as it is": lambda content: content,
    "CRLF": lambda content: content.replace(b"\n", b"\r\n"),
    "CR": lambda content: content.replace(b"\n", b"\r"),
    "mark": lambda content: b"\xef\xbb\xbf" + without_comments(content),
    "mark, CRLF": lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"),
    "comments": more_comments,
    "blanks at ends": lambda content: content.replace(b"\n", b"  \n").replace(b"\n1 ", b"\n  1 "),
    "no last line end": lambda content: content.rstrip(),
}


@pytest.mark.parametrize("way", WAYS)
def test_names_go_to_the_end_of_the_line(tmp_path: Path, way: str) -> None:
    reconstruction, model = text_model(tmp_path, NAMES)
    for name in FILES:
        edit(model / f"{name}.txt", WAYS[way])
    assert count_images(model) == len(NAMES)
    assert_same_poses(model, poses(reconstruction))
    scene = load(colmap_options(tmp_path))
    assert sorted(view.name for view in [*scene.train, *scene.test]) == sorted(NAMES)
    assert scene.notes == ["Reprojection error 0.00 px (median of 350 observations, at the model's resolution)."]


def test_names_in_a_model_of_colmap_3(tmp_path: Path) -> None:
    reconstruction, model = text_model(tmp_path, NAMES)
    for name in ("rigs.txt", "frames.txt"):
        (model / name).unlink()
    assert_same_poses(model, poses(reconstruction))


def test_names_in_binary_models_may_hold_blanks(tmp_path: Path) -> None:
    reconstruction = renamed(NAMES)
    write_scene(reconstruction, tmp_path)
    assert len(load(colmap_options(tmp_path)).train) == len(NAMES) - 1


@pytest.mark.parametrize("name", FILES)
def test_text_becomes_the_bytes_that_colmap_writes(tmp_path: Path, name: str) -> None:
    reconstruction = synthesize(cameras=2, frames=3)
    for kind, write in (("text", reconstruction.write_text), ("binary", reconstruction.write_binary)):
        (tmp_path / kind).mkdir()
        write(tmp_path / kind)
    assert write_as_binary({name: tmp_path / "text" / f"{name}.txt"}, tmp_path) == []
    ours, theirs = (tmp_path / f"{name}.bin").read_bytes(), (tmp_path / "binary" / f"{name}.bin").read_bytes()
    assert len(ours) == len(theirs)
    if name == "images":  # their order is that of a hash table
        ours, theirs = (bytes(sorted(content)) for content in (ours, theirs))
    assert ours == theirs


@pytest.mark.parametrize("ends", ["kept", "left out"])
def test_images_without_keypoints(tmp_path: Path, ends: str) -> None:
    reconstruction, model = text_model(tmp_path, NAMES)
    lines = (model / "images.txt").read_text().splitlines()
    heads = [line for line in lines if line.endswith(".png")]
    (model / "images.txt").write_text("".join(line + ("\n\n" if ends == "kept" else "\n") for line in heads))
    points = [line.split()[:8] for line in (model / "points3D.txt").read_text().splitlines() if line[0] != "#"]
    (model / "points3D.txt").write_text("\n".join(" ".join(point) for point in points) + "\n")
    assert count_images(model) == len(NAMES)
    assert_same_poses(model, poses(reconstruction))


def test_counts_in_comments_are_compared_with_what_is_read(tmp_path: Path) -> None:
    _, model = text_model(tmp_path, NAMES)
    for name in ("rigs.txt", "frames.txt"):
        (model / name).unlink()
    edit(model / "images.txt", lambda content: content.replace(b"images: 7", b"images: 9"))
    edit(model / "points3D.txt", lambda content: content.replace(b"points: 50", b"points: 51"))
    notes = load(colmap_options(tmp_path)).notes
    assert "images.txt states 9 images and holds 7." in notes
    assert "points3D.txt states 51 points3D and holds 50." in notes


WRONG = {
    "cameras: fewer": ("cameras", b" 64 48", b" 64", "cameras.txt cannot be read at line 4: .*4 para.*, and 3 are"),
    "cameras: no number": (
        "cameras",
        b" 64 48",
        b" 64 4x8",
        "line 4: could not convert string to float: '4x8'",
    ),
    "cameras: no size": ("cameras", b" 64 48", b" 0 48", "line 4: a camera of 0x48 pixels"),
    "cameras: model": ("cameras", b"PINHOLE", b"Pinhole", "model 'Pinhole' is unknown .* Did you mean 'PINHOLE'"),
    "images: words": ("images", b" 1 plain.png", b"", r"images.txt cannot be read at line \d+: it is no IMAGE_ID, QW"),
    "images: camera": ("images", b" 1 plain.png", b" 1,0 plain.png", r"line \d+: .* float: '1,0'"),
    "images: unknown camera": (
        "images",
        b" 1 plain.png",
        b" 4 plain.png",
        r"\d of images refers to 4 of cameras",
    ),
    "images: twice": ("images", b"\n2 ", b"\n1 ", "id 1 stands twice in images"),
    "points: colour": ("points3D", b" 0 0 0 0 ", b" 0 300 0 0 ", "points3D.txt .* line 4: '0 300 0' is no colour"),
    "points: track": ("points3D", b" 0 0 0 0 ", b" 0 0 0 0 7 ", "line 4: 15 numbers are no track"),
    "frames: words": ("frames", b" 1 CAMERA 1 ", b" 2 CAMERA 1 ", "frames.txt .* line 4: it lists 1 of 2 images"),
    "frames: rig": ("frames", b"\n1 1 ", b"\n1 6 ", "entry 1 of frames refers to 6 of rigs, which is not there"),
    "frames: kind": ("frames", b"CAMERA", b"CAMARA", "'CAMARA 1' is no sensor"),
    "rigs: rest": ("rigs", b"CAMERA 1", b"CAMERA 1 7", "rigs.txt .* line 4: 1 words are left over"),
    "no UTF-8": ("images", b"plain.png", b"pl\xe4in.png", "images.txt holds bytes that are no UTF-8 .*after line"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_line_is_named(tmp_path: Path, case: str) -> None:
    _, model = text_model(tmp_path, NAMES)
    name, right, wrong, words = WRONG[case]
    assert right in (model / f"{name}.txt").read_bytes()
    edit(model / f"{name}.txt", lambda content: content.replace(right, wrong, 1))
    refused(words, load, colmap_options(tmp_path))


def test_one_of_rigs_and_frames_is_not_enough(tmp_path: Path) -> None:
    _, model = text_model(tmp_path, NAMES)
    (model / "frames.txt").unlink()
    with pytest.raises(
        InputError, match=r"has rigs\.txt and lacks frames\.txt: copy that as well, or remove rigs\.txt"
    ):
        load(colmap_options(tmp_path))


def test_pycolmap_ends_names_at_blanks(tmp_path: Path) -> None:
    """The reason for our own reader: it may go when this fails."""
    renamed(["a b.png", "a c.png"]).write_text(tmp_path)
    assert {image.name for image in pycolmap.Reconstruction(tmp_path).images.values()} == {"a"}


def test_photos_of_text_models_are_found(tmp_path: Path) -> None:
    reconstruction, _ = text_model(tmp_path, NAMES)
    write_photos(reconstruction, tmp_path / "reduced", (21, 16))
    assert len(load(colmap_options(tmp_path, images="reduced")).train) == len(NAMES) - 1
