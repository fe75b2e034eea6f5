"""Assigns pictures to test views and zooms; does a picture show the view that its number assigns it to?"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.core.errors import InputError, nearest
from gsx.core.shapes import Float
from gsx.experiments.judge.layouts import PictureSet
from gsx.experiments.judge.picture_files import Header, read_header, read_picture
from gsx.experiments.judge.view_names import order_near
from gsx.experiments.reports.page import counted

NUMBER = re.compile(r"\d+$")
"""Number at the end of a picture's name."""
LISTED = 3
"""Names in a message."""
ZOOMS = (1 / 8, 1 / 4, 1 / 2, 1, 2, 3, 4, 6, 8, 16)
"""Zooms that a picture's size is compared with, beyond those of `eval.zoom`."""


@dataclass(frozen=True, kw_only=True)
class PlacedPicture:
    """A picture and the camera of its view at its size."""

    file: Path
    camera: Camera
    factor: float
    header: Header
    truth: Path | None = None
    """The photo that the program compared with, if it wrote one."""
    side_by_side: bool = False

    def render(self, background: Float[Tensor, "3"]) -> Float[Tensor, "3 H W"]:
        """Reads the render, over a background where it is transparent."""
        whole = read_picture(self.file, background)
        return whole[..., whole.shape[2] // 2 :] if self.side_by_side else whole

    def photo(self, background: Float[Tensor, "3"]) -> Float[Tensor, "3 H W"] | None:
        """Reads the photo that the program compared with; None: it wrote none."""
        if self.side_by_side:
            whole = read_picture(self.file, background)
            return whole[..., : whole.shape[2] // 2]
        return None if self.truth is None else read_picture(self.truth, background)


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Pictures of one folder by name of their view, and how they were matched."""

    pictures: dict[str, PlacedPicture]
    notes: tuple[str, ...]
    by_order: bool
    """True: names did not say which view a picture shows."""


class Matcher:
    """Finds the test view and the zoom of each picture of a method."""

    def __init__(
        self,
        views: Sequence[View],
        names: Mapping[str, View],
        zooms: Sequence[float] = (),
        order: Sequence[View] | None = None,
        partial: bool = False,
    ) -> None:
        """Takes test views, views by the names of pictures, and further zooms.

        order: views of numbered pictures, in their order; None: as the scene has them. partial: views may lack
        pictures.
        """
        self.views, self.names, self.order, self.partial = views, names, order, partial
        self.zooms = sorted({*ZOOMS, *zooms})

    def place(self, pictures: PictureSet) -> Placed:
        """Returns the pictures of a folder by view.

        Raises:
            InputError: pictures are missing, ambiguous, of sizes of no zoom, or of several zooms.
        """
        files, notes, by_order = self.match(pictures)
        placed = {view.name: self.sized(view, file, pictures) for view, file in files.items()}
        refuse_several_zooms(pictures.folder, placed)
        notes += rounding_notes(placed, {view.name: view for view in self.views})
        return Placed(pictures=placed, notes=tuple(notes), by_order=by_order)

    def match(self, pictures: PictureSet) -> tuple[dict[View, Path], list[str], bool]:
        """Returns the pictures by view, remarks, and whether order alone decided."""
        named = dict(self.named(pictures))
        if not self.has_names(pictures, named):
            listed = None if self.order is not None else order_near(pictures.folder, self.names)
            if listed is not None:
                note = f"views in the order of {listed[0].name}"
                return self.in_order(pictures, listed[1], f"in '{listed[0]}'"), [note], False
            if all(NUMBER.search(file.stem) for file in pictures.files):
                if self.order is not None:
                    return self.in_order(pictures, self.order, "in --order"), ["views in the order of --order"], False
                note = "pictures are numbered: taken in the order of the test views"
                return self.in_order(pictures, self.views, "held out"), [note], True
        self.refuse_missing(pictures, named)
        extra = len(pictures.files) - len(named)
        notes = [f"of no test view and left out: {counted(extra, 'picture')}"] if extra else []
        return named, notes, False

    def has_names(self, pictures: PictureSet, named: Mapping[View, Path]) -> bool:
        """Returns whether pictures have the names of views, some of which a number may have by chance."""
        if pictures.numbered:
            return len(named) == len(pictures.files)
        if self.order is None:
            return bool(named)
        return len(named) in (len(self.views), len(pictures.files))

    def named(self, pictures: PictureSet) -> Iterator[tuple[View, Path]]:
        """Yields pictures that have the name of a view; InputError: two have the same."""
        found: dict[str, Path] = {}
        for file in pictures.files:
            key = pictures.key(file)
            view = self.names.get(key) or self.names.get(PurePosixPath(key).name)
            if view is None:
                continue
            if view.name in found:
                first, other = (one.relative_to(pictures.folder) for one in (found[view.name], file))
                raise InputError(
                    f"'{pictures.folder}' has two pictures of view '{view.name}', {first} and {other}: keep one, or "
                    "put each zoom into a folder of its own, x1/ and x4/"
                )
            found[view.name] = file
            yield view, file

    def in_order(self, pictures: PictureSet, views: Sequence[View], where: str) -> dict[View, Path]:
        """Returns numbered pictures by view; InputError: their number is not that of the views listed `where`."""
        if (count := len(pictures.files)) != len(views):
            example = f"the first view is '{self.views[0].name}', the first picture {pictures.files[0].name}"
            raise InputError(
                f"'{pictures.folder}' holds {counted(count, 'picture')}, but there are {len(views)} test views "
                f"{where}, and the pictures do not have the names of views ({example}): name them as "
                "the views, or give --order FILE with the name of each picture's view, one a line"
            )
        return dict(zip(views, sorted(pictures.files, key=number_of), strict=True))

    def refuse_missing(self, pictures: PictureSet, named: Mapping[View, Path]) -> None:
        """Raises InputError if test views have no picture."""
        missing = [view.name for view in self.views if view not in named]
        if not missing or (self.partial and named):
            return
        unused = [pictures.key(file) for file in pictures.files if file not in named.values()]
        listed = ", ".join(f"'{name}'{self.guess(name, unused)}" for name in missing[:LISTED])
        more = f" and {len(missing) - LISTED} more" if len(missing) > LISTED else ""
        remedy = "name pictures as the views, or hold out the same views by scene.split"
        remedy += "; --partial measures the views that all methods have" if named else ""
        raise InputError(f"'{pictures.folder}' has no picture of test view {listed}{more}: {remedy}")

    @staticmethod
    def guess(name: str, unused: Sequence[str]) -> str:
        """Returns the nearest unused picture in words."""
        guess = nearest(name, unused)
        return f" (nearest: {guess.split(chr(39))[1]})" if guess else ""

    def sized(self, view: View, file: Path, pictures: PictureSet) -> PlacedPicture:
        """Returns a picture with the camera of its size; InputError: it is that of no zoom."""
        header = read_header(file)
        width, height = header.size
        if pictures.side_by_side:
            width //= 2
        for factor in self.zooms:
            camera = view.camera.zoom(factor)
            slack = max(1, factor)  # a reduced side is rounded by up to a px, at a zoom by as many
            if abs(camera.width - width) <= slack and abs(camera.height - height) <= slack:
                if view.zoom(factor) is None:
                    raise InputError(
                        f"'{file}' shows view '{view.name}' at x{factor:g}, where its photo has no pixels: use smaller "
                        "zooms, or by a larger scene.downscale"
                    )
                return PlacedPicture(
                    file=file,
                    camera=view.camera.resize(width, height),
                    factor=factor,
                    header=replace(header, size=(width, height)),
                    truth=pictures.truths.get(file),
                    side_by_side=pictures.side_by_side,
                )
        known = {factor: view.camera.zoom(factor).size for factor in (1, 2, 4) if view.zoom(factor) is not None}
        listed = ", ".join(f"{across} x {down} at x{factor}" for factor, (across, down) in known.items())
        raise InputError(
            f"'{file}' is {width} x {height} px, and view '{view.name}' is {listed}: render one of these sizes, or "
            "choose scene.downscale to fit"
        )


def number_of(file: Path) -> tuple[str, int, str]:
    """Returns what precedes the number at the end of a picture's name, the number, and the name, to sort by."""
    found = NUMBER.search(file.stem)
    return NUMBER.sub("", file.stem), (int(found[0]) if found else -1), file.name


def refuse_several_zooms(folder: Path, placed: Mapping[str, PlacedPicture]) -> None:
    """Raises InputError if one folder holds pictures of several zooms."""
    factors = sorted({picture.factor for picture in placed.values()})
    if len(factors) > 1:
        counts = {factor: sum(one.factor == factor for one in placed.values()) for factor in factors}
        listed = ", ".join(f"{count} at x{factor:g}" for factor, count in counts.items())
        raise InputError(f"'{folder}' holds pictures of several zooms ({listed}): put each into a sub-folder, x1/, x4/")


def rounding_notes(placed: Mapping[str, PlacedPicture], views: Mapping[str, View]) -> list[str]:
    """Returns a note on pictures whose sides differ from gsx's by rounding."""
    odd = [name for name, one in placed.items() if views[name].camera.zoom(one.factor).size != one.header.size]
    if not odd:
        return []
    own, ours = placed[odd[0]].header.size, views[odd[0]].camera.zoom(placed[odd[0]].factor).size
    return [
        f"rounded to another size: {counted(len(odd), 'picture')}, such as {own[0]} x {own[1]} px instead of "
        f"{ours[0]} x {ours[1]}; photos are reduced to that size"
    ]


SIDE = 16
"""Width and height of the thumbnails that are compared, px."""
CLEARLY = 0.8
"""A picture shows another view if its mean square there is below so much of that of its own."""
MOST_SHARE = 0.25
"""Largest share of pictures that may resemble another view: neighbouring views are alike, and renders are faulty."""


def refuse_other_order(folder: Path, pictures: Mapping[str, PlacedPicture], scene: Scene) -> None:
    """Raises InputError if many pictures, matched by their numbers, resemble another view more than their own."""
    views = [view for view in scene.test if view.name in pictures]
    if len(views) < 2:
        return
    photos = torch.stack([thumbnail(view.image()) for view in views])
    renders = torch.stack([thumbnail(pictures[view.name].render(scene.background)) for view in views])
    errors = (renders[:, None] - photos[None]).square().flatten(2).mean(2)
    odd = (errors.min(1).values < CLEARLY * errors.diagonal()).nonzero()[:, 0].tolist()
    if len(odd) > MOST_SHARE * len(views):
        raise InputError(in_words(folder, views, pictures, odd[0], int(errors[odd[0]].argmin()), len(odd)))


def in_words(
    folder: Path, views: list[View], pictures: Mapping[str, PlacedPicture], number: int, other: int, count: int
) -> str:
    """Returns the error for pictures in another order."""
    name = views[number].name
    return (
        f"'{folder}': {count} of {len(views)} numbered pictures resemble another view than that of their number, such "
        f"as {pictures[name].file.name}, taken for '{name}' and more like '{views[other].name}': give --order FILE "
        "with the name of each picture's view, one a line"
    )


def thumbnail(picture: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 side side"]:
    """Reduces a picture to a small square by means over areas."""
    return interpolate(picture[None], size=(SIDE, SIDE), mode="area")[0]
