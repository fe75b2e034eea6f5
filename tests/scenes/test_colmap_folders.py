"""Where programs put COLMAP models and their photos: gsx FOLDER takes them, or stops and names them."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from refusals import refused
from synthetic_colmap import colmap_options, shipped, synthesize, write_photos, write_scene

from gsx.builtin import plugins
from gsx.cli.train import scene_words
from gsx.core.errors import InputError
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.inspect import describe, readable
from gsx.formats.ply import write_ply
from gsx.scenes.colmap import load

RECONSTRUCTION = synthesize()
PHOTO = "camera000001_frame000000.png"


def write_model(folder: Path, text: bool = False, reconstruction: Any = RECONSTRUCTION) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(folder)
    return folder


def chosen(folder: Path) -> tuple[str, str, int]:
    """What `gsx FOLDER` loads: format, folder of photos relative to `folder`, number of views."""
    loader, its = readable(folder, plugins())[0]
    options = colmap_options(folder, **its.overrides(folder))
    scene = load(options)
    return loader.name, options.images, len(scene.train) + len(scene.test)


LAYOUTS = [
    ("sparse/0", "images"),  # COLMAP, 3D-GS
    ("sparse", "images"),
    ("Sparse/0", "images"),
    (".", "images"),  # RealityScan, Metashape
    (".", "."),
    ("colmap/sparse/0", "images"),  # nerfstudio
    ("colmap/sparse/0", "colmap/images"),
    ("colmap", "images"),
    ("colmap_sparse/0", "images"),  # instant-ngp
    ("colmap_text", "images"),
    ("distorted/sparse/0", "input"),  # INRIA's convert.py
    ("dense/0/sparse", "dense/0/images"),  # COLMAP's automatic reconstruction
    ("dense/sparse", "dense/images"),
    ("undistorted/sparse", "undistorted/images"),
    ("model", "images"),
    ("outputs/sfm", "images"),  # hloc
    ("sfm_superpoint+superglue", "images"),
    ("glomap/0", "images"),
    ("0", "images"),
    ("sparse/0", "photos/images"),
    ("sparse/0", "images_2"),
]


@pytest.mark.parametrize(("model", "images"), LAYOUTS)
def test_gsx_folder_takes_the_model_and_its_photos(tmp_path: Path, model: str, images: str) -> None:
    write_model(tmp_path / model)
    write_photos(RECONSTRUCTION, tmp_path / images)
    assert chosen(tmp_path) == ("colmap", images, 5)


def test_the_command_of_a_layout_loads(tmp_path: Path) -> None:
    folder = tmp_path / "a=b, c"
    write_model(folder / "dense" / "0" / "sparse")
    write_photos(RECONSTRUCTION, folder / "dense" / "0" / "images")
    options = compose(scene_words(folder, [], plugins()), plugins()).scene.options
    assert (options.name, options.images) == ("colmap", "dense/0/images")
    lines = describe(folder, plugins())
    assert "note      Took the model dense/0/sparse with 5 images." in lines
    assert not [line for line in lines if line.startswith("problem")]


@pytest.mark.parametrize("way", [str.upper, str.lower, str.title])
@pytest.mark.parametrize("text", [False, True])
def test_files_of_a_model_are_found_in_any_case(tmp_path: Path, way: Any, text: bool) -> None:
    write_model(tmp_path, text)
    for file in [file for file in tmp_path.iterdir() if file.is_file()]:
        file.rename(file.with_name(way(file.stem) + file.suffix))
    write_photos(RECONSTRUCTION, tmp_path / "images")
    assert chosen(tmp_path) == ("colmap", "images", 5)


@pytest.mark.parametrize("inner", ["sparse/0", "colmap/sparse/0", "sparse"])
def test_the_folder_of_a_model_finds_photos_above(tmp_path: Path, inner: str) -> None:
    write_model(tmp_path / inner)
    write_photos(RECONSTRUCTION, tmp_path / "images")
    up = "/".join([".."] * (inner.count("/") + 1))
    assert chosen(tmp_path / inner) == ("colmap", f"{up}/images", 5)


def test_photos_in_an_unusual_place_are_found_and_named(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse" / "0")
    write_photos(RECONSTRUCTION, tmp_path / "photos")
    for changes in ({}, {"model": str(tmp_path / "sparse" / "0")}, {"model": "../copy"}, {"adjust": "always"}):
        write_model(tmp_path.parent / "copy")
        assert load(colmap_options(tmp_path, **changes)).notes[0] == "Photos are those in photos."


def test_numbered_models_find_photos_above(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse" / "0")
    write_model(tmp_path / "sparse" / "1", reconstruction=synthesize(frames=7))
    write_photos(synthesize(frames=7), tmp_path / "images")
    assert chosen(tmp_path / "sparse") == ("colmap", "../images", 7)


def test_photos_of_the_right_size_are_taken(tmp_path: Path) -> None:
    """Undistorted photos have the names of the originals, and another camera."""
    write_model(tmp_path / "distorted" / "sparse" / "0")
    write_photos(RECONSTRUCTION, tmp_path / "input")
    write_photos(RECONSTRUCTION, tmp_path / "images", (60, 40))
    assert chosen(tmp_path) == ("colmap", "input", 5)
    write_model(tmp_path / "dense" / "0" / "sparse")
    write_photos(RECONSTRUCTION, tmp_path / "dense" / "0" / "images", (64, 40))
    assert load(colmap_options(tmp_path, model="distorted/sparse/0")).provenance["image_folder"] == "input"


def test_the_usual_model_is_preferred_and_a_larger_one_named(tmp_path: Path) -> None:
    write_scene(RECONSTRUCTION, tmp_path)
    write_model(tmp_path / "distorted" / "sparse" / "0", reconstruction=synthesize(frames=6))
    notes = load(colmap_options(tmp_path)).notes
    assert notes[0].startswith("Took the model sparse/0 with 5 images; not used, with images: distorted/sparse/0 (6)")


def test_transforms_are_preferred_to_the_model_that_they_were_made_from(tmp_path: Path) -> None:
    write_model(tmp_path / "colmap" / "sparse" / "0")
    write_photos(RECONSTRUCTION, tmp_path / "images")
    (tmp_path / "transforms.json").write_text("{}")
    assert scene_words(tmp_path, [], plugins())[0] == "scene=transforms"


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("text", [False, True])
def test_an_incomplete_model_stops_and_is_named(tmp_path: Path, name: str, text: bool) -> None:
    suffix = ".txt" if text else ".bin"
    model = write_scene(RECONSTRUCTION, tmp_path, text=text)
    (model / f"{name}{suffix}").unlink()
    refused(rf"{model} lacks {name}\{suffix}: copy the whole model folder again", scene_words, tmp_path, [], plugins())


def test_an_incomplete_model_leaves_a_choice(tmp_path: Path) -> None:
    write_scene(RECONSTRUCTION, tmp_path)
    (write_model(tmp_path / "sparse" / "1") / "images.bin").unlink()
    refused(r"sparse/1 lacks images\.bin: .* scene\.model=sparse/0", scene_words, tmp_path, [], plugins())
    assert len(load(colmap_options(tmp_path, model="sparse/0")).train) == 4
    with pytest.raises(InputError, match=r"scene\.model 'sparse/2' is no folder with a COLMAP model"):
        load(colmap_options(tmp_path, model="sparse/2"))


def test_files_of_two_kinds_are_named(tmp_path: Path) -> None:
    model = write_scene(RECONSTRUCTION, tmp_path)
    for name in ("points3D", "rigs", "frames"):
        (model / f"{name}.bin").unlink()
    (model / "points3D.txt").touch()
    refused(r"lacks points3D\.bin \(points3D\.txt: one model has files of one kind\)", load, colmap_options(tmp_path))
    write_model(model, text=True)
    assert len(load(colmap_options(tmp_path)).train) == 4  # the text is whole


def test_a_ply_stands_in_for_points(tmp_path: Path) -> None:
    model = write_scene(RECONSTRUCTION, tmp_path)
    points = np.array([RECONSTRUCTION.points3D[number].xyz for number in sorted(RECONSTRUCTION.points3D)], np.float32)
    write_ply(model / "points3D.ply", dict(zip("xyz", points.T, strict=True)))
    (model / "points3D.bin").unlink()
    scene = load(colmap_options(tmp_path))
    np.testing.assert_array_equal(scene.points.positions.numpy(), points)
    assert any("Points are those of points3D.ply" in note for note in scene.notes)
    assert any("no observations to check the cameras; 100%" in note for note in scene.notes)
    with pytest.raises(InputError, match=r"keeps no observations to adjust cameras by: set scene\.adjust=never"):
        load(colmap_options(tmp_path, adjust="always"))


@pytest.mark.parametrize("place", ["results/final", "my reconstruction of may/a/b"])
def test_a_model_in_an_unusual_place_stops_structure_from_motion(tmp_path: Path, place: str) -> None:
    write_model(tmp_path / place)
    write_photos(RECONSTRUCTION, tmp_path / "images")
    with pytest.raises(InputError, match=rf"COLMAP model in {place} \(5 images\): .* scene\.model={place}; to recon"):
        scene_words(tmp_path, [], plugins())
    scene = load(colmap_options(tmp_path, model=place))
    assert len(scene.train) == 4


def test_poses_that_are_not_used_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    logging.getLogger("gsx").propagate = True
    write_scene(RECONSTRUCTION, tmp_path)
    (tmp_path / "images" / "poses_bounds.npy").touch()
    assert scene_words(tmp_path / "images", [], plugins())[0] == "scene=photos"
    assert "cameras of LLFF, which gsx does not read" in caplog.text
    assert f"{tmp_path} has poses of photos, which are not used here: gsx {tmp_path} uses them" in caplog.text


def test_a_database_is_no_model(tmp_path: Path) -> None:
    write_photos(RECONSTRUCTION, tmp_path / "images")
    pycolmap.Database.open(tmp_path / "database.db").close()
    (tmp_path / "sparse").mkdir()
    assert scene_words(tmp_path, [], plugins())[0] == "scene=photos"


def test_scenes_below_a_folder_are_not_its_models(tmp_path: Path) -> None:
    for name in ("garden", "24"):
        write_scene(RECONSTRUCTION, tmp_path / name)
    refused(r"There are scenes below it: 24 \(colmap\), garden \(colmap\)", scene_words, tmp_path, [], plugins())


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


@pytest.mark.parametrize("file", ["sparse/0/points3D.bin", "sparse/0/cameras.bin", f"images/{PHOTO}"])
def test_a_file_that_git_lfs_has_not_fetched_is_named(tmp_path: Path, file: str) -> None:
    write_scene(RECONSTRUCTION, tmp_path)
    (tmp_path / file).write_bytes(POINTER)
    refused(rf"'{tmp_path / file}' is a Git LFS pointer.*: run 'git lfs pull'", load, colmap_options(tmp_path))


def test_the_place_of_the_model_has_no_effect_on_the_name_of_a_run() -> None:
    assert shipped("colmap")["model"] == "auto"


# names


SIMILAR = {
    "suffix": (
        "0001.jpg",
        r"0001\.png is there instead of 0001\.jpg \(another suffix: convert the photos to",
    ),
    "case": ("IMG_0001.PNG", r"img_0001\.png is there instead of IMG_0001\.PNG \(another case: rename"),
    "folder": (
        "cam/0001.png",
        r"0001\.png is there instead of cam/0001\.png \(another folder: set scene\.im",
    ),
    "path": ("C:\\shots\\0001.png", r"0001\.png is there instead of C:/shots/0001\.png \(an absolute path: cut"),
    "form": ("u\u0308.png", "\u00fc\\.png is there instead of u\u0308\\.png"),
}


@pytest.mark.parametrize("case", SIMILAR)
def test_photos_that_are_called_otherwise_are_named(tmp_path: Path, case: str) -> None:
    (name, words), folder = SIMILAR[case], "images"
    reconstruction = synthesize()
    write_photos(reconstruction, tmp_path / folder)
    first = reconstruction.images[1]
    present = {"form": "\u00fc.png", "case": "img_0001.png"}.get(case, "0001.png")
    (tmp_path / folder / first.name).rename(tmp_path / folder / present)
    first.name = name
    write_model(tmp_path / "sparse" / "0", reconstruction=reconstruction)
    refused(words, load, colmap_options(tmp_path, missing=0.0))
    for other in (tmp_path / folder).glob("camera*"):
        other.unlink()
    refused(rf"None of the 5 images.*{words}", load, colmap_options(tmp_path))


def test_backslashes_are_slashes(tmp_path: Path) -> None:
    reconstruction = synthesize()
    for image in reconstruction.images.values():
        image.name = f"left/{image.name}"
    write_photos(reconstruction, tmp_path / "images")
    for image in reconstruction.images.values():
        image.name = image.name.replace("/", "\\")
    write_model(tmp_path / "sparse" / "0", reconstruction=reconstruction)
    assert all(view.name.startswith("left/") for view in load(colmap_options(tmp_path)).train)
