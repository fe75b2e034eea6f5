"""Choice of held-out images by their sorted names (3D-GS, camera_utils.py), or by sharpness.

Photographs under two names are refused: test photographs could be trained on.
"""

import codecs
import hashlib
import os
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path, PurePosixPath

from gsx.core.data.scene import View
from gsx.core.errors import ConfigError, InputError, nearest
from gsx.core.quality.sharpness import sharpness

RULES = ("every:K", "sharp:K", "none", "files:train.txt,test.txt", "counts:N_TRAIN,N_TEST")
DIGITS = 9  # of numbers of images
LETTERS = 200  # of a rule in an error
Split = tuple[list[int], list[int]]
"""Positions of the training and of the test names in the list, each in sorted order."""
MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32"}
MARKS |= {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
"""Encodings by byte order mark, longer marks first: that of UTF-32 begins with that of UTF-16."""
BLOCK = 1 << 16  # bytes at the beginning, middle and end that are compared before whole files
Sides = tuple[list[Path], list[Path]]  # photographs to train on, and to test on


def split_names(names: list[str], rule: str, folder: Path = Path(), photographs: Sequence[Path] = ()) -> Split:
    """Split `names` after sorting them; `photographs`: their files, in the same order, for `sharp`.

    `every:K`: of the sorted names, those at positions 0, K, 2K, ... are test, as published for K = 8.
    `sharp:K`: of every K of them the one that is sharpest compared with its neighbours is test.
    `none`: all are train.
    `counts:N,M`: M test names spread evenly over the sorted list, then N train names over the rest.
    `files:a,b`: train and test names one per line, with or without suffix; relative files lie in `folder`.

    Raises:
        ConfigError: the rule cannot be read, or needs photographs that are not there.
        InputError: a split file or a photograph is unusable, or the rule leaves no training or no test image.
    """
    kind, values = parse_rule(rule)
    order = sorted(range(len(names)), key=lambda i: sort_key(names[i]))
    train, test = order, list[int]()
    if kind == "every":
        train, test = [i for position, i in enumerate(order) if position % values[0]], order[:: values[0]]
    elif kind == "sharp":
        train, test = _sharp(order, photographs, values[0], rule)
    elif kind == "counts":
        train, test = _counts(order, *values)
    elif kind == "files":
        train, test = _files(names, *(folder / part for part in _pair(rule)))
    if not train or not (test or rule == "none"):
        raise InputError(
            f"scene.split '{rule}' makes {len(train)} training and {len(test)} test images of {len(names)}, both need "
            "at least one: add images or choose another rule; scene.split=none trains on all."
        )
    return train, test


def parse_rule(rule: str) -> tuple[str, list[int]]:
    """Return the kind of a rule and its numbers; ConfigError: it cannot be read."""
    kind, _, argument = rule.partition(":")
    if kind in ("every", "sharp"):
        return kind, [_count(argument, rule)]
    if kind == "counts":
        return kind, [_count(count, rule) for count in _pair(rule)]
    if kind == "files":
        _pair(rule)
    elif rule != "none":
        raise ConfigError(f"scene.split is '{short(rule)}', use one of {', '.join(RULES)}.{nearest(rule, RULES)}")
    return kind, []


def positive(text: str) -> int | None:
    """Return a whole number above 0 of up to `DIGITS` digits; None for anything else."""
    word = text.strip()
    return int(word) if word.isdecimal() and len(word) <= DIGITS and int(word) > 0 else None


def short(text: str) -> str:
    """Return the first `LETTERS` letters of a text."""
    return text if len(text) <= LETTERS else f"{text[:LETTERS]}..."


def sort_key(name: str) -> tuple[str, str]:
    """Return the key of published orders: base name up to its first dot, then the whole name."""
    return PurePosixPath(name).name.split(".")[0], name


def _sharp(order: list[int], photographs: Sequence[Path], k: int, rule: str) -> Split:
    """Hold out the sharpest of every `k`, the first of equals; photos without a measure come last."""
    if len(photographs) != len(order):
        raise ConfigError(f"scene.split is '{rule}', but some views share a photograph or have none: use every:{k}.")
    ratios = sharpness([photographs[i] for i in order])
    blocks = [order[first : first + k] for first in range(0, len(order), k)]
    test = [max(block, key=lambda i: ratios.get(photographs[i], 0.0)) for block in blocks]
    held_out = set(test)
    return [i for i in order if i not in held_out], test


def _counts(order: list[int], train_count: int, test_count: int) -> Split:
    """Spread test names evenly over the order, and training names over the rest."""
    if train_count + test_count > len(order):
        raise InputError(
            f"scene.split needs {train_count} + {test_count} images and the scene has {len(order)}: reduce the counts."
        )
    test = _spread(order, test_count)
    held_out = set(test)
    return _spread([i for i in order if i not in held_out], train_count), test


def _spread(order: list[int], count: int) -> list[int]:
    """Return `count` entries at even distances, from the middle of `count` equal parts."""
    return [order[(2 * k + 1) * len(order) // (2 * count)] for k in range(count)]


def _files(names: list[str], train_file: Path, test_file: Path) -> Split:
    train, test = _listed(names, train_file), _listed(names, test_file)
    both = set(train) & set(test)
    if both:
        raise InputError(
            f"'{names[min(both)]}' is listed in both '{train_file}' and '{test_file}', remove it from one."
        )
    return train, test


def _listed(names: list[str], file: Path) -> list[int]:
    """Return positions of the names that `file` lists, in sorted order."""
    if not file.is_file():
        raise InputError(f"The split file '{file}' does not exist, check scene.split.")
    lines = [line.strip() for line in read_text(file).splitlines()]
    found = {_find(names, line, file) for line in lines if line}
    return sorted(found, key=lambda i: sort_key(names[i]))


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8, or as its byte order mark says; InputError: it is unreadable."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"'{path}' cannot be read ({error.strerror}): check the file.") from None
    encoding = next((name for mark, name in MARKS.items() if content.startswith(mark)), "utf-8")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(f"'{path}' is no UTF-8 text at byte {error.start}: save it as UTF-8.") from None


def _find(names: list[str], word: str, file: Path) -> int:
    """Return the position of the one name that is `word`, else of the one that is `word` plus a suffix."""
    stems = [str(PurePosixPath(name).with_suffix("")) for name in names]
    hits = [i for i, name in enumerate(names) if name == word] or [i for i, s in enumerate(stems) if s == word]
    if len(hits) != 1:
        reason = "fits several images" if hits else "is no image of the scene"
        raise InputError(f"'{word}' in '{file}' {reason}, correct the list.{nearest(word, names)}")
    return hits[0]


def _pair(rule: str) -> list[str]:
    parts = [part.strip() for part in rule.partition(":")[2].split(",")]
    if len(parts) != 2 or not all(parts):
        raise ConfigError(f"scene.split is '{short(rule)}' and needs two values separated by a comma after the colon.")
    return parts


def _count(text: str, rule: str) -> int:
    count = positive(text)
    if count is None:
        raise ConfigError(
            f"scene.split is '{short(rule)}' and '{short(text)}' in it is no positive whole number of images."
        )
    return count


def refuse_file_twice(names: Sequence[str], photos: Sequence[Path], place: Path) -> None:
    """Raise InputError if two of the names in `place` are one path: `a/../b`, or without a suffix."""
    known: dict[str, str] = {}
    for name, photo in zip(names, photos, strict=True):
        path = os.path.abspath(photo)
        if path in known:
            both = f"'{name}' twice" if name == known[path] else f"'{known[path]}' and '{name}', which are one file"
            raise InputError(f"'{place}' has {both}, perhaps to train on and to test on: remove one.")
        known[path] = name


def refuse_shared(train: Sequence[View], test: Sequence[View], place: Path) -> None:
    """Raise InputError if a test photograph is trained on: the file itself, or one with the same bytes.

    Only files of equal size are opened, and only those read whole that agree at three places.
    """
    candidates: list[Sides] = [(photos_of(train), photos_of(test))]
    for key in (size, digest_of_parts, digest):
        candidates = [part for pair in candidates for part in alike(pair, key)]
    if candidates:
        one, other = candidates[0][0][0], candidates[0][1][0]
        names = f"'{one}'" if one == other else f"'{one}' is '{other}' byte for byte"
        shared = sum(len(tested) for _, tested in candidates)
        raise InputError(
            f"{shared} test photographs of '{place}' are trained on, too ({names}): remove one of each two."
        )


def photos_of(views: Iterable[View]) -> list[Path]:
    """Return the files of views, each once."""
    return list(dict.fromkeys(view.file for view in views if view.file is not None))


def alike(candidates: Sides, key: Callable[[Path], Hashable]) -> list[Sides]:
    """Return groups of candidates of equal `key` with photos of both sides; InputError: a file cannot be read."""
    groups: dict[Hashable, Sides] = defaultdict(lambda: ([], []))
    for side, photos in enumerate(candidates):
        for photo in photos:
            try:
                groups[key(photo)][side].append(photo)
            except OSError as problem:
                raise InputError(
                    f"Image '{photo}' cannot be read ({problem.strerror}): restore it, or its permissions."
                ) from None
    return [group for group in groups.values() if all(group)]


def size(photo: Path) -> int:
    """Return the number of bytes of a file."""
    return photo.stat().st_size


def digest_of_parts(photo: Path) -> bytes:
    """Return a digest of three blocks of a file."""
    parts = hashlib.sha256()
    with photo.open("rb") as stream:
        end = max(stream.seek(0, os.SEEK_END) - BLOCK, 0)
        for start in (0, end // 2, end):
            stream.seek(start)
            parts.update(stream.read(BLOCK))
    return parts.digest()


def digest(photo: Path) -> bytes:
    """Return a digest of a file."""
    with photo.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").digest()
