"""gsx judge with folders and lists that newcomers give: wrong ones end in a sentence, and leave nothing behind."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from judging import Subject, judged, made_subject, write_method

from gsx.cli.dispatch import main
from gsx.core.data.images import read_image, write_image
from gsx.experiments.judge.picture_files import read_header


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return made_subject(tmp_path_factory.mktemp("refused") / "scene")


@pytest.fixture(scope="module")
def pictures(subject: Subject, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_method(subject, tmp_path_factory.mktemp("pictures") / "noisy")


def stems(subject: Subject) -> list[str]:
    return [Path(view.name).stem for view in subject.scene.test]


def numbered(pictures: Path, folder: Path, names: list[str]) -> Path:
    """Copies x1 pictures under numbers, in the order of names of views."""
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        shutil.copy(pictures / "x1" / f"{name}.png", folder / f"{number:05d}.png")
    return folder


def exact_psnr(subject: Subject, folder: Path, names: list[str]) -> float:
    """Mean PSNR in float64 of the pictures of views, named in the order of test views."""
    levels = []
    for name, (_, truth) in zip(names, subject.truths(1), strict=True):
        difference = (read_image(folder / f"{name}.png").double() - truth.double()) / 255
        levels.append(float(-10 * np.log10(float(difference.square().mean()))))
    return float(np.mean(levels))


def psnr(content: dict) -> float:
    return float(content["results"][0]["methods"][0]["zoom"]["1"]["psnr"])


def refusal(tmp_path: Path, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Returns what a command says that fails and writes nothing."""
    before = sorted(tmp_path.iterdir())
    assert main(["judge", *words, "--to", str(tmp_path / "out")]) == 2
    assert sorted(tmp_path.iterdir()) == before
    return capsys.readouterr().err


# -- lists of views ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ([0, 0, 1], "twice"),
        ([0, 1, 2, 0, 1, 2], "twice"),
        ([0], "1 test views in --order"),
        ([], "0 test views in --order"),
    ],
)
def test_lists_that_do_not_fit_are_refused(
    lines: list[int], sentence: str, subject: Subject, pictures: Path, tmp_path: Path, capsys
) -> None:
    names = stems(subject)
    folder = numbered(pictures, tmp_path / "numbered", names)
    (tmp_path / "order.txt").write_text("\n".join(names[line] for line in lines))
    error = refusal(tmp_path, capsys, f"a={folder}", *subject.words, "--order", str(tmp_path / "order.txt"))
    assert sentence in error


def test_a_list_that_is_no_text_is_refused(subject: Subject, pictures: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "order.txt").write_bytes(b"\xff\xfe\x00\x80")
    for path in (tmp_path / "order.txt", subject.folder):
        error = refusal(tmp_path, capsys, f"a={pictures}", *subject.words, "--order", str(path))
        assert "one name a line" in error
        assert "writable" not in error


def test_a_foreign_file_near_pictures_is_left_out(subject: Subject, pictures: Path, tmp_path: Path, capsys) -> None:
    folder = numbered(pictures, tmp_path / "numbered", stems(subject))
    expected = exact_psnr(subject, pictures / "x1", stems(subject))
    for number, content in enumerate((b"{", b'{"cameras": 3}', b"\xff\xfe")):
        (folder / "cameras.json").write_bytes(content)
        (folder / "test_views.txt").write_bytes(b"\xff\xfe")
        found = judged(tmp_path / f"out{number}", f"a={folder}", *subject.words)
        assert psnr(found) == pytest.approx(expected, abs=1e-4)
        assert "is left out" in capsys.readouterr().err


def test_a_short_list_near_pictures_is_named(subject: Subject, pictures: Path, tmp_path: Path, capsys) -> None:
    folder = numbered(pictures, tmp_path / "numbered", stems(subject))
    (folder / "test_views.txt").write_text("\n".join(stems(subject)[:2]))
    error = refusal(tmp_path, capsys, f"a={folder}", *subject.words)
    assert f"2 test views in '{folder / 'test_views.txt'}'" in error


# -- names -------------------------------------------------------------------------------------------------------------


def test_names_of_views_count_below_renders(subject: Subject, pictures: Path, tmp_path: Path, capsys) -> None:
    """A folder called renders may hold pictures by the names of views; a list above must not reorder them."""
    names = stems(subject)
    shutil.copytree(pictures / "x1", tmp_path / "model" / "renders")
    (tmp_path / "model" / "test_views.txt").write_text("\n".join(reversed(names)))
    found = judged(tmp_path / "out", f"a={tmp_path / 'model'}", *subject.words)
    assert psnr(found) == pytest.approx(exact_psnr(subject, pictures / "x1", names), abs=1e-4)
    (tmp_path / "model" / "renders" / f"{names[0]}.png").unlink()
    shutil.rmtree(tmp_path / "out")
    assert f"no picture of test view '{names[0]}" in refusal(
        tmp_path, capsys, f"a={tmp_path / 'model'}", *subject.words
    )


def test_prefixes_come_before_numbers(subject: Subject, pictures: Path, tmp_path: Path) -> None:
    """left_2, left_10, right_1: by the prefix, then by the number."""
    names = stems(subject)
    (tmp_path / "sides").mkdir()
    for name, side in zip(names, ("left_2", "left_10", "right_1"), strict=True):
        shutil.copy(pictures / "x1" / f"{name}.png", tmp_path / "sides" / f"{side}.png")
    found = judged(tmp_path / "out", f"a={tmp_path / 'sides'}", *subject.words)
    assert psnr(found) == pytest.approx(exact_psnr(subject, pictures / "x1", names), abs=1e-4)


def test_an_order_counts_where_numbers_are_names_by_chance(subject: Subject, pictures: Path, tmp_path: Path) -> None:
    names = stems(subject)
    folder = tmp_path / "numbered"
    folder.mkdir()
    for number, name in zip((0, 5, 7), names, strict=True):  # the first is called as a view, the others are not
        shutil.copy(pictures / "x1" / f"{name}.png", folder / f"{names[0][:-6]}{number:06d}.png")
    (tmp_path / "order.txt").write_text("\n".join(names))
    found = judged(tmp_path / "out", f"a={folder}", *subject.words, "--order", str(tmp_path / "order.txt"))
    assert psnr(found) == pytest.approx(exact_psnr(subject, pictures / "x1", names), abs=1e-4)


def test_hidden_folders_do_not_count(subject: Subject, pictures: Path, tmp_path: Path) -> None:
    shutil.copytree(pictures / "x1", tmp_path / "model" / "side")
    shutil.copytree(pictures / "x1", tmp_path / "model" / ".ipynb_checkpoints")
    assert psnr(judged(tmp_path / "out", f"a={tmp_path / 'model'}", *subject.words)) > 0


def test_pictures_of_one_name_are_told_apart_by_their_folders(
    subject: Subject, pictures: Path, tmp_path: Path, capsys
) -> None:
    for side in ("near", "far"):
        shutil.copytree(pictures / "x1", tmp_path / "model" / side)
    error = refusal(tmp_path, capsys, f"a={tmp_path / 'model'}", *subject.words)
    assert f"far/{stems(subject)[0]}.png and near/" in error


# -- options -----------------------------------------------------------------------------------------------------------


def test_zooms_without_pictures_are_refused(subject: Subject, pictures: Path, tmp_path: Path, capsys) -> None:
    assert "no method has a picture at x16" in refusal(
        tmp_path, capsys, f"a={pictures}", *subject.words, "eval.zoom=[16]"
    )


def test_depth_needs_a_model(subject: Subject, pictures: Path, tmp_path: Path, capsys) -> None:
    for path in (pictures, pictures / "x1" / f"{stems(subject)[0]}.png"):
        error = refusal(tmp_path, capsys, f"a={pictures}", *subject.words, "--depth", str(path))
        assert "neither a run folder nor a splat file" in error


def test_a_protocol_that_is_repeated_counts_once(subject: Subject, pictures: Path, tmp_path: Path) -> None:
    found = judged(tmp_path / "out", f"a={pictures}", *subject.words, "--protocols", "inria,inria")
    assert [result["protocol_name"] for result in found["results"]] == ["inria"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--protocols", ","], "--protocols ',' names no protocol"),
        (["b=renders/{scne}"], "in braces only {scene} has a meaning"),
    ],
)
def test_slips_of_the_command_line(
    words: list[str], sentence: str, subject: Subject, pictures: Path, tmp_path: Path, capsys
) -> None:
    assert sentence in refusal(tmp_path, capsys, f"a={pictures}", *subject.words, *words)


def test_photos_in_place_of_renders_are_noticed(subject: Subject, tmp_path: Path) -> None:
    photos = write_method(subject, tmp_path / "photos", strength=0)
    found = judged(tmp_path / "out", f"a={photos}", *subject.words)
    assert "these are the photos themselves: all pixels are equal" in found["results"][0]["methods"][0]["notes"]


def test_a_turned_picture_is_remarked(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg", torch.zeros(3, 4, 6), {"Orientation": 6})
    assert "turned by EXIF, which is not applied" in read_header(tmp_path / "a.jpg").remarks
