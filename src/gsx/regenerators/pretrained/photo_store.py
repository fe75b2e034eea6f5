"""Enlarged photos: each is made once, and windows are cut from it."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TypeAlias

import torch
from torch import Tensor

from gsx.core.data.reduction import Reduction
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import InputError
from gsx.core.shapes import Float, UInt8
from gsx.core.training.regenerator import Request
from gsx.engine.cache import cache_folder, content_key
from gsx.engine.cached_images import cache_image, read_cached_image

Enlarge: TypeAlias = Callable[[Float[Tensor, "3 h w"], int, Reduction], Tensor]
"""(picture, scale, filter of the scene) -> picture `scale` times as large."""


class PhotoStore:
    """Photos at several times their size, in 8 bits, in memory and in the cache."""

    def __init__(self, gigabytes: float, enlarge: Enlarge, recipe: Callable[[], object]) -> None:
        self.gigabytes, self.enlarge, self.recipe = gigabytes, enlarge, recipe
        self.pixels = 0
        """Pixels of all training photos; 0: unknown."""
        self.enlarged: dict[tuple[int, int], UInt8[Tensor, "3 H W"]] = {}
        """Enlarged photos by number of the view and scale."""

    def expect(self, views: Sequence[View]) -> None:
        """Counts the pixels that there will be to enlarge."""
        self.pixels = sum(view.camera.width * view.camera.height for view in views)

    def has(self, request: Request) -> bool:
        """Returns whether a request is a photo without mask, or a window of it if all photos fit at its scale."""
        whole = request.camera.size == request.view.camera.size
        fits = 0 < 3 * self.pixels * request.scale**2 <= 1e9 * self.gigabytes
        return (whole or fits) and request.photo and request.scale > 1 and request.view.counted() is None

    def cut(self, request: Request) -> Float[Tensor, "3 H W"]:
        """Returns the requested window of the enlarged photo."""
        key, window = (request.number, request.scale), enlarged_window(request)
        picture = self.enlarged[key] if key in self.enlarged else self.made(request)
        if tuple(picture.shape[1:]) != (window.height, window.width):  # a whole photo is requested once
            self.enlarged[key] = picture
        return window.cut(picture).float() / 255

    def made(self, request: Request) -> UInt8[Tensor, "3 H W"]:
        """Reads the enlarged photo of a request from the cache, or makes it."""
        photo = request.view.image()
        path = self.path(photo, request)
        cached = read_cached_image(path)
        if cached is not None:
            return cached
        result = self.enlarge(photo, request.scale, request.reduction)
        if not bool(torch.isfinite(result).all()):
            raise InputError(
                f"regenerator: the network returns values that are not finite for '{request.view.name}'. "
                "Choose another network, or leave that photo out."
            )
        picture = to_uint8(result.clamp(0, 1))
        cache_image(path, picture)
        return picture

    def path(self, photo: Float[Tensor, "3 h w"], request: Request) -> Path:
        """Returns the place of an enlarged photo in the cache, by all that decides its pixels."""
        digest = hashlib.sha256(to_uint8(photo).numpy().tobytes()).hexdigest()
        recipe = content_key(self.recipe(), request.scale, asdict(request.reduction))
        return cache_folder("enlarged_photos", recipe) / f"{content_key(digest, photo.shape)}.png"


def enlarged_window(request: Request) -> Window:
    """Returns the window of a request on the enlarged photo."""
    camera, whole, scale = request.camera, request.view.camera, request.scale
    left, top = round(whole.cx - camera.cx), round(whole.cy - camera.cy)
    return Window(left=scale * left, top=scale * top, width=scale * camera.width, height=scale * camera.height)
