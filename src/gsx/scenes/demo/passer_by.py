"""Somebody who walks through the built-in scenes while they are photographed: in each training photograph elsewhere.

Their truth is known: test pictures show nobody (research on what moves; docs/explanation/photo-corrections.md).
"""

from functools import partial

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float
from gsx.scenes.demo.solids import Solid, cylinder, sphere
from gsx.scenes.demo.still_life import StillLife, Texture, arranged
from gsx.scenes.demo.textures import plain
from gsx.scenes.demo.tracing import Rays, trace

AHEAD = (1.2, 2.0)
"""How far before the camera somebody stands, along the ground, scene units (about metres), where nothing is nearer."""
LEEWAY, LEAST = 0.4, 0.5
"""How far they stay from what is behind them, and at least from the camera, scene units."""
ASIDE = 0.45
"""How far beside the middle of the picture, at most, as a share of that."""
SKIN, HAIR, COAT, TROUSERS = (0.80, 0.62, 0.52), (0.25, 0.17, 0.12), (0.70, 0.16, 0.14), (0.16, 0.19, 0.30)


def person_at(x: float, y: float, floor: float) -> list[tuple[Solid, Texture, float]]:
    """Trousers, coat, head and hair of somebody who stands on the floor."""
    return [
        (cylinder("trousers", (x, y, floor + 0.40), 0.13, 0.80), partial(plain, colour=TROUSERS), 0.0),
        (cylinder("coat", (x, y, floor + 1.10), 0.20, 0.62), partial(plain, colour=COAT), 0.0),
        (sphere("head", (x, y, floor + 1.54), 0.13), partial(plain, colour=SKIN), 0.0),
        (sphere("hair", (x, y, floor + 1.59), 0.125), partial(plain, colour=HAIR), 0.0),
    ]


def with_passer_by(life: StillLife, camera: Camera, name: str, floor: float) -> StillLife:
    """The arrangement with somebody before the camera of the photograph of that name, with their shadow."""
    x, y = place_of(life, camera, name).tolist()
    known = [(thing.solid, thing.texture, thing.shine) for thing in life.things]
    return arranged([*known, *person_at(x, y, floor)], life.kit)


def place_of(life: StillLife, camera: Camera, name: str) -> Float[Tensor, "2"]:
    """Where on the ground they stand: the same in every run."""
    near, across = torch.rand(2, generator=torch.Generator().manual_seed(derived_seed("passer by", name))).tolist()
    forward, right = camera.rotation[2, :2].double(), camera.rotation[0, :2].double()
    way = forward / forward.norm() + ASIDE * (2 * across - 1) * right
    direction = torch.cat([way / way.norm(), torch.zeros(1, dtype=torch.float64)]).float()[:, None]
    free = float(trace(life, Rays(camera.centre.double(), direction)).depth) - LEEWAY
    ahead = min((AHEAD[0] + (AHEAD[1] - AHEAD[0]) * near) * float(way.norm()), free)
    return camera.centre[:2].double() + max(LEAST, ahead) * way / way.norm()
