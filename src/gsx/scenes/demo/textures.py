"""Procedural surface colours: functions of position on a solid with unfiltered detail at every scale down to a few
thousandths of a scene unit, so that zooming in always finds more.

Arguments `p` and `n` are positions (scene units) and normals in the solid's own axes; colours are display RGB. The
finest grain stays weak: training pictures cannot resolve it, and it would be noise in them.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float
from gsx.scenes.demo.font import Lettering, Line, typeset
from gsx.scenes.demo.noise import Noise, angle, blend, make_noise
from gsx.scenes.demo.solids import dot, smoothstep

GRAIN = 0.10  # relative contrast of mineral grain (brick, stone, clay): first octave
FIBRE = 0.16  # relative contrast of wood grain and bark: first octave
SPOTS = 0.30  # relative spread of shade between bricks, stones, planks or leaves
BRICK = (0.24, 0.085)  # length and height of a brick with its joint, scene units
JOINT = 0.007  # half the thickness of a mortar joint
RING = 0.21  # width of one ring of paving
PAVING_RADIUS = 2.35
LEAF_LAYERS = 4
LEAF_ROW = 0.17  # height of a row of leaves, radians of latitude
LEAF = (0.50, 0.21)  # half length and half width of a leaf, rows
HAZE = (5.0, 18.0)  # the lawn fades into the haze between these distances from the middle

HORIZON, ZENITH, CLOUD = (0.80, 0.87, 0.93), (0.36, 0.58, 0.88), (0.97, 0.97, 0.98)
LAWN = ((0.36, 0.47, 0.20), (0.46, 0.56, 0.27))
CHART = (
    Line("GSX", 0.190, 0.190), Line("SPLATS", 0.100, 0.015), Line("ZOOM IN HERE", 0.056, -0.087),
    Line("THIS ONE NEEDS X2", 0.036, -0.154), Line("AND THIS ONE NEEDS X4", 0.022, -0.202),
    Line("ONLY AT X8 CAN THE LAST LINE BE READ", 0.012, -0.237),
)  # fmt: skip
CRATE_LABEL = Line("GSX", 0.100, 0.085), Line("FRAGILE", 0.042, -0.020), Line("HANDLE WITH CARE", 0.019, -0.075)
TIN_LABEL = Line("TEA", 0.075, 0.025), Line("FINEST LEAVES", 0.0155, -0.040), Line("NET WEIGHT 250 G", 0.008, -0.065)

Vectors = Float[Tensor, "3 points"]
Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Kit:
    """Noise and lettering tables of all textures."""

    noise: Noise
    chart: Lettering
    crate_label: Lettering
    tin_label: Lettering


def make_kit(generator: torch.Generator) -> Kit:
    """Draw the noise and typeset the lettering."""
    return Kit(make_noise(generator), typeset(CHART), typeset(CRATE_LABEL), typeset(TIN_LABEL))


def rgb(colour: Colour) -> Float[Tensor, "3 1"]:
    """Return a colour that broadcasts over [3, points]."""
    return torch.tensor(colour)[:, None]


def plain(p: Vectors, n: Vectors, kit: Kit, colour: Colour) -> Vectors:
    """Draw one colour."""
    return rgb(colour).expand_as(p)


def between(a: Colour, b: Colour, weight: Tensor) -> Vectors:
    """Blend from colour `a` at weight 0 to `b` at weight 1."""
    return blend(rgb(a), rgb(b), weight)


def cover(under: Vectors, colour: Colour, weight: Tensor) -> Tensor:
    """Lay a colour over another with this opacity."""
    return blend(under, rgb(colour), weight.to(under))


def face_coordinates(p: Vectors, n: Vectors) -> tuple[Float[Tensor, "points"], Float[Tensor, "points"]]:
    """Return (u, v) on the face of a box from outside: u to the right, v up; on top and bottom x and y."""
    lid = n[2].abs()
    return n[0] * p[1] - n[1] * p[0] + lid * p[0], (1.0 - lid) * p[2] + lid * p[1]


def parity(x: Tensor) -> Tensor:
    """Return 0 for even, 1 for odd whole numbers, which are floats."""
    return x - 2.0 * (x * 0.5).floor()


def edge_distance(x: Tensor, size: float) -> Tensor:
    """Return the distance to the nearest multiple of 1, times `size`."""
    return (0.5 - (x - x.floor() - 0.5).abs()) * size


def mineral(kit: Kit, u: Tensor, v: Tensor, size: float) -> Tensor:
    """Return a brightness factor around 1: grain of five octaves from `size` down."""
    return 1.0 + GRAIN * kit.noise.grain(u / size, v / size, 5)


def bricks(p: Vectors, n: Vectors, kit: Kit) -> Vectors:
    """Draw bricks in running bond, pale mortar."""
    u, v = face_coordinates(p, n)
    row = (v / BRICK[1]).floor()
    along = u / BRICK[0] + 0.5 * parity(row)
    shade = kit.noise.at(along.floor() + 61.0, row + 17.0 * n[0])
    clay = between((0.53, 0.25, 0.18), (0.74, 0.44, 0.31), 0.5 + 0.5 * shade)
    grain = mineral(kit, u, v, 0.05)
    wobble = 0.003 * kit.noise.plane(u * 70.0, v * 70.0)
    edge = torch.minimum(edge_distance(along, BRICK[0]), edge_distance(v / BRICK[1], BRICK[1])) + wobble
    worn = clay * (0.82 + 0.18 * smoothstep((edge - JOINT) / 0.012))
    return blend(rgb((0.75, 0.72, 0.66)), worn, smoothstep((edge - JOINT) / 0.002 + 0.5)) * grain


def coping(p: Vectors, n: Vectors, kit: Kit) -> Vectors:
    """Draw sandstone slabs."""
    u, v = face_coordinates(p, n)
    stone = between((0.76, 0.69, 0.56), (0.86, 0.81, 0.70), 0.5 + 0.5 * kit.noise.plane(u * 3.0, v * 9.0))
    joint = smoothstep(edge_distance(u / 0.47 + 0.5, 0.47) / 0.005)
    return stone * mineral(kit, u, v, 0.06) * (0.6 + 0.4 * joint)


def wood(kit: Kit, along: Tensor, across: Tensor, plank: Tensor) -> Vectors:
    """Draw wood with fibres along one axis; `plank` makes every board another piece of timber."""
    bend = 0.012 * kit.noise.plane(along * 3.0 + 7.0 * plank, across * 5.0)
    fibre = kit.noise.grain(along * 5.0 + 31.0 * plank, (across + bend) * 75.0, 4)
    shade = 0.5 + 0.5 * kit.noise.at(plank, plank + 3.0)
    return between((0.60, 0.43, 0.25), (0.76, 0.58, 0.36), shade) * (1.0 + FIBRE * fibre)


def crate(p: Vectors, n: Vectors, kit: Kit, half: float) -> Vectors:
    """Draw upright planks in a frame of boards with nails, and a stencilled label on the planks of the four sides."""
    u, v = face_coordinates(p, n)
    side = 5.0 * n[0] + 11.0 * n[1] + 17.0 * n[2]
    rim = 0.72 * half
    flat, upright = v.abs() > rim, u.abs() > rim
    planks = u / (rim / 2.5) + 0.5
    boards = wood(kit, v, u, planks.floor() + side)
    boards = boards * (0.45 + 0.55 * smoothstep(edge_distance(planks, rim / 2.5) / 0.006)) * 0.93
    label = kit.crate_label.ink(u, v) & (n[2].abs() < 0.5)
    boards = cover(boards, (0.13, 0.14, 0.20), 0.85 * label)
    level, stile = wood(kit, u, v, v.sign() + side + 40.0), wood(kit, v, u, u.sign() + side + 50.0)
    frame = torch.where(flat, level, stile) * nails(u.abs() - 0.86 * half, v.abs() - 0.86 * half)
    inset = torch.minimum((u.abs() - rim).abs(), (v.abs() - rim).abs())
    edge = 0.55 + 0.45 * smoothstep(inset / 0.008)
    return torch.where(flat | upright, frame, boards) * torch.where(flat & upright, 1.0, edge)


def nails(u: Tensor, v: Tensor) -> Tensor:
    """Return a brightness factor: dark heads of four nails around the origin."""
    u, v = u.abs() - 0.018, v.abs() - 0.018
    return 0.35 + 0.65 * smoothstep(((u * u + v * v).sqrt() - 0.005) / 0.0015)


def sign(p: Vectors, n: Vectors, kit: Kit, half: tuple[float, float]) -> Tensor:
    """Draw an enamelled reading chart on both faces of a board, with a blue rim and screws."""
    u, v = face_coordinates(p, n)
    inset = torch.minimum(half[0] - u.abs(), half[1] - v.abs())
    enamel = rgb((0.95, 0.94, 0.89)) * (1.0 + 0.25 * GRAIN * kit.noise.grain(u * 25.0, v * 25.0, 4))
    enamel = cover(enamel, (0.12, 0.15, 0.24), kit.chart.ink(u, v))
    blue = (inset < 0.012) | ((inset > 0.022) & (inset < 0.026)) | (n[1].abs() < 0.5)
    panel = cover(enamel, (0.13, 0.29, 0.55), blue)
    screw_u, screw_v = u.abs() - half[0] + 0.045, v.abs() - half[1] + 0.045
    from_screw = (screw_u * screw_u + screw_v * screw_v).sqrt()
    head = cover(panel, (0.62, 0.63, 0.66), from_screw < 0.012)
    return cover(head, (0.25, 0.25, 0.28), (from_screw < 0.010) & ((screw_u + screw_v).abs() < 0.003))


def post(p: Vectors, n: Vectors, kit: Kit) -> Vectors:
    """Draw a squared wooden post."""
    u, v = face_coordinates(p, n)
    return wood(kit, v, u, 2.0 * n[0] + 5.0 * n[1] + 90.0) * 0.8


def bark(p: Vectors, n: Vectors, kit: Kit) -> Vectors:
    """Draw ridged bark: noise stretched upwards."""
    ridges = kit.noise.grain(angle(p[1], p[0]) * 4.0 + 50.0, p[2] * 7.0, 5, 0.8)
    return between((0.25, 0.17, 0.11), (0.47, 0.36, 0.26), 0.5 + 0.6 * ridges)


def pot(p: Vectors, n: Vectors, kit: Kit, half_height: float) -> Tensor:
    """Draw terracotta with turning marks, a painted zigzag band, and soil on top."""
    around = angle(p[1], p[0]) * (14.0 / math.pi)
    clay = rgb((0.74, 0.41, 0.27)) * mineral(kit, around * 0.08, p[2], 0.05)
    clay = clay * (1.0 + 0.5 * FIBRE * kit.noise.plane(around * 0.4, p[2] * 110.0))
    zigzag = (edge_distance(around, 0.16) - 0.04 + p[2] - 0.02).abs()
    band = (zigzag < 0.013) | ((p[2] - 0.085).abs() < 0.006) | ((p[2] + 0.050).abs() < 0.006)
    clay = cover(clay, (0.93, 0.88, 0.76), band)
    lip = 0.7 + 0.3 * smoothstep((p[2] - half_height + 0.055).abs() / 0.006)
    soil = rgb((0.24, 0.17, 0.12)) * (1.0 + 0.35 * kit.noise.grain(p[0] * 40.0, p[1] * 40.0, 4))
    inside = (n[2] > 0.5) & (p[0] * p[0] + p[1] * p[1] < 0.20 * 0.20)
    return torch.where(inside, soil, clay * lip)


def tin(p: Vectors, n: Vectors, kit: Kit, radius: float) -> Tensor:
    """Draw a tea tin: green label with lettering on two sides, metal rims and lid."""
    around = angle(p[1], p[0]) * radius
    quarter = radius * math.pi / 2
    u = around - 2.0 * quarter * (around / (2.0 * quarter) + 0.5).floor()  # within [-quarter, quarter)
    green = rgb((0.12, 0.36, 0.27)) * (1.0 + 0.06 * kit.noise.grain(around * 60.0, p[2] * 60.0, 4))
    lettered = cover(green, (0.94, 0.88, 0.66), kit.tin_label.ink(u, p[2]))
    stripe = ((p[2].abs() - 0.092).abs() < 0.003) | ((u.abs() - 0.97 * quarter).abs() < 0.002)
    label = cover(lettered, (0.85, 0.70, 0.32), stripe)
    brushed = kit.noise.grain((p[0] * p[0] + p[1] * p[1]).sqrt() * 160.0, around * 5.0, 3)
    metal = rgb((0.70, 0.71, 0.73)) * (1.0 + 0.05 * brushed)
    return torch.where((p[2].abs() > 0.105) | (n[2].abs() > 0.5), metal, label)


def foliage(p: Vectors, n: Vectors, kit: Kit) -> Vectors:
    """Draw layers of leaves over dark green, the outermost last."""
    longitude, latitude = angle(n[1], n[0]), angle(n[2], (n[0] * n[0] + n[1] * n[1]).sqrt())
    colour = rgb((0.09, 0.16, 0.06)) * (1.0 + 0.2 * kit.noise.plane(longitude * 20.0, latitude * 20.0))
    for layer in range(LEAF_LAYERS):
        depth = 0.62 + 0.38 * layer / (LEAF_LAYERS - 1)
        leaf, shade = leaf_layer(longitude, latitude, float(layer), kit)
        colour = torch.where(leaf, shade * depth, colour)
    return colour


def leaf_layer(longitude: Tensor, latitude: Tensor, layer: float, kit: Kit) -> tuple[Bool[Tensor, "points"], Vectors]:
    """Place one turned leaf in each cell of rows along the parallels; returns where leaves are, and their colour."""
    height = latitude / LEAF_ROW + 0.37 * layer
    row = height.floor()
    middle = (row + 0.5 - 0.37 * layer) * LEAF_ROW
    count = (2.0 * math.pi / LEAF_ROW * cosine(middle)).floor().clamp(min=3.0)
    around = (longitude / (2.0 * math.pi) + 0.5 + 0.5 * kit.noise.at(row, row + 7.0 * layer)) * count
    number = around.floor() - count * (around / count).floor()
    u, v = around - around.floor() - 0.5, height - row - 0.5
    c, s = kit.noise.at(number, row + 90.0 * layer), kit.noise.at(number + 100.0, row + 90.0 * layer)
    length = (c * c + s * s).sqrt().clamp(min=1e-3)
    along, across = (u * c + v * s) / length, (v * c - u * s) / length
    hue = 0.5 + 0.5 * kit.noise.at(number + 50.0, row + 20.0 * layer)
    return leaf_shape(along, across), leaf_colour(along, across, hue)


def leaf_shape(along: Tensor, across: Tensor) -> Bool[Tensor, "points"]:
    """Return which leaf coordinates lie within the outline, pointed at both ends."""
    x = (along / LEAF[0]).clamp(-1.0, 1.0)
    return across.abs() < LEAF[1] * (1.0 - x * x) * (1.15 - 0.3 * x)


def leaf_colour(along: Tensor, across: Tensor, hue: Tensor) -> Vectors:
    """Draw two halves of different brightness, a pale rib, and side veins."""
    green = between((0.20, 0.37, 0.11), (0.47, 0.60, 0.24), hue)
    fold = 1.0 + 0.12 * across.sign()
    vein = smoothstep(edge_distance((along - 0.8 * across.abs()) * 11.0, 0.09) / 0.012)
    rib = smoothstep((across.abs() - 0.008) / 0.012)
    return green * (fold * (0.86 + 0.14 * vein)) * (1.25 - 0.25 * rib)


def cosine(x: Tensor) -> Tensor:
    """Return cos x for |x| <= pi/2 within 1e-3, by its Taylor series: the same bits on every machine."""
    square = x * x
    return 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0)))


def beach_ball(p: Vectors, n: Vectors, kit: Kit) -> Vectors:
    """Draw six coloured gores with white seams and caps, and a fine weave."""
    tilted = torch.stack([n[0], 0.8 * n[1] - 0.6 * n[2], 0.6 * n[1] + 0.8 * n[2]])
    turn = angle(tilted[1], tilted[0]) * (3.0 / math.pi) + 3.0
    gore = turn.floor()
    warm = torch.where(parity(gore) > 0.5, rgb((0.93, 0.92, 0.88)), rgb((0.86, 0.22, 0.18)))
    blue = (gore == 2.0) | (gore == 5.0)
    colour = torch.where(blue, rgb((0.15, 0.36, 0.68)), warm)
    ring = (1.0 - tilted[2] * tilted[2]).clamp(min=0.0).sqrt()
    seam = (edge_distance(turn, 1.0) * ring < 0.02) | (ring < 0.24)
    colour = cover(colour, (0.96, 0.95, 0.92), seam)
    weave = edge_distance(tilted[0] * 45.0, 1.0) + edge_distance(tilted[2] * 45.0, 1.0)
    return cover(colour * (0.94 + 0.12 * weave), (0.86, 0.22, 0.18), (ring < 0.215) & (ring > 0.17))


def marble(p: Vectors, n: Vectors, kit: Kit) -> Vectors:
    """Draw pale stone with veins of several sizes through the solid."""
    cloud = kit.noise.solid(p * 6.0) + 0.5 * kit.noise.solid(p * 13.0) + 0.25 * kit.noise.solid(p * 29.0)
    fine = kit.noise.solid(p * 31.0) + 0.5 * kit.noise.solid(p * 67.0) + 0.25 * kit.noise.solid(p * 150.0)
    stone = between((0.93, 0.91, 0.88), (0.80, 0.79, 0.80), 0.5 + 0.5 * cloud)
    stone = cover(stone, (0.35, 0.38, 0.42), 0.7 * (1.0 - smoothstep(cloud.abs() / 0.10)))
    return cover(stone, (0.62, 0.50, 0.38), 0.5 * (1.0 - smoothstep(fine.abs() / 0.10)))


def paving(p: Vectors, kit: Kit) -> Vectors:
    """Draw rings of granite setts around the middle."""
    radius = (p[0] * p[0] + p[1] * p[1]).sqrt()
    ring = (radius / RING).floor()
    count = (2.0 * math.pi * (ring + 0.5) / 1.45).floor().clamp(min=1.0)
    around = (angle(p[1], p[0]) / (2.0 * math.pi) + 0.5 + 0.37 * ring) * count
    number = around.floor() - count * (around / count).floor()
    shade = kit.noise.at(number, ring + 5.0)
    tint = kit.noise.at(number + 70.0, ring + 5.0)
    stone = between((0.60, 0.57, 0.53), (0.66, 0.58, 0.50), 0.5 + 0.5 * tint) * (1.0 + 0.5 * SPOTS * shade)
    wobble = 0.004 * kit.noise.plane(p[0] * 45.0, p[1] * 45.0)
    sides = edge_distance(around, 1.0) * (2.0 * math.pi * radius / count)
    edge = torch.minimum(edge_distance(radius / RING, RING), sides) + wobble
    joined = blend(rgb((0.44, 0.40, 0.34)), stone, smoothstep((edge - 0.008) / 0.008))
    return joined * mineral(kit, p[0], p[1], 0.09)


def lawn(p: Vectors, kit: Kit) -> Vectors:
    """Draw grass in soft patches with a fine grain that fades with distance, and haze farther out."""
    radius = (p[0] * p[0] + p[1] * p[1]).sqrt()
    patches = kit.noise.grain(p[0] * 0.9, p[1] * 0.9, 2)
    blades = kit.noise.grain(p[0] * 14.0, p[1] * 14.0, 4, 0.85)
    fade = 1.0 - smoothstep((radius - PAVING_RADIUS) / 5.0)
    grass = between(*LAWN, 0.5 + 0.25 * patches) * (1.0 + 0.10 * blades * fade)
    return cover(grass, HORIZON, smoothstep((radius - HAZE[0]) / (HAZE[1] - HAZE[0])))


def ground(p: Vectors, kit: Kit) -> Vectors:
    """Draw paving in the middle, lawn around it."""
    radius = (p[0] * p[0] + p[1] * p[1]).sqrt()
    paved = radius < PAVING_RADIUS
    colour = torch.empty_like(p)
    for mask, texture in ((paved, paving), (~paved, lawn)):
        chosen = mask.nonzero()[:, 0]
        if len(chosen):
            colour.index_copy_(1, chosen, texture(p.index_select(1, chosen), kit))
    return colour


def sky(d: Vectors, kit: Kit) -> Vectors:
    """Draw a smooth gradient with soft clouds, over unit directions from the middle of the scene."""
    height = d[2].clamp(min=0.0)
    blue = between(HORIZON, ZENITH, smoothstep(height * 1.1))
    stretched = torch.stack([d[0] * 3.0, d[1] * 3.0, d[2] * 8.0])
    puffs = kit.noise.solid(stretched) + 0.5 * kit.noise.solid(stretched * 2.1 + 9.0)
    weight = 0.6 * smoothstep(puffs * 1.2) * smoothstep(height * 8.0)
    return cover(blue, CLOUD, weight)


def specular(normals: Vectors, halfway: Vectors) -> Float[Tensor, "points"]:
    """Return Blinn's highlight with exponent 64, by repeated squaring."""
    shine = dot(normals, halfway).clamp(min=0.0)
    for _ in range(6):
        shine = shine * shine
    return shine
