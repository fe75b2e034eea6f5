"""Copies of photos that COLMAP decodes differently from gsx, for structure from motion.

COLMAP's wheel decodes no WebP, reads some compressions of TIFF as black pictures, and floating-point pictures as
stored. Mirrored photos (EXIF) match none of the others and have no rigid camera: their copies are not mirrored.
"""

import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from gsx.core.data.images import header_of, open_image, read_image, write_image
from gsx.scenes.orientation import oriented

logger = logging.getLogger(__name__)

SAME = ("jpeg", "png", "bmp")
"""Formats, by OpenImageIO's names, that both decode to the same pixels (a test compares them)."""
TOLERANCE = 2.0  # mean difference of 8-bit values of equal photos: JPEG decoders round differently
WORKERS = 4  # photos decoded at once: each takes several times its size of memory
KEPT = ("Make", "Model", "Exif:FocalLength", "Exif:FocalLengthIn35mmFilm")
"""EXIF from which COLMAP derives focal lengths and shared cameras."""


def candidates(folder: Path, first: Mapping[str, int]) -> dict[str, int]:
    """Return the photos that may need a copy, by their headers, with the orientation to apply to it.

    `first`: the orientation that brings each stored photo into the raster of its camera.
    """

    def alike(name: str) -> bool:
        reader = open_image(folder / name)
        kind = reader.format_name()  # by content
        reader.close()
        return kind in SAME

    return {name: turn for name, turn in first.items() if turn != 1 or not alike(name)}


def folder_for_colmap(folder: Path, names: Sequence[str], doubtful: Mapping[str, int], work: Path) -> Path:
    """Return the folder for COLMAP: `folder`, or one below `work` with links to its photos and copies of some.

    Copies keep the names of their photos, with any suffix: COLMAP recognises formats by content.

    Raises:
        InputError: a photo is damaged, or a copy cannot be written.
    """
    with ThreadPoolExecutor(WORKERS) as pool:
        needed = list(pool.map(lambda name: doubtful[name] != 1 or not reads_alike(folder / name), doubtful))
        copies = [name for name, need in zip(doubtful, needed, strict=True) if need]
        if not copies:
            return folder
        logger.info("sfm: %d of %d photos are converted for COLMAP", len(copies), len(names))
        target = work / "photos"
        for name in {*names} - {*copies}:
            link(folder / name, target / name)
        list(pool.map(lambda name: copy(folder / name, target / name, doubtful[name]), copies))
    return target


def reads_alike(photo: Path) -> bool:
    """Return whether COLMAP decodes a photo to the same colours as gsx."""
    import pycolmap

    bitmap = pycolmap.Bitmap.read(photo, True)
    if bitmap is None:
        return False
    here, there = read_image(photo)[:3].permute(1, 2, 0).numpy(), bitmap.to_array()
    return here.shape == there.shape and bool(np.abs(here.astype(np.int16) - there).mean() <= TOLERANCE)


def link(photo: Path, place: Path) -> None:
    """Link a file to another place, or copy it where the system allows no links."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        place.symlink_to(photo.resolve())
    except OSError:  # Windows without the privilege
        shutil.copyfile(photo, place)


def copy(photo: Path, place: Path, orientation: int) -> None:
    """Write a photo's colours as PNG of 8 bits, turned by an EXIF orientation, with its lens's EXIF."""
    place.parent.mkdir(parents=True, exist_ok=True)
    written = place.with_name(f".{place.name}.png")  # hidden files are no photos
    header = header_of(photo)
    lens = {name: value for name in KEPT if (value := header.getattribute(name)) is not None}
    write_image(written, oriented(read_image(photo)[:3], orientation), lens)
    os.replace(written, place)
