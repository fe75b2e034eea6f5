"""Pictures, sizes and cameras turned by EXIF's orientations, and the turns that a photo needs.

Programs such as COLMAP define cameras on the stored raster: photos of one lens share a camera in either orientation.
Here a photo is undistorted on that raster, and then turned upright together with its camera.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.images import image_size, is_reduction
from gsx.core.data.resize import Size
from gsx.core.shapes import UInt8
from gsx.lenses import Distortion
from gsx.scenes.exif import orientation_of

Remap = Callable[[UInt8[Tensor, "C H W"]], UInt8[Tensor, "C h w"]]
ORIENTATIONS: dict[int, tuple[bool, tuple[int, ...]]] = {
    1: (False, ()), 2: (False, (-1,)), 3: (False, (-2, -1)), 4: (False, (-2,)),
    5: (True, ()), 6: (True, (-1,)), 7: (True, (-2, -1)), 8: (True, (-2,)),
}  # fmt: skip
"""EXIF 2.3, tag 0x0112: exchange rows and columns?, then which axes to flip, to bring a stored picture upright."""
INVERSES = {6: 8, 8: 6}  # the others undo themselves
MIRROR = 2  # exchanges left and right
ON_SIDE = 8  # lays upright pictures on their side
AFTER_MIRROR = {2: 1, 4: 3, 5: 8, 7: 6}  # turn upright, by orientation, once left and right are exchanged
WITHOUT_MIRROR = {2: 1, 4: 3, 5: 6, 7: 8}  # turn upright, by orientation, that leaves a picture mirrored
TURNS = (1, 3, 6, 8)  # orientations without a mirror, which no rigid camera makes


def oriented(image: UInt8[Tensor, "C H W"], orientation: int) -> UInt8[Tensor, "C h w"]:
    """Turn a stored picture of this EXIF orientation upright."""
    exchange, flips = ORIENTATIONS[orientation]
    return (image.transpose(1, 2) if exchange else image).flip(flips).contiguous()


def oriented_size(size: Size, orientation: int) -> Size:
    """Return (width, height) of a picture after `oriented`."""
    width, height = size
    return (height, width) if ORIENTATIONS[orientation][0] else size


def oriented_camera(camera: Camera, orientation: int) -> Camera:
    """Roll a camera about its viewing axis, as `oriented` turns its picture by one of `TURNS`."""
    if orientation == 1:
        return camera
    exchange, flips = ORIENTATIONS[orientation]
    right, down = (-1 if axis in flips else 1 for axis in (-1, -2))
    turn = torch.zeros(3, 3, dtype=camera.rotation.dtype)  # axes of the turned camera in the stored one's
    turn[0, int(exchange)], turn[1, int(not exchange)], turn[2, 2] = right, down, 1
    (width, height), lens = oriented_size(camera.size, orientation), camera.lens
    (fx, cx), (fy, cy) = ((camera.fx, camera.cx), (camera.fy, camera.cy))[:: -1 if exchange else 1]
    return replace(
        camera,
        rotation=turn @ camera.rotation,
        translation=turn @ camera.translation,
        fx=fx,
        fy=fy,
        cx=width - cx if right < 0 else cx,
        cy=height - cy if down < 0 else cy,
        width=width,
        height=height,
        lens=lens.turned(turn[:2, :2].flatten().tolist()) if isinstance(lens, Distortion) else lens,
    )


@dataclass(frozen=True, kw_only=True)
class Turns:
    """Turns of a stored photo to the raster of its camera, and from there upright."""

    exif: int = 1
    """Orientation in the file; 1 where EXIF is not used."""
    first: int = 1
    """Orientation that brings the stored photo to its camera's raster."""
    last: int = 1
    """Turn of that raster upright, one of `TURNS`."""

    def stored_size(self, size: Size) -> Size:
        """Return (width, height) of the stored photo of a camera with a raster of `size`."""
        return oriented_size(size, self.first)

    def around(self, remap: Remap | None, before: tuple[int, ...] = ()) -> Remap | None:
        """Return a remap that turns a stored picture, applies `remap` on its camera's raster, and turns it upright.

        `before`: orientations to apply beforehand.
        """
        first = tuple(one for one in (*before, self.first) if one != 1)
        return Turned(first, remap, self.last) if first or self.last != 1 else remap


@dataclass(frozen=True)
class Turned:
    """A remap that turns a picture, applies `remap`, and turns the result."""

    first: tuple[int, ...]
    remap: Remap | None
    last: int

    def __call__(self, image: UInt8[Tensor, "C H W"]) -> UInt8[Tensor, "C h w"]:
        for orientation in self.first:
            image = oriented(image, orientation)
        return oriented(image if self.remap is None else self.remap(image), self.last)


TurnsOf = Callable[[Path, Size], Turns]
"""Turns of a photo by its file and the (width, height) of its camera."""


def as_stored(photo: Path, raster: Size) -> Turns:
    """Return no turns: EXIF is not used."""
    return Turns()


def of_model(photo: Path, raster: Size) -> Turns:
    """Return the turns of a photo with another program's camera for a raster of this (width, height).

    That is the stored raster, unless only the turned one has its shape: some programs turn photos before use. Mirrored
    photos stay mirrored on the stored raster.
    """
    exif = orientation_of(photo)
    if exif == 1:  # as nearly all: the size need not be read
        return Turns()
    size = image_size(photo)
    if not is_reduction(size, raster) and is_reduction(oriented_size(size, exif), raster):
        return Turns(exif=exif, first=exif)
    return Turns(exif=exif, last=WITHOUT_MIRROR.get(exif, exif))


def of_turned_model(photo: Path, raster: Size) -> Turns:
    """Return the turns of a photo whose camera is that of the upright photo, of any shape."""
    exif = orientation_of(photo)
    return Turns(exif=exif, first=exif)


def of_own_model(photo: Path, raster: Size) -> Turns:
    """Return the turns of a photo for structure from motion by gsx.

    They undo mirrors, and lay photos on their side if a tool has turned them but not others of their lens.
    """
    exif, size = orientation_of(photo), image_size(photo)
    if exif == 1 and size != raster and size == oriented_size(raster, ON_SIDE):
        return Turns(first=ON_SIDE, last=INVERSES[ON_SIDE])
    return Turns(exif=exif, first=MIRROR if exif in AFTER_MIRROR else 1, last=AFTER_MIRROR.get(exif, exif))


RULES: dict[str, TurnsOf] = {"auto": of_model, "stored": as_stored, "turned": of_turned_model}
"""Turns of a photo by its file and the raster of its camera, by the values of `scene.orientation`."""
