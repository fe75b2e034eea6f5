"""Names by which pictures may call a test view, and lists of views that programs write."""

import logging
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.core.files import read_json
from gsx.experiments.reports.pictures import file_names

logger = logging.getLogger(__name__)

SUFFIX = re.compile(r"\.(png|jpe?g|exr|npy|webp|tiff?|bmp)$", re.IGNORECASE)
ORDERS = ("test_views.txt", "cameras.json")
"""Lists that are looked for next to pictures, and above them: of `gsx prepare`, of 3D-GS."""
LEVELS = 3
"""Folders above the pictures in which lists are looked for, as of 3D-GS: MODEL/test/ours_N/renders."""


def bare(name: str) -> str:
    """Returns a name without the suffix of a picture."""
    return SUFFIX.sub("", name)


def names_of_views(views: Sequence[View], aliases: Mapping[str, str]) -> dict[str, View]:
    """Returns the views by each name that a picture may have; names that two views share are left out.

    A view `cam1/0001.jpg` is called cam1/0001, cam1_0001 or 0001. aliases: further names by name of the view.
    """
    drawn = file_names([view.name for view in views])
    names = []
    for view, file in zip(views, drawn, strict=True):
        plain = bare(view.name)
        names.append({plain, plain.replace("/", "_"), PurePosixPath(plain).name, file, aliases.get(view.name, file)})
    shared = {name for name, count in Counter(name for own in names for name in own).items() if count > 1}
    whole = {bare(view.name): view for view in views}
    return {name: view for view, own in zip(views, names, strict=True) for name in own - shared} | whole


def order_near(folder: Path, names: Mapping[str, View]) -> tuple[Path, list[View]] | None:
    """Returns the list of views next to pictures or above them, if its first entries name test views; None: none."""
    for place in (folder, *folder.absolute().parents[:LEVELS]):
        for name in ORDERS:
            if (path := place / name).is_file() and (order := leading_views(order_if_any(path), names)):
                return path, order
    return None


def order_if_any(path: Path) -> list[str]:
    """Reads a list that happens to stand near pictures; it may be another file of that name: a warning, no views."""
    try:
        return read_order(path)
    except InputError as error:
        logger.warning("%s; the file is left out", error)
        return []


def leading_views(listed: Iterable[str], names: Mapping[str, View]) -> list[View]:
    """Returns the test views of the first entries: 3D-GS lists training views after them."""
    views: list[View] = []
    for name in listed:
        view = names.get(bare(name)) or names.get(PurePosixPath(bare(name)).name)
        if view is None or view in views:
            break
        views.append(view)
    return views


def read_order(path: Path) -> list[str]:
    """Reads the names of pictures in order: a line each, or 3D-GS's cameras.json, or frames of a transforms.json.

    Raises:
        InputError: the file is none of these.
    """
    try:
        if path.suffix.lower() != ".json":
            return [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
        content = read_json(path)
    except (OSError, ValueError) as error:
        reason = (error.strerror or error) if isinstance(error, OSError) else error
        raise InputError(f"'{path}' cannot be read ({reason}): give a list of views, one name a line") from None
    entries = content.get("frames") if isinstance(content, dict) else content
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"'{path}' lists no cameras: give 3D-GS's cameras.json, a transforms.json, or one name a line")
    if unnamed := [number for number, entry in enumerate(entries, start=1) if not name_in(entry)]:
        raise InputError(
            f"'{path}': entry {unnamed[0]} has no img_name, file_path or name: give each its picture's name"
        )
    return [name_in(entry) for entry in entries]


def name_in(entry: Mapping[str, Any]) -> str:
    """Returns the picture's name of an entry of a camera file; empty: it has none."""
    named = (entry.get(key) for key in ("img_name", "file_path", "name"))
    return str(next((name for name in named if isinstance(name, str)), ""))
