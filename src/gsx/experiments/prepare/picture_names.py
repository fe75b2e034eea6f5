"""File names of pictures: unique without suffix, derived from the names of views."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.scenes.pose_files import SUFFIXES
from gsx.scenes.splits import sort_key

SUFFIX = ".png"
LONGEST = 100
"""Letters of a view's name that a file name keeps."""
UNSAFE = re.compile(r"[^A-Za-z0-9_-]")
"""Characters that become `_`. Dots as well: 3D-GS cuts names at the first one."""
PUBLISHED = 8
"""3D-GS and gsplat hold out every eighth photo by name."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """A view and the file name of its picture."""

    view: View
    file: str
    """Such as `0001.png`."""

    @property
    def name(self) -> str:
        """Name of the view."""
        return self.view.name

    @property
    def camera(self) -> Camera:
        """Camera of the view."""
        return self.view.camera


def pictures_of(
    train: Sequence[View], test: Sequence[View], keep_order: bool = False
) -> tuple[list[Picture], list[Picture]]:
    """Return the pictures of training and test views; `keep_order`: file names sort as the scene's own names."""
    views = [*train, *test]
    files = file_names([view.name for view in views], keep_order)
    pictures = [Picture(view=view, file=file) for view, file in zip(views, files, strict=True)]
    return pictures[: len(train)], pictures[len(train) :]


def file_names(names: Sequence[str], keep_order: bool = False) -> list[str]:
    """Return one file name for each name, in their order.

    Suffixes of photos are cut, and other characters than A-Z, a-z, 0-9, `_` and `-` become `_`. If two are then the
    same (in any case), or if the order must stay and would not, all of them begin with their number in that order.
    """
    suffixed = [PurePosixPath(name).suffix.lower() in SUFFIXES for name in names]
    stems = [str(PurePosixPath(n).with_suffix("")) if cut else n for n, cut in zip(names, suffixed, strict=True)]
    files = [f"{UNSAFE.sub('_', stem)[-LONGEST:]}{SUFFIX}" for stem in stems]
    order = sorted(range(len(names)), key=lambda i: sort_key(names[i]))
    sorts = not keep_order or sorted(range(len(files)), key=files.__getitem__) == order
    if sorts and len({file.lower() for file in files}) == len(files):
        return files
    digits = len(str(len(names)))
    place = {index: number for number, index in enumerate(order, start=1)}
    return [f"{place[index]:0{digits}d}_{file}" for index, file in enumerate(files)]


def every_eighth_is_test(train: Sequence[Picture], test: Sequence[Picture]) -> bool:
    """Return whether every eighth of all file names, from the first, is a test picture and no other is."""
    files = sorted(picture.file for picture in [*train, *test])
    return bool(test) and files[::PUBLISHED] == sorted(picture.file for picture in test)
