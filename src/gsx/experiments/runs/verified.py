"""Photographs are all decoded once before training: a damaged one is told now, not after an hour."""

import logging
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from gsx.core.data.images import read_image
from gsx.core.data.scene import Scene
from gsx.core.errors import InputError
from gsx.core.files import write_json
from gsx.engine.cache import cache_folder, content_key, enlist, file_stamp, whole
from gsx.scenes.photo_source import PhotoSource

logger = logging.getLogger(__name__)

NAMED = 3
"""Damaged photographs that an error quotes."""
LONG = 200
"""Photographs from which on it is said that they are being looked at."""


def verified(scene: Scene) -> Scene:
    """Returns the scene if its photographs and masks can be decoded; remembers them by name, size and time.

    Raises:
        InputError: some are damaged or missing.
    """
    sources = [view.source for view in (*scene.train, *scene.test)]
    photographs = [source for source in sources if isinstance(source, PhotoSource)]
    masks = [source.mask.path for source in photographs if source.mask is not None]
    paths = list(dict.fromkeys([*(source.path for source in photographs), *masks]))
    if not paths or whole(known := remembered(paths)):
        return scene
    if len(paths) >= LONG:
        logger.info("looking at all %d photographs once", len(paths))
    refuse_damaged(paths)
    with suppress(OSError):  # without a cache they are looked at again next time
        known.parent.mkdir(parents=True, exist_ok=True)
        write_json(known, [str(path) for path in paths])
        enlist(known)
    return scene


def remembered(paths: Sequence[Path]) -> Path:
    """Returns the file that says that these, as they are now, could be decoded.

    Raises:
        InputError: one cannot be looked at.
    """
    try:
        key = content_key([(str(path.resolve()), file_stamp(path)) for path in paths])
        return cache_folder("verified", key) / "photographs.json"
    except OSError as error:
        raise InputError(f"Image '{error.filename}' cannot be looked at ({error.strerror}): restore it") from error


def refuse_damaged(paths: Sequence[Path]) -> None:
    """Raises InputError naming the files that cannot be decoded; several are at a time."""
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        problems = [problem for problem in pool.map(problem_of, paths) if problem]
    if problems:
        more = f" ... and {len(problems) - NAMED} others" if len(problems) > NAMED else ""
        raise InputError(" ".join(problems[:NAMED]) + more)


def problem_of(path: Path) -> str:
    """Returns why a file cannot be decoded; empty if it can."""
    try:
        read_image(path)
    except InputError as error:
        return str(error)
    return ""
