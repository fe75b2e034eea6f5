"""Transforms files of a folder: one with all frames, or one to train on and one to test on."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsx.core.errors import InputError
from gsx.scenes.lenses import beyond_angle, states_lens
from gsx.scenes.pose_files import frames_in, read_frames, read_json, refuse_twice

FILE, TRAIN_FILE = "transforms.json", "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
TEST_FRAMES = "test_frames"  # ScanNet++'s key of the frames to test on


@dataclass(frozen=True, eq=False)
class FrameFile:
    """Frames of one transforms file: all to train on, all to test on, or to be split."""

    file: Path
    content: Mapping[str, Any]
    """Values common to all frames."""
    frames: list[dict[str, Any]]


def frame_files(path: Path) -> list[FrameFile]:
    """Read a transforms file or folder: all frames, or those to train and to test on; InputError: it is unusable."""
    file = path if path.is_file() else path / FILE
    if not file.is_file() and (path / TRAIN_FILE).is_file():
        parts = _pair(path)
    else:
        content, frames = read_frames(file)
        parts = [FrameFile(file, content, frames)]
        if content.get(TEST_FRAMES):
            parts.append(FrameFile(file, content, frames_in(content, file, TEST_FRAMES)))
    refuse_twice([frame["file_path"] for part in parts for frame in part.frames], parts[-1].file)
    return parts


def _pair(folder: Path) -> list[FrameFile]:
    """Read a folder with transforms_train.json, whose cameras have more than an angle of view."""
    content = read_json(folder / TRAIN_FILE)
    frames = content.get("frames")
    listed = [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []
    if not any(map(states_lens, (content, *listed))):
        raise InputError(f"'{folder}' has {TRAIN_FILE} and no {FILE}: it is a scene=blender folder.")
    return [FrameFile(file, *read_frames(file)) for file in (folder / TRAIN_FILE, test_file(folder)) if file]


def test_file(folder: Path) -> Path | None:
    """Return the file of the test frames: transforms_test.json, else transforms_val.json; None: neither has frames."""
    files = (folder / name for name in TEST_FILES)
    return next((file for file in files if file.is_file() and not is_empty(file)), None)


def is_empty(file: Path) -> bool:
    """Return whether a transforms file lists no frames; False for a damaged one, which `read_frames` refuses."""
    try:
        return read_json(file).get("frames") == []
    except InputError:
        return False


def nodes(part: FrameFile) -> Iterator[Mapping[str, Any]]:
    """Yield the mappings that may describe a camera: the file's common values, then each frame."""
    yield part.content
    yield from part.frames


def needs_lens(file: Path) -> bool:
    """Return whether a file's cameras have more than its angle of view; False for a damaged one."""
    try:
        content, frames = read_frames(file)
    except InputError:
        return False
    return any(beyond_angle(content, node) for node in (content, *frames))
