"""Photographs under two names, by which test photographs could be trained on."""

import hashlib
import os
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path

from gsx.core.data.scene import View
from gsx.core.errors import InputError

BLOCK = 1 << 16  # bytes at the beginning, middle and end that are compared before whole files
Sides = tuple[list[Path], list[Path]]  # photographs to train on, and to test on


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
