"""Places of one view's pixels in another view, by the depth that a model renders (backward warp)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.masks import grown
from gsx.core.shapes import Bool, Float, Int
from gsx.modules.alignment import motion_to, sample_image

COVERED = 0.9
"""Least alpha of a pixel whose depth is used."""
AGREEMENT = 0.01
"""Largest relative difference of two depths of one surface."""
REACH = 2
"""Reach of bicubic interpolation, px."""
STRIP_PIXELS = 1 << 18
"""Pixels that are warped at once: geometry in float64 takes some 30 MB."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """Visible surface of the model in a camera."""

    camera: Camera
    depth: Float[Tensor, "H W"]
    """Mean camera z, scene units; 0 where `visible` is False."""
    visible: Bool[Tensor, "H W"]
    """Pixels with a depth that count."""

    @property
    def inner(self) -> Bool[Tensor, "H W"]:
        """Returns the pixels around which bicubic interpolation reads visible pixels alone."""
        return ~grown(~self.visible[None], REACH)[0]


def surface_of(
    camera: Camera,
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    counted: Bool[Tensor, "H W"] | None = None,
) -> Surface:
    """Returns the surface of a render; `depth`: blending-weighted sum of camera z, `counted`: None for all pixels."""
    visible = (alpha > COVERED) & (depth > camera.near * alpha)
    visible = visible if counted is None else visible & counted
    mean = torch.where(visible, depth / alpha.clamp_min(COVERED), 0)
    return Surface(camera=camera, depth=mean, visible=visible)


def places_in(source: Surface, target: Surface) -> tuple[Int[Tensor, "P"], Float[Tensor, "2 P"]]:
    """Returns the target's pixels (row-major indices) that the source shows, and their places there, px.

    A pixel is left out if its point lies behind the source, outside its raster, or behind what the source shows.
    """
    parts = list(strips(source, target))
    return torch.cat([indices for indices, _ in parts]), torch.cat([places for _, places in parts], 1)


def strips(source: Surface, target: Surface) -> Iterator[tuple[Int[Tensor, "P"], Float[Tensor, "2 P"]]]:
    """Yields the result of `places_in` for strips of rows."""
    motion, inner = motion_to(target.camera, source.camera), source.inner
    source = replace(source, depth=source.depth.double())
    rows = max(1, STRIP_PIXELS // target.camera.width)
    for top in range(0, target.camera.height, rows):
        indices = target.visible[top : top + rows].flatten().nonzero()[:, 0] + top * target.camera.width
        places, depths = project(source.camera, motion.apply(points_of(target, indices)))
        kept = shows(source, inner, places, depths)
        yield indices[kept], places[:, kept]


def points_of(surface: Surface, indices: Int[Tensor, "P"]) -> Float[Tensor, "3 P"]:
    """Returns the points of pixels in the camera's frame, float64."""
    camera = surface.camera
    depths = surface.depth.flatten()[indices].double()
    column, row = (indices % camera.width).double(), (indices // camera.width).double()
    across, down = camera.slopes(torch.stack([column, row], 1) + 0.5).T
    return torch.stack([across * depths, down * depths, depths])


def project(camera: Camera, points: Float[Tensor, "3 P"]) -> tuple[Float[Tensor, "2 P"], Float[Tensor, "P"]]:
    """Returns places, px, and depths of points in a camera's frame; places before its near plane are far outside."""
    x, y, z = points
    deep = z.clamp_min(camera.near)
    if camera.lens is not None:
        x, y = deep * camera.lens.bend(points.T).nan_to_num(-1e9).T
    places = torch.stack([camera.fx * x / deep + camera.cx, camera.fy * y / deep + camera.cy])
    return torch.where(z > camera.near, places, -1e9), z


def shows(
    source: Surface, inner: Bool[Tensor, "H W"], places: Float[Tensor, "2 P"], depths: Float[Tensor, "P"]
) -> Bool[Tensor, "P"]:
    """Marks points that a surface shows: inside its raster, not near a hole, and at its own depth."""
    width, height = source.camera.size
    column, row = places.floor().long()
    inside = (column >= REACH) & (column < width - REACH) & (row >= REACH) & (row < height - REACH)
    column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    own = sample_image(source.depth[None], places, "bilinear")[0]
    return inside & inner[row, column] & ((depths - own).abs() < AGREEMENT * depths)


def warped(picture: Float[Tensor, "3 H W"], places: Float[Tensor, "2 P"]) -> Float[Tensor, "3 P"]:
    """Returns a picture's colours at places, px, by bicubic interpolation in float64."""
    return sample_image(picture.double(), places)
