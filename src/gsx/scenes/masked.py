"""Masks of photographs: their places, and the photographs that have one."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from gsx.core.data.images import has_alpha, image_size, is_reduction
from gsx.core.data.masks import INTERPOLATED, Mask
from gsx.core.data.resize import Size
from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.core.files import expand_home, is_file
from gsx.scenes.options import SceneOptions
from gsx.scenes.orientation import INVERSES, Turns, oriented_size
from gsx.scenes.photo_source import PhotoSource
from gsx.scenes.pose_files import SUFFIXES
from gsx.scenes.undistort import StoredUndistortion

IMAGES = "images"  # usual folder of the photos
FOLDER = "masks"  # next to the folder of the photos (COLMAP)


def mask_of(
    photo: Path,
    name: str,
    stated: Path | None,
    remap: StoredUndistortion | None,
    expected: Size,
    options: SceneOptions,
    turns: Turns,
) -> Mask | None:
    """Return a photograph's mask, if any; `expected`: size of its camera's raster; InputError: it is missing or odd."""
    if options.masks == "none":
        return None
    reach = 0 if remap is None else INTERPOLATED
    if options.masks == "alpha":
        return Mask(path=photo, alpha=True, remap=turns.around(remap), reach=reach) if has_alpha(photo) else None
    if stated is not None and not is_file(stated):
        raise InputError(f"The mask '{stated}' of '{photo}' does not exist: restore it, or set scene.masks=none.")
    files = filter(is_file, candidates(folder_of(options), name))
    path = stated or next((file for file in files if file.resolve() != photo.resolve()), None)
    if path is None:
        return None
    undistortion = None if remap is None else replace(remap, photo=path)
    return Mask(path=path, alpha=False, remap=turns.around(undistortion, to_stored(path, turns, expected)), reach=reach)


def to_stored(mask: Path, turns: Turns, raster: Size) -> tuple[int, ...]:
    """Return the orientations that bring a mask to the raster of its photograph's file.

    A mask states no orientation. By its shape it belongs to the stored photograph, as COLMAP's do, or else to the
    upright one.

    Raises:
        InputError: it has neither shape.
    """
    size, stored = image_size(mask), turns.stored_size(raster)
    if not is_reduction(size, stored) and is_reduction(size, oriented_size(stored, turns.exif)):
        return (INVERSES.get(turns.exif, turns.exif),)
    if not is_reduction(size, stored):
        sizes = f"{size[0]} x {size[1]} and its photo {stored[0]} x {stored[1]}"
        raise InputError(f"The mask '{mask}' is {sizes}: give it the photo's shape, or set scene.masks=none.")
    return ()


def folder_of(options: SceneOptions, folder: str = FOLDER) -> Path:
    """Return the folder of masks: in the scene's folder, or next to it where that holds photographs itself."""
    path = expand_home(options.path)
    inside, above = path / folder, path.parent / folder
    photographs = options.name == "photos" and not (path / IMAGES).is_dir()
    return above if photographs and not inside.is_dir() else inside


def candidates(folder: Path, name: str, suffixes: Sequence[str] = SUFFIXES) -> list[Path]:
    """Return files that may be the mask of a photograph: NAME.png (COLMAP), NAME, or NAME with another suffix.

    They lie below the same folders, or without the first of them.
    """
    parts = [part for part in PurePosixPath(name).parts if part not in ("/", "..")]
    names = dict.fromkeys(PurePosixPath(*parts[first:]) for first in range(min(len(parts), 2)))
    forms = [(f"{one}.png", str(one), *(str(one.with_suffix(suffix)) for suffix in suffixes)) for one in names]
    return [folder / form for several in forms for form in several]


def mask_notes(views: Sequence[View], options: SceneOptions) -> list[str]:
    """Return a note on the number of photographs with a mask; InputError: no mask belongs to a photograph."""
    found, folder = len(masks_of(views)), folder_of(options)
    if found:
        where = "alpha" if options.masks == "alpha" else "masks"
        return [f"Pixels outside the {where} of {found} of {len(views)} photographs count in no loss and no metric."]
    if options.masks == "alpha":
        raise InputError(
            "scene.masks=alpha, but no photograph has alpha: leave it out, or put files into a folder 'masks'."
        )
    own = folder.parent == expand_home(options.path)
    if options.masks == "auto" and own and folder.is_dir() and any(map(is_file, folder.rglob("*.*"))):
        raise InputError(
            f"None of the masks in '{folder}' has the name of a photograph: call that of a.jpg a.jpg.png or a.png, or "
            "set scene.masks=none."
        )
    return []


def masks_of(views: Sequence[View]) -> list[tuple[str, Mask]]:
    """Return (name, mask) of the photographs that have one."""
    sources = ((view.name, view.source) for view in views)
    masks = ((name, source.mask) for name, source in sources if isinstance(source, PhotoSource))
    return [(name, mask) for name, mask in masks if mask is not None]


def masks_named(views: Sequence[View]) -> Mapping[str, Any]:
    """Return the number and a digest of masks for the provenance, if any: other protocols keep their hash.

    Masks that are the alpha of photographs count by name alone.
    """
    masks, digest = masks_of(views), hashlib.sha256()
    for name, mask in masks:
        digest.update(repr((name, mask.alpha)).encode())
        digest.update(b"" if mask.alpha else mask.path.read_bytes())
    return {"masks": len(masks), "masks_content": digest.hexdigest()[:16]} if masks else {}
