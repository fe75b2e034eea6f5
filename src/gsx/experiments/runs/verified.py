"""Decodes all photos once before training, so that a damaged one is reported now, not after an hour."""

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
from gsx.engine.cache import add_to_manifest, cache_folder, content_key, file_stamp, is_intact
from gsx.scenes.photo_source import PhotoSource

logger = logging.getLogger(__name__)

NAMED = 3
"""Damaged photos that an error quotes."""
LONG = 200
"""Least number of photos whose check is announced."""


def verified(scene: Scene) -> Scene:
    """Return the scene if its photos and masks can be decoded, else raise InputError; remember checked files."""
    sources = [view.source for view in (*scene.train, *scene.test)]
    photos = [source for source in sources if isinstance(source, PhotoSource)]
    masks = [source.mask.path for source in photos if source.mask is not None]
    paths = list(dict.fromkeys([*(source.path for source in photos), *masks]))
    if not paths or is_intact(known := remembered(paths)):
        return scene
    if len(paths) >= LONG:
        logger.info("checking all %d photos once", len(paths))
    refuse_damaged(paths)
    with suppress(OSError):  # without a cache they are checked again next time
        known.parent.mkdir(parents=True, exist_ok=True)
        write_json(known, [str(path) for path in paths])
        add_to_manifest(known)
    return scene


def remembered(paths: Sequence[Path]) -> Path:
    """Return the cache file of a check of these files as they are; raise InputError if one is missing."""
    try:
        key = content_key([(str(path.resolve()), file_stamp(path)) for path in paths])
        return cache_folder("verified", key) / "photographs.json"
    except OSError as error:
        raise InputError(f"Image '{error.filename}' cannot be read ({error.strerror}): restore it") from error


def refuse_damaged(paths: Sequence[Path]) -> None:
    """Decode files in parallel; raise InputError that names those that fail."""
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        problems = [problem for problem in pool.map(problem_of, paths) if problem]
    if problems:
        more = f" ... and {len(problems) - NAMED} others" if len(problems) > NAMED else ""
        raise InputError(" ".join(problems[:NAMED]) + more)


def problem_of(path: Path) -> str:
    """Return why a file cannot be decoded; empty if it can."""
    try:
        read_image(path)
    except InputError as error:
        return str(error)
    return ""
