"""Stamps of folders: what changes them, what does not."""

import os
from pathlib import Path

from gsx.experiments.run_folder.stamps import READ, tree_stamp


def scene_in(folder: Path) -> Path:
    """Two photos and a model, written at known times."""
    for name in ("images/a.png", "images/b.png", "sparse/0/cameras.bin"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
        os.utime(folder / name, ns=(0, 10**9))
    return folder


def test_a_folder_is_known_by_what_it_holds_wherever_it_lies(tmp_path: Path) -> None:
    first, second = (scene_in(tmp_path / name) for name in ("a", "b"))
    stamp = tree_stamp(first, Path("outputs"))
    assert tree_stamp(second, Path("outputs")) == stamp
    first.rename(tmp_path / "elsewhere")
    assert tree_stamp(tmp_path / "elsewhere", Path("outputs")) == stamp
    photo = second / "images" / "a.png"
    os.utime(photo, ns=(0, 10**9 + 1))
    assert tree_stamp(second, Path("outputs")) == stamp
    photo.write_text("images/b.png")
    os.utime(photo, ns=(0, 10**9))
    other = tree_stamp(second, Path("outputs"))
    photo.write_text("another photo")
    os.utime(photo, ns=(0, 10**9))
    larger = tree_stamp(second, Path("outputs"))
    photo.write_text("images/a.png")
    os.utime(photo, ns=(0, 10**9))
    assert tree_stamp(second, Path("outputs")) == stamp
    photo.rename(second / "images" / "c.png")
    renamed = tree_stamp(second, Path("outputs"))
    (second / "images" / "c.png").rename(second / "a.png")
    moved = tree_stamp(second, Path("outputs"))
    assert len({stamp, other, larger, renamed, moved}) == 5


def test_large_files_are_known_by_their_size_and_time(tmp_path: Path) -> None:
    large, stamps = tmp_path / "points3D.bin", []
    large.write_bytes(bytes(READ + 1))
    for time in (10**9, 10**9, 10**9 + 1):
        os.utime(large, ns=(0, time))
        stamps.append(tree_stamp(tmp_path, Path("outputs")))
    assert stamps[0] == stamps[1] != stamps[2]


def test_what_gsx_writes_beside_photos_and_hidden_names_change_no_stamp(tmp_path: Path) -> None:
    scene = scene_in(tmp_path / "scene")
    stamp = tree_stamp(scene, scene / "outputs")
    for name in (".DS_Store", ".thumbnails/a.png", "outputs/experiments/t/table.csv", "runs/mine/config.yaml",
                 "runs/mine/renders/a.png"):  # fmt: skip
        (scene / name).parent.mkdir(parents=True, exist_ok=True)
        (scene / name).write_text("new")
        assert tree_stamp(scene, scene / "outputs") == stamp, name
    (scene / "more.png").write_text("new")
    assert tree_stamp(scene, scene / "outputs") != stamp


def test_links_are_followed_and_lead_nobody_round_in_circles(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "a.png").write_text("a")
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "images").symlink_to(tmp_path / "store")
    stamp = tree_stamp(scene, Path("outputs"))
    (tmp_path / "store" / "back").symlink_to(scene)
    assert tree_stamp(scene, Path("outputs")) == stamp
    (tmp_path / "store" / "a.png").write_text("another")
    assert tree_stamp(scene, Path("outputs")) != stamp
