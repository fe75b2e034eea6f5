"""Does a picture show the view that it was assigned to by its number?"""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from gsx.core.data.scene import Scene, View
from gsx.core.errors import InputError
from gsx.core.shapes import Float
from gsx.experiments.judge.matching import PlacedPicture

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
