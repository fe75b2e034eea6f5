"""BungeeNeRF scenes: groups and splits worked out by hand, cameras placed by hand."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from refusals import refused
from synthetic_colmap import shipped

from gsx.core.data.camera import look_at
from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene, View
from gsx.core.errors import ConfigError
from gsx.formats.ply import write_ply
from gsx.scenes.bungee import (
    BungeeOptions,
    city_points,
    load,
    scale_of_number,
    scales_of_distances,
    split_views,
)

WIDTH, HEIGHT, FOCAL = 48, 36, 50.0
SCENE_SCALE = 0.002  # 250 m are half a unit
SHARES = [1, 1, 1, 2, 2, 3, 3, 4]  # scale of each of eight images, near to far, for scale_split [7, 5, 3, 0]


def down(height: float) -> list[list[float]]:
    """OpenGL camera-to-world of a camera straight above the origin that looks down, north up: back is +z."""
    return [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, height]]


def write(folder: Path, count: int = 8, **content: Any) -> None:
    (folder / "images").mkdir(exist_ok=True)
    matrices = [np.hstack([down(2.0 + i), [[HEIGHT], [WIDTH], [FOCAL]]]) for i in range(count)]
    poses = [[*matrix.flatten().tolist(), 0.1, 10.0] for matrix in matrices]
    file = {"poses": poses, "scene_scale": SCENE_SCALE, "scene_origin": [0, 0, -6371011], "scale_split": [7, 5, 3, 0]}
    (folder / "poses_enu.json").write_text(json.dumps(file | content))
    for i in range(count):
        photo = folder / "images" / f"city_{i:03d}.jpeg"
        write_image(photo, torch.full((3, HEIGHT, WIDTH), i / 10))
        photo.write_bytes(photo.read_bytes() + bytes([i]))  # after its end: from number 10 on pictures are alike


def write_colmap(folder: Path, count: int = 8) -> None:
    """A text model with cameras above the origin, as high as those of `write`, that look down: diag(1, -1, -1)."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n")
    lines = [f"{i + 1} 0 1 0 0 0 0 {2 + i} 1 city_{i:03d}.jpeg\n\n" for i in range(count)]
    (model / "images.txt").write_text("".join(lines))
    spots = [(0.1, 0.1, 0), (-0.1, 0.1, 0), (0, -0.1, 0), (0, 0, 0)]
    points = [f"{i + 1} {x} {y} {z} 9 9 9 0.1\n" for i, (x, y, z) in enumerate(spots)]
    (model / "points3D.txt").write_text("".join(points))


def options(folder: Path, **changes: Any) -> BungeeOptions:
    """The shipped configuration with changes."""
    small = {"path": str(folder), "random_points": 50}
    merged = OmegaConf.merge(OmegaConf.structured(BungeeOptions), shipped("bungee"), small, changes)
    made = OmegaConf.to_object(merged)
    assert isinstance(made, BungeeOptions)
    return made


def views(scene: Scene) -> list[View]:
    return sorted([*scene.train, *scene.test], key=lambda view: view.name)


def test_points_project_where_the_hand_says(tmp_path: Path) -> None:
    write(tmp_path)
    view = views(load(options(tmp_path)))[3]
    # 5 below; east is right, north is up in the picture
    pixel, depth = view.camera.project(torch.tensor([[1.0, 0.5, 0.0]]))
    torch.testing.assert_close(pixel, torch.tensor([[24 + 50 / 5, 18 - 25 / 5]]))
    assert depth.tolist() == [5]
    assert float((view.image() - 0.3).abs().max()) < 0.01


def test_scale_split_makes_the_groups(tmp_path: Path) -> None:
    write(tmp_path)
    scene = load(options(tmp_path))
    assert [view.group for view in views(scene)] == [f"scale-{scale}" for scale in SHARES]
    note = next(note for note in scene.notes if "scale" in note)
    assert "scale-1: 3, scale-2: 2, scale-3: 2, scale-4: 1" in note
    assert "poses_enu.json" in note


def test_numbers_of_the_published_example() -> None:
    starts = [275, 150, 70, 0]  # 56Leonard
    assert [scale_of_number(i, starts) for i in (0, 69, 70, 149, 150, 274, 275, 400)] == [1, 1, 2, 2, 3, 3, 4, 4]


def test_log_distance_bins_by_hand() -> None:
    # logs to base 10: 0, 0.6, 0.9, 1.6, 2.2, 2.3, 3; the bins are 0.75 wide
    distances = torch.tensor([1.0, 10**0.6, 10**0.9, 10**1.6, 10**2.2, 10**2.3, 1000.0])
    assert scales_of_distances(distances) == [1, 1, 2, 3, 3, 4, 4]
    assert scales_of_distances(torch.tensor([5.0, 5.0])) == [1, 1]
    assert scales_of_distances(torch.tensor([0.0, 1.0])) == [1, 4]


def test_without_scale_split_distances_decide(tmp_path: Path) -> None:
    write(tmp_path)
    file = tmp_path / "poses_enu.json"
    content = json.loads(file.read_text())
    del content["scale_split"]
    file.write_text(json.dumps(content))
    scene = load(options(tmp_path))
    # heights 2..9: log2 spans 1 to 3.17, bins end at 2.91, 4.24 and 6.18
    assert [view.group[-1] for view in views(scene)] == list("12233444")
    assert any("log distance" in note for note in scene.notes)
    assert "log distance" in scene.provenance["scales"]


def test_every_eighth_and_file_order(tmp_path: Path) -> None:
    write(tmp_path, count=17)
    scene = load(options(tmp_path))
    assert [view.name for view in scene.test] == [f"city_{i:03d}.jpeg" for i in (0, 8, 16)]
    assert [view.name for view in scene.train[:3]] == [f"city_{i:03d}.jpeg" for i in (1, 2, 3)]
    heights = [float(view.camera.centre[2]) for view in scene.train]
    assert scene.extent == pytest.approx(1.1 * max(abs(h - np.mean(heights)) for h in heights))


def test_lod_split_is_the_published_one() -> None:
    names = [f"{i:03d}.png" for i in range(80)]
    train, test = split_views(names, "lod:30", Path())
    assert test == list(range(31))
    assert train == list(range(31, 80))
    train, test = split_views(names, "lod:50", Path())
    assert train == list(range(51))
    assert test == list(range(51, 80))
    assert split_views(names[::-1], "lod:2", Path())[1] == [79, 78, 77]


def test_lod_split_in_a_scene(tmp_path: Path) -> None:
    write(tmp_path)
    scene = load(options(tmp_path, split="lod:3"))
    assert [view.name for view in scene.test] == [f"city_{i:03d}.jpeg" for i in range(4)]
    assert scene.provenance["split"] == "lod:3"
    refused("lod:7' leaves none of 8", load, options(tmp_path, split="lod:7"))
    refused("at least 2 images", load, options(tmp_path, split="lod:6"))
    for rule in ("lod", "lod:0", "lod:x", "lod:-1", "lod:nan", f"lod:{'8' * 5000}"):
        with pytest.raises(ConfigError, match="above 0 after lod"):
            load(options(tmp_path, split=rule))


def test_colmap_model_wins_and_keeps_the_groups(tmp_path: Path) -> None:
    write(tmp_path)
    own = views(load(options(tmp_path)))
    write_colmap(tmp_path)
    scene = load(options(tmp_path))
    assert len(scene.points) == 4
    assert [view.group for view in views(scene)] == [view.group for view in own]
    assert [view.name for view in scene.test] == ["city_000.jpeg"]
    assert scene.provenance["format"] == "bungee"
    assert scene.provenance["split"] == "every:8"
    for view, other in zip(views(scene), own, strict=True):
        torch.testing.assert_close(view.camera.rotation, other.camera.rotation)
        torch.testing.assert_close(view.camera.translation, other.camera.translation)


def test_colmap_model_alone_is_grouped_by_distance(tmp_path: Path) -> None:
    write(tmp_path)
    write_colmap(tmp_path)
    (tmp_path / "poses_enu.json").unlink()
    scene = load(options(tmp_path))
    assert [view.group[-1] for view in views(scene)] == list("12233444")
    assert any("log distance" in note for note in scene.notes)


def test_city_points_are_where_cameras_look() -> None:
    cameras = [
        look_at([0, -3, 2], [0, 0, 0.2], fov_x=0.7, width=40, height=30),
        look_at([0, 30, 20], [0, 0, 0], fov_x=0.7, width=40, height=30),
    ]
    cloud = city_points(cameras, 400, 0.5, torch.Generator().manual_seed(0))
    assert len(cloud) == 400
    assert cloud.positions[:, 2].min() >= 0
    assert cloud.positions[:, 2].max() <= 0.5
    assert cloud.positions.norm(dim=1).max() <= math.hypot(30, 20)
    seen = []
    for camera in cameras:
        pixels, depth = camera.project(cloud.positions)
        seen.append((depth > 0) & (pixels > -1e-3).all(1) & (pixels < torch.tensor([40.001, 30.001])).all(1))
    assert (seen[0] | seen[1]).all()
    assert int(seen[0].sum()) > 100  # half the rays are the near camera's, so detail gets its share
    assert int((~seen[0]).sum()) > 100


def test_points_towards_the_horizon_stay_near() -> None:
    camera = look_at([0, -6, 2], [0, 0, 1.9], fov_x=0.7, width=40, height=30)
    cloud = city_points([camera], 100, 0.5, torch.Generator().manual_seed(0))
    assert cloud.positions.norm(dim=1).max() <= math.hypot(6, 2)


def test_cameras_that_look_up_need_points() -> None:
    up = look_at([0, 0, 5], [3, 0, 9], fov_x=0.5, width=40, height=30)
    refused("points down", city_points, [up], 10, 0.5, torch.Generator())


def test_points_of_the_original_data(tmp_path: Path) -> None:
    write(tmp_path)
    positions = load(options(tmp_path)).points.positions
    assert positions[:, 2].min() >= 0
    assert 0.3 < positions[:, 2].max() <= 250 * SCENE_SCALE
    write_ply(tmp_path / "cloud.ply", {axis: np.array([4.0]) for axis in "xyz"})
    assert load(options(tmp_path, points="cloud.ply")).points.positions.tolist() == [[4, 4, 4]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"poses": [[1.0] * 16]}, "rows of 17 finite numbers"),
        ({"poses": [[math.nan] * 17] * 8}, "rows of 17 finite numbers"),
        ({"poses": "none"}, "no table of numbers"),
        ({"poses": [[0.0] * 17] * 8}, "The pose of 'city_000.jpeg'"),
        ({"scale_split": [0, 3, 5, 7]}, r"scale_split \[0, 3, 5, 7\]"),
        ({"scale_split": [7, 5, 3]}, "falling to 0"),
        ({"scene_scale": 0}, "scene_scale 0"),
        ({"scene_scale": 10**400}, r"scene_scale 10+\.\.\.0+, give a number"),
        ({"poses": [[10**400] * 17]}, "no table of numbers"),
    ],
)
def test_damaged_poses_are_refused(tmp_path: Path, content: dict[str, Any], message: str) -> None:
    write(tmp_path, **content)
    refused(message, load, options(tmp_path))


def test_images_must_match_poses(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "images" / "city_003.jpeg").unlink()
    refused(r"has 8 poses and .* 7 images", load, options(tmp_path))
    refused("neither a COLMAP model nor", load, options(tmp_path / "images"))
