"""Convex solids hit by rays in closed form.

Only correctly rounded operations are used (+, -, x, /, square root, comparisons), one per tensor call and never a
reduction, so a ray gives the same bits wherever it stands in a batch: a crop of a picture is the picture of the crop.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Float

FLAT = 1e-12  # a direction component nearer to 0 counts as this, so that a slab is never entered by 0/0
CLOSE = 0.05  # box corners at this camera depth or nearer leave the window of a solid unbounded, in scene units


def dot(a: Float[Tensor, "3 *#rays"], b: Float[Tensor, "3 *#rays"]) -> Float[Tensor, "*#rays"]:
    """Return the scalar product over the first axis, summed in a fixed order."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def normalise(vectors: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
    """Scale vectors to length 1; zero vectors become NaN."""
    return vectors / dot(vectors, vectors).sqrt()


def smoothstep(x: Tensor) -> Tensor:
    """Return 0 below 0, 1 above 1, the cubic 3x^2 - 2x^3 between."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


Interval = tuple[Tensor, Tensor]
"""Ray parameters (enter, leave); enter > leave or NaN: missed."""


def slab_interval(origin: Tensor, direction: Tensor) -> Interval:
    """Return where |coordinate| <= 1 along one axis."""
    direction = torch.where(direction.abs() < FLAT, FLAT, direction)
    one, other = (-1.0 - origin) / direction, (1.0 - origin) / direction
    return torch.minimum(one, other), torch.maximum(one, other)


def round_interval(across: list[tuple[Tensor, Tensor]]) -> Interval:
    """Intersect the unit ball in these (origin, direction) components: two make a tube, three a sphere.

    It is measured from the point of closest approach, which stays accurate far from the solid.
    """
    speed = sum_of([d * d for _, d in across]).clamp(min=FLAT)
    closest = -sum_of([o * d for o, d in across]) / speed
    miss = sum_of([(o + closest * d) * (o + closest * d) for o, d in across])
    half_chord = ((1.0 - miss) / speed).sqrt()
    return closest - half_chord, closest + half_chord


def sum_of(terms: list[Tensor]) -> Tensor:
    """Return the sum, from left to right."""
    return reduce(torch.add, terms)


SPHERE, CYLINDER, BOX = 3, 2, 0
"""Shapes by the number of axes, from x on, about which they are round; along the others they have flat faces."""


def shape_interval(origins: Float[Tensor, "3 *#rays"], directions: Float[Tensor, "3 *#rays"], shape: int) -> Interval:
    """Intersect a shape of half sizes 1."""
    rays = list(zip(origins, directions, strict=True))
    parts = [round_interval(rays[:shape])] if shape else []
    parts += [slab_interval(*ray) for ray in rays[shape:]]
    enter, leave = zip(*parts, strict=True)
    return reduce(torch.maximum, enter), reduce(torch.minimum, leave)


def shape_distance(points: Float[Tensor, "3 *rays"], half: Float[Tensor, "3"], shape: int) -> Float[Tensor, "*rays"]:
    """Return the signed distance to a shape of these half sizes."""
    beyond = [sum_of([axis * axis for axis in points[:shape]]).sqrt() - half[0]] if shape else []
    beyond += [points[axis].abs() - half[axis] for axis in range(shape, 3)]
    outside = sum_of([one.clamp(min=0.0) * one.clamp(min=0.0) for one in beyond]).sqrt()
    return outside + reduce(torch.maximum, beyond).clamp(max=0.0)


def shape_normal(unit: Float[Tensor, "3 *rays"], shape: int) -> Float[Tensor, "3 *rays"]:
    """Return the outward normal at points of a shape of half sizes 1.

    A box has that of its nearest plane, a cylinder that of a lid where |z| is beyond the radius, else of its side.
    """
    if shape == SPHERE:
        return normalise(unit)
    size, sign = unit.abs(), unit.sign()
    if shape == BOX:
        x_face = (size[0] >= size[1]) & (size[0] >= size[2])
        y_face = ~x_face & (size[1] >= size[2])
        return torch.stack([x_face, y_face, ~(x_face | y_face)]) * sign
    radius = (unit[0] * unit[0] + unit[1] * unit[1]).sqrt()
    lid, safe = size[2] >= radius, radius.clamp(min=FLAT)
    return torch.stack([~lid * unit[0] / safe, ~lid * unit[1] / safe, lid * sign[2]])


def column(values: Float[Tensor, "3"], like: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *ones"]:
    """Shape three numbers so that they broadcast over a tensor of vectors."""
    return values.to(like).reshape(3, *[1] * (like.dim() - 1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Solid:
    """A shape standing in the world, turned about the vertical axis."""

    name: str
    shape: int
    """SPHERE, CYLINDER or BOX."""
    centre: Float[Tensor, "3"]
    """World coordinates, float64."""
    half: Float[Tensor, "3"]
    """Half sizes of the bounding box in the solid's own axes, scene units."""
    yaw: float = 0.0
    """Anticlockwise turn about the vertical axis, radians."""

    @property
    def reach(self) -> float:
        """Return the radius of the bounding sphere."""
        return float(self.half.norm())

    def local_direction(self, directions: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
        """Rotate world directions to the solid's own axes."""
        if self.yaw == 0.0:
            return directions
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        x, y, z = directions
        return torch.stack([c * x + s * y, c * y - s * x, z])

    def local(self, points: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
        """Transform world points to the solid's own coordinates."""
        return self.local_direction(points - column(self.centre, points))

    def world_direction(self, directions: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
        """Rotate directions from the solid's own axes to the world's."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        x, y, z = directions
        return torch.stack([c * x - s * y, s * x + c * y, z])

    def interval(self, origins: Float[Tensor, "3 *#rays"], directions: Float[Tensor, "3 *#rays"]) -> Interval:
        """Return ray parameters at which rays enter and leave the solid; enter > leave or NaN where they miss."""
        half = column(self.half, directions)
        return shape_interval(self.local(origins) / half, self.local_direction(directions) / half, self.shape)

    def distance(self, points: Float[Tensor, "3 *rays"]) -> Float[Tensor, "*rays"]:
        """Return the signed distance of world points, negative inside, scene units."""
        return shape_distance(self.local(points), self.half.to(points), self.shape)

    def normal(self, local_points: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
        """Return the outward normal, in the solid's own axes, at points of its surface in own coordinates."""
        return shape_normal(local_points / column(self.half, local_points), self.shape)

    def corners(self) -> Float[Tensor, "8 3"]:
        """Return the corners of the bounding box, world coordinates."""
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3).T
        return (self.world_direction(signs * self.half[:, None]) + self.centre[:, None]).T


def window(solid: Solid, camera: Camera) -> tuple[slice, slice] | None:
    """Return the rows and columns of the raster outside which no ray can hit the solid; None: it is out of view."""
    pixels, depths = camera.project(solid.corners())
    whole = slice(0, camera.height), slice(0, camera.width)
    if camera.lens is not None or float(depths.min()) <= CLOSE:  # a lens bends the box's edges outwards
        return whole
    (left, top), (right, bottom) = pixels.min(0).values.tolist(), pixels.max(0).values.tolist()
    rows = slice(max(0, math.floor(top) - 1), min(camera.height, math.ceil(bottom) + 1))
    columns = slice(max(0, math.floor(left) - 1), min(camera.width, math.ceil(right) + 1))
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


def box(name: str, centre: tuple[float, float, float], size: tuple[float, float, float], yaw: float = 0.0) -> Solid:
    """Return a box of these full sizes, turned by `yaw` degrees."""
    return Solid(name=name, shape=BOX, centre=double(centre), half=double(size) / 2, yaw=math.radians(yaw))


def sphere(name: str, centre: tuple[float, float, float], radius: float, yaw: float = 0.0) -> Solid:
    """Return a ball, turned by `yaw` degrees."""
    return Solid(name=name, shape=SPHERE, centre=double(centre), half=double([radius] * 3), yaw=math.radians(yaw))


def cylinder(name: str, centre: tuple[float, float, float], radius: float, height: float, yaw: float = 0.0) -> Solid:
    """Return an upright cylinder, turned by `yaw` degrees."""
    half = double([radius, radius, height / 2])
    return Solid(name=name, shape=CYLINDER, centre=double(centre), half=half, yaw=math.radians(yaw))


def double(values: tuple[float, ...] | list[float]) -> Tensor:
    """Return a float64 tensor."""
    return torch.tensor(values, dtype=torch.float64)


def neighbours(solid: Solid, others: Sequence[Solid], gap: float) -> tuple[Solid, ...]:
    """Return the other solids whose bounding sphere comes within `gap` of this one's."""
    apart = [float((other.centre - solid.centre).norm()) - other.reach - solid.reach for other in others]
    return tuple(other for other, gap_to in zip(others, apart, strict=True) if other is not solid and gap_to < gap)
