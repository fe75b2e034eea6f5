"""Binary records of COLMAP models: their layout, and the walk that finds where a file is cut or foreign."""

import mmap
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from gsx.core.errors import InputError

U64, ID_MODEL_SIZE = struct.Struct("<Q"), struct.Struct("<iiQQ")
RIG, SENSOR, FRAME = struct.Struct("<II"), struct.Struct("<iI?"), struct.Struct("<II7dI")
RIG_REFERENCE, POSE, FRAME_DATA = 8, 56, 16  # bytes: (type, id); quaternion and translation; (type, id, data id)
IMAGE_HEAD, KEYPOINT = 64, 24  # bytes: id, quaternion, translation, camera id; x, y, point id
POINT_HEAD, TRACK_ELEMENT = 43, 8  # bytes: id, xyz, rgb, error; image id, keypoint index

LARGEST_SIDE = 2**20  # px of a photo: larger numbers are mistakes, and COLMAP undistorts borders pixel by pixel
Bytes = bytes | mmap.mmap


def check_binary(name: str, file: Path) -> None:
    """Walk a file of `cameras`, `images` ... to its end; InputError: it is cut off, too long or of unknown content."""
    size, remedy = file.stat().st_size, "copy or make the model again"

    def truncated(index: int, count: int) -> InputError:
        return InputError(f"{file} is truncated: its {size} bytes end within record {index} of {count}; {remedy}.")

    if size < U64.size:
        raise truncated(0, 0)
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,) = U64.unpack_from(data, 0)
        at = U64.size
        for index in range(count):
            try:
                at = SKIPS[name](data, at)
            except struct.error:
                raise truncated(index, count) from None
            except ValueError as problem:
                raise InputError(f"{file} is corrupt at record {index}: {problem}; make the model again.") from None
            if at > size:
                raise truncated(index, count)
    if at < size:
        raise InputError(f"{file} goes on for {size - at} bytes after its {count} records: {remedy}.")


def records(name: str, data: Bytes) -> Iterator[int]:
    """Yield the place of each record in a file that `check_binary` accepts."""
    at = U64.size
    for _ in range(U64.unpack_from(data, 0)[0]):
        yield at
        at = SKIPS[name](data, at)


def _skip_camera(data: Bytes, at: int) -> int:
    import pycolmap

    _, model, width, height = ID_MODEL_SIZE.unpack_from(data, at)
    if model not in camera_models():
        raise ValueError(f"camera model number {model} is unknown to pycolmap {pycolmap.__version__}")
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        raise ValueError(f"a camera of {width}x{height} pixels")
    return at + ID_MODEL_SIZE.size + 8 * camera_models()[model][1]


@cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Return (name, number of parameters) of each camera model that pycolmap knows, by its number in files."""
    import pycolmap

    members = {int(member): name for name, member in pycolmap.CameraModelId.__members__.items() if int(member) >= 0}
    make = pycolmap.Camera.create_from_model_name
    return {number: (name, len(make(1, name, 1.0, 1, 1).params)) for number, name in members.items()}


def _skip_image(data: Bytes, at: int) -> int:
    end = data.find(b"\0", at + IMAGE_HEAD)
    if end < 0:
        raise struct.error
    (keypoints,) = U64.unpack_from(data, end + 1)
    return int(end + 1 + U64.size + KEYPOINT * keypoints)


def _skip_rig(data: Bytes, at: int) -> int:
    _, sensors = RIG.unpack_from(data, at)
    at += RIG.size + (RIG_REFERENCE if sensors else 0)
    for _ in range(sensors - 1):
        *_, posed = SENSOR.unpack_from(data, at)
        at += SENSOR.size + (POSE if posed else 0)
    return at


SKIPS: dict[str, Callable[[Bytes, int], int]] = {
    "cameras": _skip_camera,
    "images": _skip_image,
    "points3D": lambda data, at: int(at + POINT_HEAD + 8 + TRACK_ELEMENT * U64.unpack_from(data, at + POINT_HEAD)[0]),
    "rigs": _skip_rig,
    "frames": lambda data, at: int(at + FRAME.size + FRAME_DATA * FRAME.unpack_from(data, at)[-1]),
}
"""Functions that return the end of the record that begins at a place."""


# -- ids ---------------------------------------------------------------------------------------------------------------


HEADS = {
    "cameras": struct.Struct("<I"), "images": struct.Struct("<I56xI"), "rigs": struct.Struct("<I"),
    "frames": struct.Struct("<II"),
}  # fmt: skip
"""The id at the beginning of a record and, if any, the id of the record in another file that it refers to."""
REFERENCES = {"images": "cameras", "frames": "rigs"}


def contradiction(folder: Path) -> str:
    """Describe what is wrong with the ids in the binary files of a model; empty: nothing."""
    files = {name: (folder / f"{name}.bin").read_bytes() for name in HEADS if (folder / f"{name}.bin").is_file()}
    heads = {name: [HEADS[name].unpack_from(data, at) for at in records(name, data)] for name, data in files.items()}
    for name, rows in heads.items():
        ids = Counter(row[0] for row in rows)
        if twice := [number for number, count in ids.items() if count > 1]:
            return f"the id {twice[0]} stands twice in {name}"
    for name, other in REFERENCES.items():
        known = {row[0] for row in heads.get(other, [])}
        if lacking := [row for row in heads.get(name, []) if row[1] not in known]:
            number, reference = lacking[0]
            return f"entry {number} of {name} refers to {reference} of {other}, which is not there"
    return ""
