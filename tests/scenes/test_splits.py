"""Splits against lists worked out by hand from the published rule."""

from pathlib import Path

import pytest
import torch
from refusals import refused
from torch.nn import functional

from gsx.core.data.images import write_image
from gsx.core.errors import ConfigError, InputError
from gsx.modules.motion_blur import motion_blurred
from gsx.scenes.splits import parse_rule, split_names

NAMES = [f"{i:02d}.jpg" for i in range(17)]


def test_every_eighth_of_the_sorted_names_is_test() -> None:
    shuffled = NAMES[5:] + NAMES[:5]
    train, test = split_names(shuffled, "every:8")
    assert [shuffled[i] for i in test] == ["00.jpg", "08.jpg", "16.jpg"]
    assert [shuffled[i] for i in train] == [n for n in NAMES if n not in ("00.jpg", "08.jpg", "16.jpg")]


def test_of_every_four_the_sharpest_is_test(tmp_path: Path) -> None:
    """Photographs of noise; 0, 5 and 9 are blurred along their rows, 2 and 7 have more fine contrast than others, 8 has
    a little less, and nothing is known of 10 and 11, of 32 px."""
    generator = torch.Generator().manual_seed(0)
    smooth = functional.interpolate(torch.rand(1, 3, 24, 24, generator=generator), scale_factor=4, mode="bilinear")[0]
    names, photographs = [f"{number:02d}.png" for number in range(12)], []
    for number, name in enumerate(names):
        fine = 0.3 * torch.rand(3, 96, 96, generator=generator) * {2: 1.5, 7: 1.5, 8: 0.8}.get(number, 1.0)
        picture = 255 * (0.6 * smooth + fine).clamp(0, 1)
        if number in (0, 5, 9):
            picture = motion_blurred(picture, 4.0, 0.0)
        photographs.append(tmp_path / name)
        write_image(photographs[-1], (picture[:, :32, :32] if number > 9 else picture).round().byte())
    train, test = split_names(names, "sharp:4", photographs=photographs)
    assert test == [2, 7, 8]
    assert sorted(train + test) == list(range(12))
    mixed = [5, 11, 0, 3, 8, 1, 10, 2, 9, 4, 7, 6]
    shuffled, theirs = [names[i] for i in mixed], [photographs[i] for i in mixed]
    train, test = split_names(shuffled, "sharp:4", photographs=theirs)
    assert [shuffled[i] for i in test] == ["02.png", "07.png", "08.png"]
    assert [shuffled[i] for i in train] == [name for i, name in enumerate(names) if i not in (2, 7, 8)]
    with pytest.raises(ConfigError, match=r"use every:4"):
        split_names(names, "sharp:4")


def test_sorting_is_by_base_name_without_suffix() -> None:
    # '-' sorts before '.', so whole file names would put a-1.png before a.png; folders do not count either
    names = ["x/b.png", "y/a.png", "z/a-1.png"]
    train, test = split_names(names, "every:2")
    assert [names[i] for i in test] == ["y/a.png", "x/b.png"]
    assert [names[i] for i in train] == ["z/a-1.png"]


def test_none_trains_on_everything() -> None:
    assert split_names(["b", "a"], "none") == ([1, 0], [])


def test_counts_spread_evenly_and_never_overlap() -> None:
    train, test = split_names(NAMES[:8], "counts:3,2")
    assert test == [2, 6]  # the middles of two parts of four
    assert train == [1, 4, 7]  # 0 1 3 4 5 7 in three parts of two
    train, test = split_names(NAMES, "counts:13,4")
    assert sorted(train + test) == list(range(17))


def test_files_name_images_with_or_without_suffix(tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_text("02\n00.jpg\n\n")
    (tmp_path / "test.txt").write_text("01.jpg\n")
    assert split_names(NAMES, "files:train.txt,test.txt", tmp_path) == ([0, 2], [1])
    absolute = f"files:{tmp_path / 'train.txt'}, {tmp_path / 'test.txt'}"
    assert split_names(NAMES, absolute) == ([0, 2], [1])


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be", "utf-32"])
def test_byte_order_marks_of_lists_are_passed_over(tmp_path: Path, encoding: str) -> None:
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    (tmp_path / "train.txt").write_bytes(f"{mark}00.jpg\r\n02.jpg\r\n".encode(encoding))
    (tmp_path / "test.txt").write_bytes(f"{mark}01.jpg".encode(encoding))
    assert split_names(NAMES, "files:train.txt,test.txt", tmp_path) == ([0, 2], [1])


def test_a_list_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_bytes("00.jpg\nf\u00fcr.jpg".encode("latin-1"))
    (tmp_path / "test.txt").write_text("01.jpg")
    with pytest.raises(InputError, match=r"train\.txt' is no UTF-8 text at byte 8: save it as UTF-8"):
        split_names(NAMES, "files:train.txt,test.txt", tmp_path)


def test_an_empty_list_to_test_on_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_text("00.jpg")
    (tmp_path / "test.txt").write_text("\n")
    with pytest.raises(InputError, match=r"1 training and 0 test images of 17.*scene\.split=none trains on all"):
        split_names(NAMES, "files:train.txt,test.txt", tmp_path)


def test_whole_names_win_over_stems(tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_text("a.jpg\n")
    (tmp_path / "test.txt").write_text("b\n")
    assert split_names(["a.jpg", "a.jpg.png", "b.png"], "files:train.txt,test.txt", tmp_path) == ([0], [2])


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        ("00\n", None, "does not exist"),
        ("00\n", "00.jpg\n", "'00.jpg' is listed in both"),
        ("00\n", "99.jpg\n", "'99.jpg' in .* is no image of the scene"),
        ("00\n", "\n", "1 training and 0 test images of 17"),
    ],
)
def test_unusable_split_files_are_refused(tmp_path: Path, train: str, test: str | None, message: str) -> None:
    (tmp_path / "train.txt").write_text(train)
    if test is not None:
        (tmp_path / "test.txt").write_text(test)
    refused(message, split_names, NAMES, "files:train.txt,test.txt", tmp_path)


def test_a_stem_that_fits_several_images_is_refused(tmp_path: Path) -> None:
    (tmp_path / "train.txt").write_text("a\n")
    (tmp_path / "test.txt").write_text("b\n")
    with pytest.raises(InputError, match=r"'a' in .* fits several images"):
        split_names(["a.jpg", "a.png", "b.png"], "files:train.txt,test.txt", tmp_path)


@pytest.mark.parametrize(
    "rule",
    [
        *("evry:8", "every", "every:0", "every:-1", "every:nan", "every:2.5", "none:1", "counts:5", "files:a,", ""),
        *(f"every:{'8' * 5000}", f"counts:{'8' * 5000},1", "8" * 5000),
    ],
)
def test_unreadable_rules_are_refused_in_a_sentence(rule: str) -> None:
    with pytest.raises(ConfigError, match=r"scene\.split is") as refusal:
        split_names(NAMES, rule)
    assert len(str(refusal.value)) < 500
    with pytest.raises(ConfigError, match=r"scene\.split is"):
        parse_rule(rule)


@pytest.mark.parametrize("rule", ["every:8", "none", "counts:1,2", "files:a.txt,b.txt"])
def test_readable_rules_pass_before_there_are_names(rule: str) -> None:
    parse_rule(rule)


def test_a_typo_gets_a_suggestion() -> None:
    with pytest.raises(ConfigError, match=r"Did you mean 'every:K'\?"):
        split_names(NAMES, "evry:8")


@pytest.mark.parametrize(("names", "rule"), [(NAMES, "every:1"), (NAMES[:1], "every:8"), ([], "none")])
def test_empty_splits_are_refused(names: list[str], rule: str) -> None:
    refused("at least one", split_names, names, rule)


def test_asking_for_more_images_than_there_are() -> None:
    refused(r"15 \+ 3 images and the scene has 17", split_names, NAMES, "counts:15,3")
