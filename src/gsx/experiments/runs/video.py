"""Photos from a video: the sharpest frame of each interval."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsx.core.data.images import write_image
from gsx.core.errors import InputError, first_line
from gsx.core.files import read_json, write_json
from gsx.core.packages import require
from gsx.core.shapes import Float, UInt8
from gsx.engine.cache import content_key, creation_lock, file_stamp

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")
FRAMES = 100
"""Intervals of a video, and so photos."""
LEAST_FRAMES = 10
"""Least frames of a video: fewer do not show enough of a scene."""
INDEX = "frames.json"
"""File with the stamp of the folder's video, written last."""


def is_video(path: Path) -> bool:
    """Return True for a file with the name of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def photos_of(path: Path, output: Path, count: int = FRAMES) -> Path:
    """Return a folder below `output` with the sharpest frame of each of `count` intervals of a video; made once.

    Raises:
        ConfigError: PyAV is not installed.
        InputError: the video cannot be read, or is too short.
    """
    require(f"frames of {path}", ("av",), "gsx[video]")
    turns = next(map(quarter_turns, frames_in(path)), 0)
    made_of = [*map(str, file_stamp(path)), count, *([turns] if turns else [])]
    folder = output / "videos" / f"{path.stem}_{content_key(made_of)[:8]}"
    if not chosen(folder, made_of):
        with creation_lock(folder / INDEX, wait=True):
            if not chosen(folder, made_of):
                choose(path, folder, count, made_of)
                return folder
    logger.info("frames were chosen earlier: %s", folder)
    return folder


def chosen(folder: Path, made_of: Sequence[Any]) -> bool:
    """Return True if a folder holds these frames."""
    return (folder / INDEX).exists() and bool(read_json(folder / INDEX) == made_of)


def choose(path: Path, folder: Path, count: int, made_of: Sequence[Any]) -> None:
    """Write frames of a video to a folder, and then its stamp; raise InputError for an unreadable or short video."""
    for old in [folder / INDEX, *folder.glob("frame_*.png")]:
        old.unlink(missing_ok=True)
    total = sum(1 for _ in frames_in(path))
    if total < LEAST_FRAMES:
        raise InputError(f"'{path}' has {total} frames, too few to reconstruct a scene: film for some seconds")
    intervals = min(count, total)
    for number, pixels in sharpest(path, total, intervals):
        write_image(folder / f"frame_{number:05d}.png", torch.from_numpy(pixels).permute(2, 0, 1))
    write_json(folder / INDEX, made_of)
    logger.info("%d of %d frames chosen, the sharpest of each interval: %s", intervals, total, folder)


def frames_in(path: Path) -> Iterator[Any]:
    """Yield decoded frames of the first video stream; raise InputError if it cannot be read."""
    import av

    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"'{path}' holds no video: give another file")
            container.streams.video[0].thread_type = "AUTO"
            yield from container.decode(video=0)
    except av.error.FFmpegError as error:
        raise InputError(f"'{path}' cannot be read as a video ({first_line(error)}): give another file") from error


def sharpest(path: Path, total: int, intervals: int) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """Yield (index, pixels) of the sharpest frame of each interval, in order."""
    best: tuple[float, int, Any] | None = None
    for number, frame in enumerate(frames_in(path)):
        if best is not None and number * intervals // total > best[1] * intervals // total:
            yield best[1], upright_pixels(best[2])
            best = None
        score = sharpness(frame.to_ndarray(format="gray").astype(np.float32))
        if best is None or score > best[0]:
            best = score, number, frame
    if best is not None:
        yield best[1], upright_pixels(best[2])


def quarter_turns(frame: Any) -> int:
    """Return the counterclockwise quarter turns that bring a frame upright: phones film as the sensor lies."""
    return round(getattr(frame, "rotation", 0) / 90)


def upright_pixels(frame: Any) -> UInt8[np.ndarray, "H W 3"]:
    """Return a frame upright, as players do."""
    return np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), quarter_turns(frame)))


def sharpness(grey: Float[np.ndarray, "H W"]) -> float:
    """Return the variance of the Laplacian, which blur lowers (Pech-Pacheco et al. 2000)."""
    inner = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * inner
    return float(laplacian.var())
