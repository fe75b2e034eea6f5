"""Folders of pictures that programs write: which pictures belong together, and how they are named.

Sources: 3D-GS and its descendants, render.py; Mip-Splatting, render.py; nerfbaselines 1.2, evaluation.py; nerfstudio
1.1, scripts/render.py and scripts/eval.py.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gsx.core.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".npy", ".tif", ".tiff", ".webp")
"""Suffixes of pictures."""
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z")
"""Suffixes of packed folders."""
ZOOM_FOLDER = re.compile(r"(x|zoom|scale)?[_-]?(\d+(\.\d+)?)x?")
"""Names of sub-folders with the pictures of a zoom: x2, 2x, zoom_2, 2."""
ITERATION = re.compile(r"ours_(\d+)")
"""Names of folders of 3D-GS, one for each saved iteration."""
RENDERS = re.compile(r"renders|test_preds(_\d+)?")
"""Names of folders of renders: of 3D-GS, and of Mip-Splatting, one for each size."""
SIDE_BY_SIDE = re.compile(r"eval_img_\d+")
"""Names of nerfstudio's pictures that hold the photo on the left, the render on the right."""


@dataclass(frozen=True, kw_only=True)
class PictureSet:
    """Pictures of one folder, in the order of their names."""

    folder: Path
    files: tuple[Path, ...]
    truths: dict[Path, Path] = field(default_factory=dict)
    """The photos that the program compared with, by picture, where it wrote them."""
    side_by_side: bool = False
    """True: each picture holds the photo on the left and the render on the right."""
    numbered: bool = False
    """True: names are numbers in the order of the test views."""

    def key(self, file: Path) -> str:
        """Returns the name of a picture below its folder, without suffix."""
        return file.relative_to(self.folder).with_suffix("").as_posix()


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A folder of pictures as a program writes it."""

    program: str
    sets: tuple[PictureSet, ...]
    notes: tuple[str, ...] = ()


def layout_of(folder: Path) -> Layout:
    """Recognises the layout of a folder of pictures.

    Raises:
        InputError: there are no pictures.
    """
    nerfbaselines = named_renders("nerfbaselines", folder / "color", folder / "gt-color")
    found = inria(folder) or nerfbaselines or nerfstudio(folder) or plain(folder)
    if found is None:
        raise InputError(without_pictures(folder))
    return found


def without_pictures(folder: Path) -> str:
    """Returns the error for a folder without pictures."""
    packed = [path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in ARCHIVES]
    if packed:
        return f"'{folder}' holds no pictures, but {packed[0]}: unpack it first"
    return f"'{folder}' holds no pictures ({', '.join(SUFFIXES)}): give the folder of the renders"


def inria(folder: Path) -> Layout | None:
    """Recognises renders of 3D-GS and its descendants: MODEL/test/ours_N/renders, and gt."""

    def iteration(path: Path) -> int:
        found = ITERATION.fullmatch(path.name)
        return int(found[1]) if found else -1

    iterations = sorted([*folder.glob("test/ours_*"), *folder.glob("ours_*")], key=iteration)
    place = iterations[-1] if iterations else folder
    folders = [path for path in subfolders(place) if RENDERS.fullmatch(path.name)]
    sets = [numbered_set(path, place) for path in folders if pictures_in(path)]
    if not sets:
        return None
    others = [path.name for path in iterations[:-1]]
    notes = (f"{place.name} is measured; {', '.join(others)} are not",) if others else ()
    return Layout(program="3D-GS", sets=tuple(sets), notes=notes)


def numbered_set(folder: Path, place: Path) -> PictureSet:
    """Returns renders whose names are numbers, with the photos of the same numbers."""
    files = pictures_in(folder)
    photos = "gt" if folder.name == "renders" else folder.name.replace("test_preds", "gt")
    return PictureSet(folder=folder, files=files, truths=partners(files, folder, place / photos), numbered=True)


def nerfstudio(folder: Path) -> Layout | None:
    """Recognises `ns-render dataset`, test/rgb/ by the names of photos, and `ns-eval --render-output-path`."""
    for place in (folder, folder / "test"):
        if found := named_renders("nerfstudio", place / "rgb", place / "gt-rgb"):
            return found
    pairs = tuple(path for path in pictures_in(folder) if SIDE_BY_SIDE.fullmatch(path.stem))
    if not pairs:
        return None
    pictures = PictureSet(folder=folder, files=pairs, side_by_side=True, numbered=True)
    return Layout(program="nerfstudio", sets=(pictures,))


def named_renders(program: str, renders: Path, photos: Path) -> Layout | None:
    """Returns renders that have the names of photos, also below sub-folders; None: there are none."""
    files = pictures_in(renders, below=True)
    pictures = PictureSet(folder=renders, files=files, truths=partners(files, renders, photos))
    return Layout(program=program, sets=(pictures,)) if files else None


def plain(folder: Path) -> Layout | None:
    """Recognises pictures of one zoom, or one sub-folder for each zoom; otherwise sub-folders belong to the names."""
    zooms = [path for path in subfolders(folder) if ZOOM_FOLDER.fullmatch(path.name) and pictures_in(path, below=True)]
    direct = pictures_in(folder)
    sets = [PictureSet(folder=path, files=pictures_in(path, below=True)) for path in zooms]
    if direct or not zooms:
        files = direct if zooms else pictures_in(folder, below=True)
        sets = [PictureSet(folder=folder, files=files), *sets] if files else sets
    return Layout(program="pictures", sets=tuple(sets)) if sets else None


def subfolders(folder: Path) -> list[Path]:
    """Returns the visible folders in a folder, by name."""
    return [path for path in sorted(folder.iterdir()) if path.is_dir() and not path.name.startswith(".")]


def pictures_in(folder: Path, below: bool = False) -> tuple[Path, ...]:
    """Returns the visible pictures in a folder, by name, with those `below` it; none: it does not exist."""
    if not folder.is_dir():
        return ()
    return tuple(
        file
        for file in sorted(folder.rglob("*") if below else folder.iterdir())
        if file.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in file.relative_to(folder).parts)  # such as .ipynb_checkpoints
        and file.is_file()
    )


def partners(files: Sequence[Path], folder: Path, photos: Path) -> dict[Path, Path]:
    """Returns the photos that have the names of renders below another folder, with any suffix."""
    known = {path.relative_to(photos).with_suffix(""): path for path in pictures_in(photos, below=True)}
    keys = {file: file.relative_to(folder).with_suffix("") for file in files}
    return {file: known[key] for file, key in keys.items() if key in known}
