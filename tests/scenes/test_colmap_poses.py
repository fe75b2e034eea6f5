"""Models whose files contradict each other about poses: COLMAP 4 keeps them in frames and rigs, and in images."""

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from refusals import refused
from synthetic_colmap import colmap_options, synthesize, write_scene

from gsx.core.errors import InputError
from gsx.scenes.colmap import FORMAT, load
from gsx.scenes.colmap_model import read_model
from gsx.scenes.colmap_poses import binary_poses

POSE_AT = 4
"""Of a record of images.bin: after the image's id."""


def records(file: Path) -> list[bytes]:
    """The records of an images.bin."""
    data, out, at = file.read_bytes(), [], 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        end = data.index(b"\0", at + 64) + 1
        end += 8 + 24 * struct.unpack_from("<Q", data, end)[0]
        out.append(data[at:end])
        at = end
    return out


def write_records(file: Path, rows: list[bytes]) -> None:
    file.write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))


def moved(record: bytes, by: tuple[float, float, float], degrees: float = 0.0, sign: float = 1.0) -> bytes:
    """A record whose camera is moved in its own frame and turned about its axis, by a quaternion of either sign."""
    pose = np.array(struct.unpack_from("<7d", record, POSE_AT))
    half = math.radians(degrees) / 2
    turn = pycolmap.Rotation3d(np.array([0.0, 0.0, math.sin(half), math.cos(half)]))
    old = pycolmap.Rotation3d(pose[[1, 2, 3, 0]])
    new, translation = turn * old, turn.matrix() @ pose[4:] - np.array(by)
    quaternion = sign * np.array(new.quat)[[3, 0, 1, 2]]
    return record[:POSE_AT] + struct.pack("<7d", *quaternion, *translation) + record[POSE_AT + 56 :]


def changed_images(model: Path, change: Any) -> list[str]:
    """Write images.bin with its first two images changed, as a script of COLMAP 3 does; returns their names."""
    file = model / "images.bin"
    rows = records(file)
    write_records(file, [change(row) for row in rows[:2]] + rows[2:])
    return sorted(name for _, _, name in list(binary_poses(file))[:2])


def test_poses_of_images_that_frames_do_not_know_are_named(tmp_path: Path) -> None:
    """Cameras at 5 units from the origin, moved by 0.3 and 0.4 units and turned by 7 degrees."""
    reconstruction = synthesize(cameras=2, frames=3)
    model = write_scene(reconstruction, tmp_path)
    names = changed_images(model, lambda row: moved(row, (0.3, 0.4, 0.0), 7.0))
    scene = load(colmap_options(tmp_path))
    note = (
        f"images.bin and frames.bin state different poses of 2 images (by up to 7 degrees and 0.5 units: "
        f"{', '.join(names)}): those of frames.bin are used, as by COLMAP 4. If images.bin is right, remove frames.bin "
        "and rigs.bin."
    )
    assert note in scene.notes
    by_name = {image.name: image for image in reconstruction.images.values()}
    for view in [*scene.train, *scene.test]:
        expected = by_name[view.name].cam_from_world().matrix()
        np.testing.assert_allclose(view.camera.rotation, expected[:, :3], atol=1e-12)
        np.testing.assert_allclose(view.camera.translation, expected[:, 3], atol=1e-12)


def test_the_remedy_gives_the_poses_of_images(tmp_path: Path) -> None:
    model = write_scene(synthesize(), tmp_path)
    changed_images(model, lambda row: moved(row, (0.01, 0.0, 0.0)))
    stated = {name: pose for _, pose, name in binary_poses(model / "images.bin")}
    for name in ("frames", "rigs"):
        (model / f"{name}.bin").unlink()
    scene = load(colmap_options(tmp_path))
    assert not any("state different poses" in note for note in scene.notes)
    for view in [*scene.train, *scene.test]:
        np.testing.assert_allclose(view.camera.translation, stated[view.name][4:], atol=1e-12)


@pytest.mark.parametrize("size", [1e-9, 1e-7])
def test_rounded_poses_and_the_other_sign_are_the_same(tmp_path: Path, size: float) -> None:
    model = write_scene(synthesize(cameras=2, frames=3), tmp_path)
    changed_images(model, lambda row: moved(row, (size, 0.0, 0.0), math.degrees(size), sign=-1.0))
    assert read_model(model).conflict == ""


@pytest.mark.parametrize("pose", [[0.0] * 7, [math.nan] * 7])
def test_poses_that_are_none_differ(tmp_path: Path, pose: list[float]) -> None:
    """As of a program that leaves zeros in images, since frames hold the poses."""
    model = write_scene(synthesize(), tmp_path)
    names = changed_images(model, lambda row: row[:POSE_AT] + struct.pack("<7d", *pose) + row[POSE_AT + 56 :])
    assert f"state different poses of 2 images (2 without a rotation: {', '.join(names)})" in read_model(model).conflict


def test_text_models_are_compared(tmp_path: Path) -> None:
    model = write_scene(synthesize(cameras=2, frames=3), tmp_path, text=True)
    assert read_model(model).conflict == ""
    lines = (model / "images.txt").read_text().splitlines()
    at = next(index for index, line in enumerate(lines) if not line.startswith("#"))
    words = lines[at].split()
    lines[at] = " ".join([*words[:5], str(float(words[5]) + 0.25), *words[6:]])
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    assert read_model(model).conflict == (
        f"images.txt and frames.txt state different poses of 1 images (by up to 0 degrees and 0.25 units: {words[9]}): "
        "those of frames.txt are used, as by COLMAP 4. If images.txt is right, remove frames.txt and rigs.txt."
    )


def test_text_beside_a_binary_model_is_compared(tmp_path: Path) -> None:
    reconstruction = synthesize()
    model = write_scene(reconstruction, tmp_path)
    write_scene(reconstruction, tmp_path, text=True)
    assert read_model(model).conflict == ""
    other = synthesize()
    for frame in other.frames.values():
        pose = frame.rig_from_world
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.0, 0.0, 1.0]))
    write_scene(other, tmp_path, text=True)
    conflict = read_model(model).conflict
    assert conflict.startswith("images.txt states other poses than the binary model for 5 images (by up to ")
    assert "(by up to 0 degrees and 1 units: " in conflict


def test_a_list_of_photos_beside_a_binary_model_is_no_model(tmp_path: Path) -> None:
    """Other programs have files of that name, too: an id and a name, or a few numbers."""
    model = write_scene(synthesize(), tmp_path)
    names = [image.name for image in read_model(model).images]
    (model / "images.txt").write_text("".join(f"{number} {name}\n\n" for number, name in enumerate(names)))
    assert read_model(model).conflict == ""
    (model / "images.txt").write_text("".join(f"{number} 1 0 0 0 {name}\n\n" for number, name in enumerate(names)))
    assert read_model(model).conflict == ""


def test_a_scene_that_was_scaled_without_its_frames_is_explained(tmp_path: Path) -> None:
    """Points and images.bin by 3: the cameras of frames.bin miss the points, and the refusal says why."""
    reconstruction = synthesize()
    for point in reconstruction.points3D.values():
        point.xyz = 3 * point.xyz + np.array([0.5, 0.0, 0.0])
    model = write_scene(reconstruction, tmp_path)
    rows = records(model / "images.bin")
    write_records(model / "images.bin", [moved(row, (0.0, 0.0, 1.0)) for row in rows])
    with pytest.raises(
        InputError, match=r"scene\.adjust=auto.*\. images\.bin and frames\.bin state.*remove frames\.bin"
    ):
        load(colmap_options(tmp_path))


def test_lists_of_images_that_differ_are_explained(tmp_path: Path) -> None:
    model = write_scene(synthesize(), tmp_path)
    rows = records(model / "images.bin")
    lost = struct.unpack_from("<I", rows[-1])[0]
    write_records(model / "images.bin", rows[:-1])
    refused(rf"frames lists image {lost}, which images lacks; .* remove frames\.bin and rigs", read_model, model)
    more = struct.pack("<I", 77) + rows[0][4:64] + b"new.png\0" + struct.pack("<Q", 0)
    write_records(model / "images.bin", [*rows, more])
    refused(r"images lists new\.png \(image 77\), which frames lacks; .* remove frames\.bin", read_model, model)


def test_points_that_were_removed_from_their_file_alone_are_left_out(tmp_path: Path) -> None:
    """As by a script that crops points3D.bin: images go on observing all 50."""
    model = write_scene(synthesize(), tmp_path)
    data, rows, at = (model / "points3D.bin").read_bytes(), [], 8
    for _ in range(50):
        end = at + 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
        rows.append(data[at:end])
        at = end
    write_records(model / "points3D.bin", rows[:40])
    scene = load(colmap_options(tmp_path))
    assert len(scene.points) == 40
    assert "Images observe points that points3D.bin lacks, as where points" in scene.notes[0]
    assert scene.notes[-1].startswith("Reprojection error 0.00 px (median of 200 observations")
    adjusted = load(colmap_options(tmp_path, adjust="always")).notes
    assert adjusted[0] == scene.notes[0]
    assert "then pictures are 0.00 px" in adjusted[1]


def test_gsx_scenes_says_it(tmp_path: Path) -> None:
    model = write_scene(synthesize(), tmp_path)
    changed_images(model, lambda row: moved(row, (0.3, 0.0, 0.0)))
    assert any(note.startswith("images.bin and frames.bin") for note in load(colmap_options(tmp_path)).notes)
    assert any(line.startswith("model") for line in FORMAT.facts(tmp_path))
    assert torch.isfinite(load(colmap_options(tmp_path, adjust="auto")).points.positions).all()
