"""Pictures, sizes and cameras turned as EXIF's orientations say."""

from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.resize import Size
from gsx.core.shapes import UInt8

ORIENTATIONS: dict[int, tuple[bool, tuple[int, ...]]] = {
    1: (False, ()),
    2: (False, (-1,)),
    3: (False, (-2, -1)),
    4: (False, (-2,)),
    5: (True, ()),
    6: (True, (-1,)),
    7: (True, (-2, -1)),
    8: (True, (-2,)),
}
"""EXIF 2.3, tag 0x0112: exchange rows and columns?, then which axes to flip, to bring a stored picture upright."""
INVERSES = {6: 8, 8: 6}
"""Orientations that undo others; those missing undo themselves."""
MIRROR = 2
"""The orientation that exchanges left and right."""
AFTER_MIRROR = {2: 1, 4: 3, 5: 8, 7: 6}
"""Turn that brings a picture of these orientations upright once left and right are exchanged."""
WITHOUT_MIRROR = {2: 1, 4: 3, 5: 6, 7: 8}
"""Turn after which a picture of these orientations is upright, but mirrored still."""

TURNS = {
    1: ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    3: ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    6: ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    8: ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
}
"""Axes of the turned camera in the stored one's, by orientation; no rigid camera sees a mirror image."""


def oriented(image: UInt8[Tensor, "C H W"], orientation: int) -> UInt8[Tensor, "C h w"]:
    """Return a stored picture of this EXIF orientation upright."""
    exchange, flips = ORIENTATIONS[orientation]
    return (image.transpose(1, 2) if exchange else image).flip(flips).contiguous()


def oriented_size(size: Size, orientation: int) -> Size:
    """Return (width, height) of a picture that `oriented` has turned."""
    width, height = size
    return (height, width) if ORIENTATIONS[orientation][0] else size


def oriented_camera(camera: Camera, orientation: int) -> Camera:
    """Return the camera of a picture that `oriented` has turned by one of `TURNS`: rolled about its viewing axis."""
    if orientation == 1:
        return camera
    turn = torch.tensor(TURNS[orientation], dtype=camera.rotation.dtype)
    width, height = oriented_size(camera.size, orientation)
    exchange = ORIENTATIONS[orientation][0]
    (fx, cx), (fy, cy) = ((camera.fx, camera.cx), (camera.fy, camera.cy))[:: -1 if exchange else 1]
    return replace(
        camera,
        rotation=turn @ camera.rotation,
        translation=turn @ camera.translation,
        fx=fx,
        fy=fy,
        cx=width - cx if sum(TURNS[orientation][0]) < 0 else cx,
        cy=height - cy if sum(TURNS[orientation][1]) < 0 else cy,
        width=width,
        height=height,
    )
