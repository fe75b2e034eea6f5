"""gsx FOLDER: what it is taken for, and what it says of what it cannot train from."""

import logging
import shlex
import struct
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import torch
from synthetic_colmap import synthesize, write_photos, write_scene

from gsx.builtin import plugins
from gsx.cli import train as folders
from gsx.cli.dispatch import main
from gsx.cli.train import train
from gsx.core.data.images import write_image
from gsx.core.errors import InputError
from gsx.experiments.runs import video
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.orbit import write_animation
from gsx.experiments.runs.overrides import is_override
from gsx.experiments.runs.video import photos_of, sharpest, sharpness
from gsx.scenes.photos import find_photos


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Words of what would be trained."""
    given: list[list[str]] = []
    monkeypatch.setattr(folders, "train", lambda words, of_folder: given.append(words) or 0)
    return given


def test_a_colmap_folder_and_photos_are_told_apart(
    tmp_path: Path, trained: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(synthesize(), tmp_path / "it's a=model")
    write_photos(synthesize(), tmp_path / "photos")
    assert main([str(tmp_path / "it's a=model"), "iterations=7"]) == 0
    assert main([str(tmp_path / "photos")]) == 0
    model, photos = (compose(words, plugins()) for words in trained)
    assert model.scene.component.name == "colmap"
    assert Path(model.scene.options.path) == tmp_path / "it's a=model"
    assert model.general.iterations == 7
    assert photos.scene.component.name == "photos"
    told = [shlex.split(line) for line in capsys.readouterr().err.splitlines() if line.startswith("gsx scene=")]
    assert told == [["gsx", *words] for words in trained], "it can be pasted"


def test_the_settings_of_a_folder_can_be_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photos(synthesize(), tmp_path / "photos")
    assert main([str(tmp_path / "photos"), "--cfg", "job", "device=cpu"]) == 0
    out = capsys.readouterr().out
    assert f"path: {tmp_path / 'photos'}\n" in out
    assert "minutes: 10\n" in out


def test_a_run_without_the_default_minutes_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_photos(synthesize(), tmp_path / "photos")
    monkeypatch.setattr("gsx.experiments.runs.job.train", lambda settings, loaded, runs: runs.append(tmp_path) or 130)
    main([str(tmp_path / "photos"), "preset=zoom_prior", "device=cpu"])
    assert "no minutes=10 because of preset=zoom_prior: 30,000 steps\n" in capsys.readouterr().err


def test_pictures_of_a_sog_are_no_photos(
    tmp_path: Path, trained: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("means_l", "means_u", "quats", "scales", "sh0"):
        write_image(tmp_path / f"{name}.png", torch.rand(3, 8, 8))
        (tmp_path / f"{name}.png").rename(tmp_path / f"{name}.webp")
    assert main([str(tmp_path)]) == 2
    assert "pictures of a SOG (means_l.webp) but no meta.json" in capsys.readouterr().err
    (tmp_path / "meta.json").write_text('{"version": 2, "means": {}, "scales": {}, "quats": {}, "sh0": {}}')
    assert main([str(tmp_path)]) == 2
    assert (
        f"{tmp_path} is an unbundled SOG, whose pictures hold splats (meta.json), not a scene"
        in capsys.readouterr().err
    )
    assert main(["scenes", str(tmp_path)]) == 2
    assert "is an unbundled SOG" in capsys.readouterr().out
    with pytest.raises(InputError, match="is an unbundled SOG"):
        find_photos(tmp_path)
    assert not trained


def test_a_path_that_exists_is_no_override(
    tmp_path: Path, trained: list[list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(synthesize(), tmp_path / "in" / "a=b")
    write_scene(synthesize(), tmp_path / "c=d, e (1)")
    monkeypatch.chdir(tmp_path)
    assert is_override("in/a=c")
    for name in ("in/a=b", "c=d, e (1)"):
        assert not is_override(name)
        assert main([name, "iterations=3"]) == 0
        for words in (trained[-1], ["scene=colmap", f"scene.path={name}"]):
            assert Path(compose(words, plugins()).scene.options.path).resolve() == tmp_path / name
        assert main(["scenes", name]) == 0
    monkeypatch.setattr(folders, "train", train)
    assert main(["--cfg", "job", "scene=colmap", "scene.path=in/a=b"]) == 0
    assert "path: in/a=b" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("empty", "is not a scene"),
        ("run", "is a run, not a scene. Use it with gsx view"),
        ("a.ply", "is a splat file, not a scene. Use it with gsx view"),
        ("notes.txt", "is not a folder"),
    ],
)
def test_what_is_no_scene_is_told_with_a_remedy(
    tmp_path: Path, trained: list[list[str]], capsys: pytest.CaptureFixture[str], name: str, words: str
) -> None:
    for folder in ("empty", "run"):
        (tmp_path / folder).mkdir()
    for file in ("config.yaml", "metrics.jsonl"):
        (tmp_path / "run" / file).write_text("")
    for file in ("a.ply", "notes.txt"):
        (tmp_path / file).write_text("")
    assert main([str(tmp_path / name)]) == 2
    assert words in capsys.readouterr().err
    assert trained == []


def test_a_scene_beside_it_makes_no_sense(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), "scene=demo"]) == 2
    assert "'scene=demo' does not go with the folder" in capsys.readouterr().err
    assert main([str(tmp_path / "none")]) == 2
    assert "No such file or folder" in capsys.readouterr().err


def test_sharpness_by_hand() -> None:
    """A single bright pixel: the Laplacian is -4 there, 1 at four neighbours, 0 at the twenty others of 25."""
    grey = np.zeros((7, 7), np.float32)
    grey[3, 3] = 1
    values = np.array([-4, 1, 1, 1, 1] + [0] * 20)
    assert sharpness(grey) == pytest.approx(values.var())
    assert sharpness(np.full((7, 7), 9, np.float32)) == 0


def test_who_asks_for_the_frames_of_a_video_meanwhile_waits_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They were deleted under whoever was choosing them."""
    half = Event()

    def slowly(path: Path, total: int, stretches: int) -> Iterator[tuple[int, np.ndarray]]:
        chosen.append(path)
        for number in range(stretches):
            if number == stretches // 2:
                half.set()
                time.sleep(0.3)
            yield number, np.zeros((2, 2, 3), np.uint8)

    chosen: list[Path] = []
    (tmp_path / "a.mp4").write_bytes(b"")
    instead_of = {"require": lambda *given: None, "frames_in": lambda path: range(40), "sharpest": slowly}
    for name, instead in instead_of.items():
        monkeypatch.setattr(video, name, instead)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(photos_of, tmp_path / "a.mp4", tmp_path, 12)
        assert half.wait(20)
        second = pool.submit(photos_of, tmp_path / "a.mp4", tmp_path, 12)
        found = [len(list(one.result(20).glob("frame_*.png"))) for one in (first, second)]
    assert (found, len(chosen)) == ([12, 12], 1)


def turned_film(film: Path, turned: Path) -> Path:
    """The film as of a phone held upright: its track's matrix (ISO 14496-12) turns it by 90 degrees clockwise."""
    content = bytearray(film.read_bytes())
    start = content.index(b"tkhd") + 44
    one, width = 1 << 16, 64 << 16
    content[start : start + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, width, 0, 1 << 30)
    turned.write_bytes(content)
    return turned


@pytest.mark.skipif(find_spec("av") is None, reason="PyAV is not installed")
def test_of_each_stretch_of_a_video_the_sharpest_frame_is_taken(
    tmp_path: Path, trained: list[list[str]], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    sharp_ones = {3, 14, 21, 39}
    g = torch.Generator().manual_seed(0)
    noise = torch.rand(3, 64, 96, generator=g)

    def frames():
        for number in range(40):
            shown = noise.roll(number, 2)
            blurred = torch.nn.functional.avg_pool2d(shown[None], 9, 1, 4)[0]
            yield shown if number in sharp_ones else blurred

    film = tmp_path / "a video.mp4"
    write_animation(film, frames(), 20)
    assert {number for number, _ in sharpest(film, 40, 4)} == sharp_ones
    monkeypatch.chdir(tmp_path)
    assert main([str(film)]) == 0
    settings = compose(trained[0], plugins())
    assert settings.scene.component.name == "photos"
    made = sorted(path.name for path in Path(settings.scene.options.path).glob("*.png"))
    first = photos_of(film, tmp_path / "outputs", 4)
    assert sorted(path.name for path in first.glob("*.png")) == [f"frame_{n:05d}.png" for n in sorted(sharp_ones)]
    assert made
    monkeypatch.setattr(logging.getLogger("gsx"), "propagate", True)
    caplog.set_level(logging.INFO, logger="gsx")
    assert photos_of(film, tmp_path / "outputs", 4) == first
    assert "chosen earlier" in caplog.text
    side = turned_film(film, tmp_path / "turned.mp4")
    ((_, pixels),) = sharpest(side, 40, 1)
    assert pixels.shape == (96, 64, 3)
    assert np.array_equal(pixels, np.rot90(next(sharpest(film, 40, 1))[1], -1))
    assert photos_of(side, tmp_path / "outputs", 4) != first
    (tmp_path / "broken.mp4").write_bytes(b"no video at all" * 50)
    with pytest.raises(InputError, match="cannot be read as a video"):
        photos_of(tmp_path / "broken.mp4", tmp_path / "outputs")
