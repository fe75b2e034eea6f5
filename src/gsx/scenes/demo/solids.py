"""Convex solids hit by rays in closed form.

Only correctly rounded operations are used (+, -, x, /, square root, comparisons), one per tensor call and never a
reduction, so a ray gives the same bits wherever it stands in a batch: a crop of a picture is the picture of the crop.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Float

FLAT = 1e-12  # a direction component nearer to 0 counts as this, so that a slab is never entered by 0/0
CLOSE = 0.05  # box corners at this camera depth or nearer leave the window of a solid unbounded, in scene units


def dot(a: Float[Tensor, "3 *#rays"], b: Float[Tensor, "3 *#rays"]) -> Float[Tensor, "*#rays"]:
    """Scalar product over the first axis, summed in a fixed order."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def normalise(vectors: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
    """Vectors of length 1; zero vectors become NaN."""
    return vectors / dot(vectors, vectors).sqrt()


def smoothstep(x: Tensor) -> Tensor:
    """0 below 0, 1 above 1, the cubic 3x^2 - 2x^3 between."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


Interval = tuple[Tensor, Tensor]
"""Ray parameters (enter, leave); enter > leave or NaN: missed."""


def slab_interval(origin: Tensor, direction: Tensor) -> Interval:
    """Where |coordinate| <= 1 along one axis."""
    direction = torch.where(direction.abs() < FLAT, FLAT, direction)
    one, other = (-1.0 - origin) / direction, (1.0 - origin) / direction
    return torch.minimum(one, other), torch.maximum(one, other)


def box_interval(origins: Float[Tensor, "3 *#rays"], directions: Float[Tensor, "3 *#rays"]) -> Interval:
    """The cube [-1, 1]^3."""
    enter, leave = slab_interval(origins, directions)
    first = torch.maximum(torch.maximum(enter[0], enter[1]), enter[2])
    return first, torch.minimum(torch.minimum(leave[0], leave[1]), leave[2])


def round_interval(across: list[tuple[Tensor, Tensor]]) -> Interval:
    """The unit ball of the given (origin, direction) components: two of them make a tube, three a sphere.

    Measured from the point of closest approach, which keeps its accuracy far from the solid.
    """
    speed = sum_of([d * d for _, d in across]).clamp(min=FLAT)
    closest = -sum_of([o * d for o, d in across]) / speed
    miss = sum_of([(o + closest * d) * (o + closest * d) for o, d in across])
    half_chord = ((1.0 - miss) / speed).sqrt()
    return closest - half_chord, closest + half_chord


def sum_of(terms: list[Tensor]) -> Tensor:
    """The sum, from left to right."""
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def sphere_interval(origins: Float[Tensor, "3 *#rays"], directions: Float[Tensor, "3 *#rays"]) -> Interval:
    """The unit sphere."""
    return round_interval([(origins[axis], directions[axis]) for axis in range(3)])


def cylinder_interval(origins: Float[Tensor, "3 *#rays"], directions: Float[Tensor, "3 *#rays"]) -> Interval:
    """x^2 + y^2 <= 1 and |z| <= 1."""
    enter, leave = round_interval([(origins[axis], directions[axis]) for axis in range(2)])
    bottom, top = slab_interval(origins[2], directions[2])
    return torch.maximum(enter, bottom), torch.minimum(leave, top)


def sphere_distance(points: Float[Tensor, "3 *rays"], half: Float[Tensor, "3"]) -> Float[Tensor, "*rays"]:
    """Signed distance to a ball of radius half[0]."""
    return dot(points, points).sqrt() - half[0]


def box_distance(points: Float[Tensor, "3 *rays"], half: Float[Tensor, "3"]) -> Float[Tensor, "*rays"]:
    """Signed distance to a box of the given half sizes."""
    beyond = points.abs() - column(half, points)
    outside = beyond.clamp(min=0.0)
    inside = torch.maximum(torch.maximum(beyond[0], beyond[1]), beyond[2]).clamp(max=0.0)
    return dot(outside, outside).sqrt() + inside


def cylinder_distance(points: Float[Tensor, "3 *rays"], half: Float[Tensor, "3"]) -> Float[Tensor, "*rays"]:
    """Signed distance to an upright cylinder of radius half[0] and half height half[2]."""
    side = (points[0] * points[0] + points[1] * points[1]).sqrt() - half[0]
    lid = points[2].abs() - half[2]
    outer_side, outer_lid = side.clamp(min=0.0), lid.clamp(min=0.0)
    return (outer_side * outer_side + outer_lid * outer_lid).sqrt() + torch.maximum(side, lid).clamp(max=0.0)


def sphere_normal(unit: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
    """Outward normal at points of the unit sphere."""
    return normalise(unit)


def box_normal(unit: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
    """Outward normal of the face whose plane is nearest, on the cube [-1, 1]^3."""
    size = unit.abs()
    x_face = (size[0] >= size[1]) & (size[0] >= size[2])
    y_face = ~x_face & (size[1] >= size[2])
    return torch.stack([x_face, y_face, ~(x_face | y_face)]) * unit.sign()


def cylinder_normal(unit: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
    """Outward normal on the unit cylinder: a lid where |z| is beyond the radius, the side elsewhere."""
    radius = (unit[0] * unit[0] + unit[1] * unit[1]).sqrt()
    lid = unit[2].abs() >= radius
    safe = radius.clamp(min=FLAT)
    return torch.stack([~lid * unit[0] / safe, ~lid * unit[1] / safe, lid * unit[2].sign()])


@dataclass(frozen=True)
class Shape:
    """What is known of a solid in its own coordinates; `interval` and `normal` take them divided by the half sizes."""

    interval: Callable[[Tensor, Tensor], Interval]
    distance: Callable[[Tensor, Tensor], Tensor]
    normal: Callable[[Tensor], Tensor]


SPHERE = Shape(sphere_interval, sphere_distance, sphere_normal)
BOX = Shape(box_interval, box_distance, box_normal)
CYLINDER = Shape(cylinder_interval, cylinder_distance, cylinder_normal)


def column(values: Float[Tensor, "3"], like: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *ones"]:
    """Three numbers shaped to meet a tensor of vectors."""
    return values.to(like).reshape(3, *[1] * (like.dim() - 1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Solid:
    """A shape standing in the world, turned about the vertical axis."""

    name: str
    shape: Shape
    centre: Float[Tensor, "3"]
    """World coordinates, float64."""
    half: Float[Tensor, "3"]
    """Half sizes of the bounding box in the solid's own axes, scene units."""
    yaw: float = 0.0
    """Anticlockwise turn seen from above, radians."""

    @property
    def reach(self) -> float:
        """Radius of the bounding sphere."""
        return float(self.half.norm())

    def local_direction(self, directions: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
        """World directions along the solid's own axes."""
        if self.yaw == 0.0:
            return directions
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        x, y, z = directions
        return torch.stack([c * x + s * y, c * y - s * x, z])

    def local(self, points: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
        """World points in the solid's own coordinates."""
        return self.local_direction(points - column(self.centre, points))

    def world_direction(self, directions: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
        """Own directions in world axes."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        x, y, z = directions
        return torch.stack([c * x - s * y, s * x + c * y, z])

    def interval(self, origins: Float[Tensor, "3 *#rays"], directions: Float[Tensor, "3 *#rays"]) -> Interval:
        """Ray parameters where the ray enters and leaves the solid; enter > leave or NaN where it misses."""
        half = column(self.half, directions)
        return self.shape.interval(self.local(origins) / half, self.local_direction(directions) / half)

    def distance(self, points: Float[Tensor, "3 *rays"]) -> Float[Tensor, "*rays"]:
        """Signed distance of world points, negative inside, scene units."""
        return self.shape.distance(self.local(points), self.half.to(points))

    def normal(self, local_points: Float[Tensor, "3 *rays"]) -> Float[Tensor, "3 *rays"]:
        """Outward normal in the solid's own axes at points (own coordinates) of its surface."""
        return self.shape.normal(local_points / column(self.half, local_points))

    def corners(self) -> Float[Tensor, "8 3"]:
        """Corners of the bounding box, world coordinates."""
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3).T
        return (self.world_direction(signs * self.half[:, None]) + self.centre[:, None]).T


def window(solid: Solid, camera: Camera) -> tuple[slice, slice] | None:
    """Rows and columns of the raster outside which no ray can hit the solid; None: it is out of the picture."""
    pixels, depths = camera.project(solid.corners())
    whole = slice(0, camera.height), slice(0, camera.width)
    if float(depths.min()) <= CLOSE:
        return whole
    (left, top), (right, bottom) = pixels.min(0).values.tolist(), pixels.max(0).values.tolist()
    rows = slice(max(0, math.floor(top) - 1), min(camera.height, math.ceil(bottom) + 1))
    columns = slice(max(0, math.floor(left) - 1), min(camera.width, math.ceil(right) + 1))
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


def box(name: str, centre: tuple[float, float, float], size: tuple[float, float, float], yaw: float = 0.0) -> Solid:
    """A box of the given full sizes, turned by `yaw` degrees."""
    return Solid(name=name, shape=BOX, centre=double(centre), half=double(size) / 2, yaw=math.radians(yaw))


def sphere(name: str, centre: tuple[float, float, float], radius: float, yaw: float = 0.0) -> Solid:
    """A ball, turned by `yaw` degrees."""
    return Solid(name=name, shape=SPHERE, centre=double(centre), half=double([radius] * 3), yaw=math.radians(yaw))


def cylinder(name: str, centre: tuple[float, float, float], radius: float, height: float, yaw: float = 0.0) -> Solid:
    """An upright cylinder, turned by `yaw` degrees."""
    half = double([radius, radius, height / 2])
    return Solid(name=name, shape=CYLINDER, centre=double(centre), half=half, yaw=math.radians(yaw))


def double(values: tuple[float, ...] | list[float]) -> Tensor:
    """A float64 tensor."""
    return torch.tensor(values, dtype=torch.float64)


def neighbours(solid: Solid, others: list[Solid], gap: float) -> Iterator[Solid]:
    """The other solids whose bounding sphere comes within `gap` of this one's."""
    for other in others:
        apart = float((other.centre - solid.centre).norm()) - other.reach - solid.reach
        if other is not solid and apart < gap:
            yield other
