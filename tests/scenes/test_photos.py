"""Photos without poses: a real reconstruction of synthetic photos against its truth, and everything around it."""

import logging
import math
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest
import torch
from photo_files import write_pixels, write_webp_with_exif
from refusals import refused
from synthetic_colmap import shipped
from torch import Tensor

from gsx.core.data.images import image_size, read_image, write_image
from gsx.core.data.scene import Scene
from gsx.core.errors import ConfigError, InputError
from gsx.engine.cache import add_to_manifest
from gsx.experiments.runs.typed import typed
from gsx.scenes import photos, sfm
from gsx.scenes.orientation import AFTER_MIRROR, oriented, oriented_camera
from gsx.scenes.photos import PhotosOptions, find_photos, load, reconstruct

CAPTURES = Path(__file__).parents[3] / "shared" / "scenes"  # real ones, where a developer has them
FRAMES = 5
STRANGER = "stranger.png"


def options(folder: Path, **changes: Any) -> PhotosOptions:
    """The shipped configuration with changes."""
    values = shipped("photos") | {"path": str(folder), "num_threads": 1} | changes
    made = typed(PhotosOptions, values, "scene")
    assert isinstance(made, PhotosOptions)
    return made


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Photos of patches on a sphere, and one of another size without them; true camera centres by name."""
    folder = tmp_path_factory.mktemp("capture") / "garden" / "images"
    folder.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    settings = pycolmap.SyntheticDatasetOptions()
    settings.num_rigs, settings.num_frames_per_rig, settings.num_points3D = 1, FRAMES, 100
    settings.camera_width, settings.camera_height, settings.camera_params = 640, 480, [800, 320, 240, 0]
    settings.num_points2D_without_point3D = 0
    truth = pycolmap.synthesize_dataset(settings)
    pycolmap.synthesize_images(pycolmap.SyntheticImageOptions(), truth, folder)
    write_image(folder / STRANGER, torch.rand(3, 600, 400, generator=torch.Generator().manual_seed(0)))
    return folder.parent, {image.name: image.projection_center() for image in truth.images.values()}


@pytest.fixture(scope="module")
def reconstructed(capture: tuple[Path, Any], tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Scene, Path]]:
    """The scene of the capture, and the cache that keeps its reconstruction."""
    kept = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSX_CACHE", str(kept))
        patch.setattr(sfm, "LOG_SECONDS", 0.01)  # looks at the database while COLMAP writes it, as often as it can
        yield load(options(capture[0])), kept


# the real thing


def test_cameras_come_out_where_they_were(reconstructed: tuple[Scene, Path], capture: tuple[Path, Any]) -> None:
    scene, truth = reconstructed[0], capture[1]
    found = {view.name: view.camera.centre.numpy() for view in (*scene.train, *scene.test)}
    assert found.keys() == truth.keys()
    names = sorted(found)
    estimated, true = (np.array([centres[name] for name in names]) for centres in (found, truth))
    similarity = pycolmap.estimate_sim3d(estimated, true)
    moved = np.array([similarity * centre for centre in estimated])
    assert np.linalg.norm(moved - true, axis=1).max() < 0.05  # of a distance of 5 from the sphere


def test_scene_tells_what_became_of_the_photos(reconstructed: tuple[Scene, Path]) -> None:
    scene = reconstructed[0]
    assert scene.name == "garden"
    assert any(note.startswith(f"Reconstructed {FRAMES} of {FRAMES + 1} photos: ") for note in scene.notes)
    lost = f"1 of {FRAMES + 1} photos (17%) could not be placed and are not used: {STRANGER}. What would help: a larger"
    assert scene.notes[0].startswith(lost)
    assert scene.provenance["format"] == "photos"
    assert scene.provenance["sfm"]["max_features"] == 4096
    assert scene.train[0].image().shape[0] == 3


def test_reconstruction_is_found_again(
    reconstructed: tuple[Scene, Path], capture: tuple[Path, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("must not be computed again")

    scene, kept = reconstructed
    monkeypatch.setenv("GSX_CACHE", str(kept))
    monkeypatch.setattr(sfm, "reconstruct", refuse)
    again = load(options(capture[0] / "images", num_threads=2, downscale=2))  # options that decide nothing
    assert torch.equal(again.points.positions, scene.points.positions)
    with pytest.raises(AssertionError, match="computed again"):
        load(options(capture[0], max_features=4095))


LENS = {"Make": "Maker", "Model": "Phone"}
SHOTS = ("webp", 6, "turned", 3, 5)
"""How the photos of the capture are stored anew: as lossless WebP, as PNG with an EXIF orientation, 5 mirrored, or as a
portrait that a tool has turned."""


def store(picture: Tensor, path: Path, kind: str | int) -> None:
    """Write the picture of a sensor."""
    if kind in AFTER_MIRROR:
        picture = picture.flip(-1)
    picture = oriented(picture, 6) if kind == "turned" else picture
    orientation = {"Orientation": kind} if isinstance(kind, int) else {}
    write = write_webp_with_exif if kind == "webp" else write_pixels
    write(path, picture.permute(1, 2, 0).numpy(), LENS | orientation)


def test_photos_held_and_stored_in_any_way_give_one_camera_and_upright_views(
    reconstructed: tuple[Scene, Path], capture: tuple[Path, Any], tmp_path: Path, cache: Path
) -> None:
    """Of the same seed the same bytes: COLMAP gets the sensor's pictures, whatever file they come in."""
    folder, (expected, kept) = capture[0] / "images", reconstructed
    kinds = dict(zip(sorted(capture[1]), SHOTS, strict=True)) | {STRANGER: 1}
    for name, kind in kinds.items():
        store(read_image(folder / name), tmp_path / (f"{Path(name).stem}.webp" if kind == "webp" else name), kind)
    scene = load(options(tmp_path, num_threads=2))
    ((model,), (first,)) = ((place / "sfm").iterdir() for place in (cache, kept))  # neither copies nor links stay
    assert len(pycolmap.Reconstruction(model).cameras) == 1
    for file in model.glob("*.bin"):
        assert file.read_bytes().replace(b".webp\0", b".png\0") == (first / file.name).read_bytes(), file.name
    assert "EXIF turns 3 of 5 photos upright (scene.orientation)." in scene.notes
    assert "1 photos that a tool has turned share the camera of the others of their lens." in scene.notes
    assert scene.provenance["turned"] == 4
    before = {view.name: view for view in (*expected.train, *expected.test)}
    for view in (*scene.train, *scene.test):
        name = view.name.replace(".webp", ".png")
        turn = {"webp": 1, "turned": 6, 5: AFTER_MIRROR[5]}.get(kinds[name], kinds[name])
        assert view.camera.draws_as(oriented_camera(before[name].camera, turn))
        difference = (view.image().int() - oriented(before[name].image(), turn).int()).abs()
        assert difference.max() <= 1  # the lens of all is one: undistorted on the sensor's raster, then turned


def test_photos_without_texture_are_refused_with_the_remedy(tmp_path: Path, cache: Path) -> None:
    for number in range(3):
        write_image(tmp_path / f"{number}.png", torch.full((3, 64, 64), 0.5))
    refused(r"None of the 3 photos.*overlap.*max_feature_size", load, options(tmp_path))
    assert not list((cache / "sfm").iterdir())


@pytest.mark.slow
def test_fifty_real_photos() -> None:
    if not (CAPTURES / "fox").is_dir():
        pytest.skip("the capture fox is not here")
    scene = load(options(CAPTURES / "fox" / "images", num_threads=0))
    assert len(scene.train) + len(scene.test) >= 45
    assert len(scene.points) > 8000


# finding photos


def test_photos_are_found_in_the_folder_its_images_or_below(tmp_path: Path) -> None:
    inner = ("nested/images/c.jpeg", "nested/images/d.tif", "deep/l/1.png", "deep/r/1.png")
    for name in ("direct/b.JPG", "direct/a.png", *inner):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert find_photos(tmp_path / "direct") == (tmp_path / "direct", ["a.png", "b.JPG"])
    assert find_photos(tmp_path / "nested") == (tmp_path / "nested" / "images", ["c.jpeg", "d.tif"])
    assert find_photos(tmp_path / "deep") == (tmp_path / "deep", ["l/1.png", "r/1.png"])


def test_hidden_files_are_no_photos(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg", "._a.jpg"):  # the last kind is what macOS leaves on foreign disks
        (tmp_path / name).touch()
    assert find_photos(tmp_path)[1] == ["a.jpg", "b.jpg"]
    for place in ("cam", ".thumbs", "cam/@eaDir/a.jpg", "__MACOSX"):
        (tmp_path / "deep" / place).mkdir(parents=True)
        for name in ("a.jpg", "b.jpg"):
            (tmp_path / "deep" / place / name).touch()
    assert find_photos(tmp_path / "deep")[1] == ["cam/a.jpg", "cam/b.jpg"]


def test_unused_photos_are_reported(tmp_path: Path) -> None:
    for place in ("", "images", "masks"):
        (tmp_path / place).mkdir(exist_ok=True)
        for name in ("a.jpg", "b.jpg"):
            (tmp_path / place / name).touch()
    (note,) = photos.unused_folder(tmp_path, find_photos(tmp_path)[0])
    assert note == (
        f"2 photos in images are not used, as there are some in {tmp_path}: set scene.path to the folder to use."
    )
    (tmp_path / "a.jpg").unlink()
    (tmp_path / "b.jpg").unlink()
    assert photos.unused_folder(tmp_path, find_photos(tmp_path)[0]) == []


def test_photos_share_a_camera_by_size_and_by_lens(tmp_path: Path) -> None:
    """As a phone's lenses, which take pictures of one size."""
    exif = {
        "wide": 24.0,
        "wide2": 24.0,
        "long": 48.0,
        "plain": None,
        "none": math.nan,
        "none2": math.nan,
        "small": 24.0,
    }
    for name, focal in exif.items():
        height, width = (30, 40) if name == "small" else (60, 80)
        spec = oiio.ImageSpec(width, height, 3, "uint8")
        if focal is not None and math.isnan(focal):  # as 0/0 is read
            spec.attribute("Exif:FocalLength", math.nan)
        elif focal:
            spec.attribute("Make", "Maker")
            spec.attribute("Model", "Phone")
            spec.attribute("Exif:FocalLengthIn35mmFilm", int(focal))
        output = oiio.ImageOutput.create("a.jpg")
        assert output.open(str(tmp_path / f"{name}.jpg"), spec)
        output.write_image(np.zeros((height, width, 3), np.uint8))
        output.close()
    sizes = {f"{name}.jpg": image_size(tmp_path / f"{name}.jpg") for name in exif}
    for mode, groups in (
        ("auto", [["small.jpg"], ["plain.jpg", "none.jpg", "none2.jpg"], ["wide.jpg", "wide2.jpg"], ["long.jpg"]]),
        ("per_image", [[name] for name in sorted(sizes)]),
    ):
        database = tmp_path / f"{mode}.db"
        sfm.import_photos(database, tmp_path, sizes, options(tmp_path, camera_mode=mode))
        with pycolmap.Database.open(database) as opened:
            cameras = {image.name: image.camera_id for image in opened.read_all_images()}
        assert len(set(cameras.values())) == len(groups)
        assert all(len({cameras[name] for name in group}) == 1 for group in groups)
    with pytest.raises(InputError, match=r"sizes, 40x30 \(small.jpg\), 80x60 \(long.jpg\): use scene.camera_mode=auto"):
        sfm.import_photos(tmp_path / "one.db", tmp_path, sizes, options(tmp_path, camera_mode="single"))


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([], "0 photos .*add photos"),
        (["a.heic", "b.heic"], r"0 photos.*\.heic.*JPEG"),
        (["a.jpg"], r"1 photo \(.*at least 2: add photos, 30 to 200 of a scene\.$"),
        (["a.jpg", "b.psd"], r"add photos, 30 to 200 of a scene, or convert others to JPEG \(found: \.psd\)\.$"),
    ],
)
def test_too_few_photos_are_refused_with_what_was_found(tmp_path: Path, names: list[str], said: str) -> None:
    for name in names:
        (tmp_path / name).touch()
    refused(said, load, options(tmp_path))


def test_missing_folder_is_named(tmp_path: Path) -> None:
    refused("nowhere", load, options(tmp_path / "nowhere"))


def test_photos_that_cannot_be_read_are_skipped_and_named(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_image(tmp_path / name, torch.zeros(3, 8, 9))
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    sizes, notes = photos.readable_sizes(tmp_path, find_photos(tmp_path)[1])
    assert sizes == {"a.png": (9, 8), "b.png": (9, 8)}
    assert notes == ["Skipped 1 photos that cannot be read: broken.jpg."]
    (tmp_path / "b.png").write_bytes(b"")
    refused("Only 1 of the 3 photos", load, options(tmp_path))


@pytest.mark.parametrize("behind", [b"", b"\xff\xda of a film \xff\xd9 \xff\xda"])
def test_a_photo_that_is_cut_is_none(behind: bytes, tmp_path: Path) -> None:
    """Its head can be read, and COLMAP takes what there is of it. Behind a whole one may lie anything."""
    noise = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    for name in ("a", "b", "cut"):
        output = oiio.ImageOutput.create("a.jpg")
        assert output.open(str(tmp_path / f"{name}.jpg"), oiio.ImageSpec(96, 64, 3, "uint8"))
        output.write_image(noise)
        output.close()
    whole = (tmp_path / "cut.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(whole + behind)
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) * 2 // 3])
    sizes, notes = photos.readable_sizes(tmp_path, find_photos(tmp_path)[1])
    assert list(sizes) == ["a.jpg", "b.jpg"]
    assert notes == ["Skipped 1 photos that cannot be read: cut.jpg."]


def test_too_many_photos_that_cannot_be_read_are_refused_before_anything_is_reconstructed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sfm, "reconstruct", None)
    two_photos(tmp_path)
    (tmp_path / "c.jpg").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"1 of the 3 images .* cannot be read \(c\.jpg\): export.*missing=0\.34 or"):
        load(options(tmp_path, missing=0.33))
    with pytest.raises(TypeError):  # where it is reconstructed
        load(options(tmp_path, missing=0.34))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"matcher": "exhaustiv"}, r"scene\.matcher.*Did you mean 'exhaustive'"),
        ({"camera_mode": "singel"}, "Did you mean 'single'"),
        ({"camera_model": "SIMPLE_RADAL"}, "Did you mean 'SIMPLE_RADIAL'"),
        ({"camera_model": "EQUIRECTANGULAR"}, "use one of"),
    ],
)
def test_unknown_words_are_refused_before_anything_is_read(tmp_path: Path, change: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load(options(tmp_path, **change))


# the cache


def two_photos(folder: Path) -> dict[str, tuple[int, int]]:
    for name in ("a.png", "b.png"):
        write_image(folder / name, torch.zeros(3, 8, 9))
    return {"a.png": (9, 8), "b.png": (9, 8)}


def test_interrupted_reconstruction_leaves_nothing_behind(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(folder: Path, sizes: Any, chosen: Any, work: Path) -> None:
        (work / "model").mkdir()
        (work / "model" / "cameras.bin").write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(sfm, "reconstruct", stop)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(tmp_path, two_photos(tmp_path), options(tmp_path))
    assert not list((cache / "sfm").iterdir())


class StubModel:
    """What `sfm.reconstruct` returns, reduced to what is asked of it."""

    def num_reg_images(self) -> int:
        return 2

    def write_binary(self, folder: Path) -> None:
        (folder / "cameras.bin").write_bytes(b"mine")


def test_another_process_that_finishes_first_wins(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def overtaken(folder: Path, sizes: Any, chosen: Any, work: Path) -> StubModel:
        final = work.parent / work.name.split(".")[1]
        final.mkdir()
        (final / "cameras.bin").write_bytes(b"theirs")
        add_to_manifest(final / "cameras.bin")
        return StubModel()

    monkeypatch.setattr(sfm, "reconstruct", overtaken)
    final = reconstruct(tmp_path, two_photos(tmp_path), options(tmp_path))
    assert (final / "cameras.bin").read_bytes() == b"theirs"
    assert list((cache / "sfm").iterdir()) == [final]


def test_a_damaged_reconstruction_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sfm, "reconstruct", lambda *_: StubModel())
    sizes = two_photos(tmp_path)
    final = reconstruct(tmp_path, sizes, options(tmp_path))
    for damage in (b"", b"theirs"):
        (final / "cameras.bin").write_bytes(damage)
        assert (reconstruct(tmp_path, sizes, options(tmp_path)) / "cameras.bin").read_bytes() == b"mine"
    (final / "cameras.bin").unlink()
    assert (reconstruct(tmp_path, sizes, options(tmp_path)) / "cameras.bin").is_file()


def test_a_replaced_photo_is_reconstructed_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sfm, "reconstruct", lambda *_: StubModel())
    sizes = two_photos(tmp_path)
    before = reconstruct(tmp_path, sizes, options(tmp_path))
    assert (before / "cameras.bin").read_bytes() == b"mine"
    assert reconstruct(tmp_path, sizes, options(tmp_path)) == before
    os.utime(tmp_path / "b.png", ns=(0, 0))
    assert reconstruct(tmp_path, sizes, options(tmp_path)) != before


# the stages


def test_portraits_that_a_tool_turned_join_the_landscapes_of_their_lens(tmp_path: Path) -> None:
    """By their lens and focal length; the raster of a file whose EXIF states an orientation is the sensor's already."""
    noted = {"wide": LENS, "tall": LENS, "other": LENS | {"Model": "Camera"}, "unknown": {}, "held": LENS}
    for name, attributes in noted.items():
        pixels = np.zeros((30, 40, 3) if name == "wide" else (40, 30, 3), np.uint8)
        write_pixels(tmp_path / f"{name}.png", pixels, attributes | ({"Orientation": 6} if name == "held" else {}))
    sizes = {f"{name}.png": image_size(tmp_path / f"{name}.png") for name in noted}
    assert photos.turned_already(tmp_path, sizes, "auto") == {"tall.png": 8}
    assert photos.turned_already(tmp_path, sizes, "single") == dict.fromkeys(
        ("tall.png", "other.png", "unknown.png"), 8
    )
    assert photos.turned_already(tmp_path, sizes, "per_image") == {}
    alone = {name: size for name, size in sizes.items() if name != "wide.png"}
    assert photos.turned_already(tmp_path, alone, "auto") == {}


@pytest.mark.parametrize("count", [2, 3, 9])
@pytest.mark.parametrize("kind", ["exhaustive", "sequential", "near"])
def test_pairs_are_counted_as_colmap_makes_them(tmp_path: Path, count: int, kind: str) -> None:
    chosen = options(tmp_path, overlap=3, near=4)
    sizes = {f"{number}.png": (8, 8) for number in range(count)}
    for name in sizes:
        write_image(tmp_path / name, torch.zeros(3, 8, 8))
    sfm.import_photos(tmp_path / "database.db", tmp_path, sizes, options(tmp_path))
    every = kind == "exhaustive"
    generator = pycolmap.ExhaustivePairGenerator if every else pycolmap.SequentialPairGenerator
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        pairs = generator(sfm.pairing_options(kind, chosen), database).all_pairs()
    assert sfm.pair_count(kind, count, chosen) == len({tuple(sorted(pair)) for pair in pairs})


def test_auto_gives_up_on_every_pair_beyond_the_limit(tmp_path: Path) -> None:
    chosen = options(tmp_path, exhaustive_limit=20)
    assert [sfm.chosen_matcher(count, chosen) for count in (20, 21)] == ["exhaustive", "retrieval"]
    assert sfm.chosen_matcher(21, options(tmp_path, matcher="exhaustive")) == "exhaustive"
    assert sfm.pair_count("similar", 5, options(tmp_path, similar=3)) == 10  # there are no more
    assert sfm.pair_count("similar", 9, options(tmp_path, similar=3)) == 27


def test_options_without_effect_change_no_kept_reconstruction(tmp_path: Path) -> None:
    """Keys of reconstructions that were made before there was retrieval."""
    older = {
        "matcher", "exhaustive_limit", "overlap", "max_feature_size", "max_features", "camera_mode", "camera_model",
        "mapping_threads", "seed",
    }  # fmt: skip
    assert photos.settings(options(tmp_path), 100).keys() == older
    assert photos.settings(options(tmp_path), 101).keys() == older - {"overlap"} | {"similar", "near", "retry_pairs"}
    assert photos.settings(options(tmp_path, matcher="sequential"), 9).keys() == older | {"retry_pairs"}


def test_lost_photos_are_named_with_their_share_and_a_remedy_that_is_left() -> None:
    note = photos.lost_photos(["a.jpg", "c d.jpg"], 8, "retrieval")
    assert note.startswith("2 of 8 photos (25%) could not be placed and are not used: a.jpg, c d.jpg. ")
    assert "scene.matcher=exhaustive" in note
    assert "scene.matcher" not in photos.lost_photos(["a.jpg"], 8, "exhaustive")


def test_progress_is_logged_with_stage_count_and_time(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sfm, "LOG_SECONDS", 0.01)
    with caplog.at_level(logging.INFO):
        logged = threading.Event()  # the stage ends once its progress has been logged

        def work(cancellation_token: Any) -> int:
            return logged.wait(60) and 42

        assert sfm.run_stage("matches of pairs", work, lambda: logged.set() or 7, 9) == 42
    assert any(line.startswith("sfm: matches of pairs 7/9, ") for line in caplog.messages)
    assert caplog.messages[-1].startswith("sfm: matches of pairs done")


def test_interruption_cancels_the_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sfm, "LOG_SECONDS", 0.01)
    cancelled: list[bool] = []

    def work(cancellation_token: Any) -> None:
        until = time.monotonic() + 10
        while not cancellation_token.is_cancelled and time.monotonic() < until:
            time.sleep(0.01)
        cancelled.append(cancellation_token.is_cancelled)

    def interrupt() -> int:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sfm.run_stage("features", work, interrupt, 1)
    assert cancelled == [True]


def test_error_of_a_stage_comes_through() -> None:
    def fail(cancellation_token: Any) -> None:
        raise ValueError("no such thing")

    with pytest.raises(ValueError, match="no such thing"):
        sfm.run_stage("features", fail, lambda: 0, 1)
