"""COLMAP models as text, turned into the binary files that pycolmap reads.

pycolmap's own reader of text ends the name of an image at its first space, and knows no byte order mark. Here names go
to the end of the line, as COLMAP writes them, and an error names its line.
"""

import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import takewhile
from pathlib import Path

import numpy as np

from gsx.core.errors import InputError, nearest
from gsx.scenes.colmap_records import FRAME, ID_MODEL_SIZE, LARGEST_SIDE, U64, camera_models

KEYPOINTS = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
NO_POINT = 2**64 - 1  # point id of a keypoint that observes no point; -1 in text
NAME_AT = 9  # numbers before the name of an image
BLANKS = " \t\r\n"  # around words; other characters that Python strips may be part of a name
STATED = re.compile(r"#\s*Number of \w+:\s*(\d+)")  # comment in which COLMAP states the number of records


def write_as_binary(files: Mapping[str, Path], folder: Path) -> list[str]:
    """Write the binary files of a text model to `folder`; `files` by content (`cameras`, `images`, ...).

    Returns a note for each file that holds another number of records than its comments state.

    Raises:
        InputError: a file is no text, or a line is wrong.
    """
    notes = []
    for name, file in files.items():
        records = list(records_of(file, READERS[name]))
        (folder / f"{name}.bin").write_bytes(U64.pack(len(records)) + b"".join(records))
        with file.open(encoding="utf-8-sig", errors="replace") as stream:
            top = takewhile(lambda line: line.startswith("#"), stream)
            stated = next((int(found[1]) for line in top if (found := STATED.match(line))), len(records))
        if stated != len(records):
            notes.append(f"{file.name} states {stated} {name} and holds {len(records)}.")
    return notes


class Lines:
    """Lines of a text file without comments and blanks at their ends; with or without a byte order mark."""

    def __init__(self, file: Path, errors: str = "strict") -> None:
        self.file, self.errors, self.number = file, errors, 0
        """File, treatment of bytes that are no UTF-8, and number of the latest line, from 1."""

    def __iter__(self) -> Iterator[str]:
        with self.file.open(encoding="utf-8-sig", errors=self.errors) as stream:
            for self.number, line in enumerate(stream, 1):
                text = line.strip(BLANKS)
                if not text.startswith("#"):
                    yield text


Reader = Callable[[Lines], Iterator[bytes]]
"""Yields a binary record for each record in text; raises ValueError for a line that is none."""


def records_of(file: Path, read: Reader) -> Iterator[bytes]:
    """Yield the binary records of a text file; InputError: it is no text, or a line is wrong."""
    lines = Lines(file)
    try:
        yield from read(lines)
    except UnicodeDecodeError as problem:
        odd = problem.object[problem.start : problem.start + 8]
        place = f"({odd!r}, after line {lines.number})"
        remedy = "save it as UTF-8, or rename the photos and reconstruct again."
        raise InputError(f"{file} holds bytes that are no UTF-8 {place}: {remedy}") from None
    except (ValueError, OverflowError, struct.error) as problem:
        end = "" if str(problem).endswith(("?", ".")) else "."
        raise InputError(
            f"{file} cannot be read at line {lines.number}: {problem}{end} Correct it, or make the model again."
        ) from None


def count_text_images(file: Path) -> int:
    """Return the number of images in an images.txt, which may be damaged."""
    return sum(1 for _ in _image_lines(Lines(file, errors="replace")))


def text_poses(file: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (name, quaternion w, x, y, z and translation) of each image of an images.txt; damaged lines are skipped."""
    for header, _ in _image_lines(Lines(file, errors="replace")):
        *numbers, name = _header_words(header)
        with suppress(ValueError):
            if len(numbers) == NAME_AT:  # else a list of photos of another program
                yield name, _floats(numbers[1:8])


# -- records -----------------------------------------------------------------------------------------------------------


def _cameras(lines: Lines) -> Iterator[bytes]:
    numbers = {name: (number, count) for number, (name, count) in camera_models().items()}
    for words in _rows(lines, 4, "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"):
        identity, model, width, height, *params = words
        if model not in numbers:
            raise ValueError(f"camera model '{model}' is unknown to pycolmap.{nearest(model.upper(), numbers)}")
        number, count = numbers[model]
        if len(params) != count:
            raise ValueError(f"camera model {model} has {count} parameters, and {len(params)} are there")
        size = _whole(width), _whole(height)
        if not all(0 < side <= LARGEST_SIDE for side in size):
            raise ValueError(f"a camera of {width}x{height} pixels")
        yield ID_MODEL_SIZE.pack(_whole(identity), number, *size) + _floats(params).tobytes()


def _images(lines: Lines) -> Iterator[bytes]:
    for header, keypoints in _image_lines(lines):
        *numbers, name = _header_words(header)
        if len(numbers) < NAME_AT:
            raise ValueError("it is no IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME")
        pose = _floats(numbers[1:8]).tobytes()
        head = struct.pack("<I", _whole(numbers[0])) + pose + struct.pack("<I", _whole(numbers[8]))
        if "\0" in name:
            raise ValueError("the name holds a NUL character")
        yield head + name.encode() + b"\0" + _keypoints(keypoints)


def _image_lines(lines: Lines) -> Iterator[tuple[str, str]]:
    """Yield the two lines of each image. The second may be empty; some programs leave empty ones out."""
    header = ""
    for line in lines:
        if not header:
            header = line
        elif _is_header(line):
            yield header, ""
            header = line
        else:
            yield header, line
            header = ""
    if header:
        yield header, ""


def _is_header(line: str) -> bool:
    """Recognise the first line of an image where keypoints are due: it has whole numbers for ids, and then a name."""
    words = _header_words(line)
    if not (len(words) > NAME_AT and words[0].isdecimal() and words[NAME_AT - 1].isdecimal()):
        return False
    try:
        return not _keypoints(line)
    except ValueError:
        return True


def _header_words(line: str) -> list[str]:
    """Return nine numbers and the name, which goes to the end of the line and may hold blanks."""
    return re.split(r"[ \t]+", line, maxsplit=NAME_AT)


def _keypoints(line: str) -> bytes:
    """Return keypoints (X, Y, POINT3D_ID) as COLMAP stores them."""
    values = _floats(line.split())
    if len(values) % 3:
        raise ValueError(f"{len(values)} numbers are no keypoints, which have three (X, Y, POINT3D_ID) each")
    rows = values.reshape(-1, 3)
    ids, stored = rows[:, 2], np.empty(len(rows), KEYPOINTS)
    if not (ids == np.floor(ids)).all():
        raise ValueError("a POINT3D_ID is no whole number")
    observed = (ids >= 0) & (ids < 2.0**63)
    stored["x"], stored["y"] = rows[:, 0], rows[:, 1]
    stored["point"] = np.where(observed, np.where(observed, ids, 0).astype(np.uint64), np.uint64(NO_POINT))
    return U64.pack(len(rows)) + stored.tobytes()


def _points(lines: Lines) -> Iterator[bytes]:
    for words in _rows(lines, 8, "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"):
        colour, track = [_whole(word) for word in words[4:7]], words[8:]
        if max(colour) > 255:
            raise ValueError(f"'{' '.join(words[4:7])}' is no colour, whose values go from 0 to 255")
        if len(track) % 2:
            raise ValueError(f"{len(track)} numbers are no track, which has two (IMAGE_ID, POINT2D_IDX) for each image")
        position, error = _floats(words[1:4]).tobytes(), _floats(words[7:8]).tobytes()
        elements = np.array([_whole(word) for word in track], dtype="<u4").tobytes()
        yield U64.pack(_whole(words[0])) + position + bytes(colour) + error + U64.pack(len(track) // 2) + elements


def _rigs(lines: Lines) -> Iterator[bytes]:
    for identity, count, *words in _rows(lines, 2, "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]"):
        record = struct.pack("<II", _whole(identity), _whole(count))
        for index in range(_whole(count)):  # the first is the reference, without a pose
            posed = index > 0 and words[2:3] == ["1"]
            end = 10 if posed else 3 if index else 2
            record += _sensor(words)
            if len(words) < end:
                raise ValueError("it ends within a sensor")
            record += struct.pack("<?", posed) + _floats(words[3:end]).tobytes() if index else b""
            words = words[end:]
        if words:
            raise ValueError(f"{len(words)} words are left over at its end")
        yield record


def _sensor(words: Sequence[str]) -> bytes:
    """Return the type and id of a sensor."""
    import pycolmap

    kinds = pycolmap.SensorType.__members__
    if len(words) < 2 or words[0] not in kinds:
        raise ValueError(f"'{' '.join(words[:2])}' is no sensor, which is one of {', '.join(kinds)} and a number")
    return struct.pack("<iI", int(kinds[words[0]]), _whole(words[1]))


def _frames(lines: Lines) -> Iterator[bytes]:
    for words in _rows(lines, 10, "FRAME_ID, RIG_ID, RIG_FROM_WORLD[], NUM_DATA_IDS, DATA_IDS[]"):
        count, data = _whole(words[9]), words[10:]
        if len(data) != 3 * count:
            raise ValueError(f"it lists {len(data) / 3:.3g} of {count} images")
        record = FRAME.pack(_whole(words[0]), _whole(words[1]), *_floats(words[2:9]), count)
        for first in range(0, 3 * count, 3):
            record += _sensor(data[first:]) + U64.pack(_whole(data[first + 2]))
        yield record


READERS: dict[str, Reader] = {
    "cameras": _cameras, "images": _images, "points3D": _points, "rigs": _rigs, "frames": _frames,
}  # fmt: skip


# -- words -------------------------------------------------------------------------------------------------------------


def _rows(lines: Lines, least: int, columns: str) -> Iterator[list[str]]:
    """Yield the words of the lines that are not empty, at least so many."""
    for line in lines:
        words = line.split()
        if 0 < len(words) < least:
            raise ValueError(f"{len(words)} words are less than {columns}")
        if words:
            yield words


def _whole(word: str) -> int:
    """Return a whole number, also one that is written `12.0`; ValueError: it is none, or negative."""
    number = int(word) if word.isdecimal() else float(word)
    if not (0 <= number < 2.0**63 and number == int(number)):
        raise ValueError(f"'{word}' is no whole number of 0 or more")
    return int(number)


def _floats(words: Sequence[str]) -> np.ndarray:
    """Return numbers, float64."""
    return np.array([float(word) for word in words], dtype="<f8")
