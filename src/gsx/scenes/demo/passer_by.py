"""A person who stands at another place in each training photograph of the built-in scenes.

Test pictures hold nobody, as the truth for research on what moves (docs/explanation/photo-corrections.md).
"""

from functools import partial

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.seeds import derived_seed
from gsx.core.shapes import Float
from gsx.scenes.demo.solids import cylinder, sphere
from gsx.scenes.demo.still_life import StillLife, Thing, arrange
from gsx.scenes.demo.textures import plain
from gsx.scenes.demo.tracing import Rays, trace

AHEAD = (1.2, 2.0)  # distances from the camera along the ground, scene units (about metres), where nothing is nearer
LEEWAY, LEAST = 0.4, 0.5  # least distances from the thing behind and from the camera, scene units
ASIDE = 0.45  # largest shift from the middle of the picture, as a share of the distance
SKIN, HAIR, COAT, TROUSERS = (0.80, 0.62, 0.52), (0.25, 0.17, 0.12), (0.70, 0.16, 0.14), (0.16, 0.19, 0.30)


def person_at(x: float, y: float, floor: float) -> list[Thing]:
    """Return trousers, coat, head and hair of a person on the floor."""
    return [
        Thing(cylinder("trousers", (x, y, floor + 0.40), 0.13, 0.80), partial(plain, colour=TROUSERS)),
        Thing(cylinder("coat", (x, y, floor + 1.10), 0.20, 0.62), partial(plain, colour=COAT)),
        Thing(sphere("head", (x, y, floor + 1.54), 0.13), partial(plain, colour=SKIN)),
        Thing(sphere("hair", (x, y, floor + 1.59), 0.125), partial(plain, colour=HAIR)),
    ]


def with_passer_by(life: StillLife, camera: Camera, name: str, floor: float) -> StillLife:
    """Add a person and their shadow before the camera of the photograph of that name."""
    x, y = place_of(life, camera, name).tolist()
    return arrange([*life.things, *person_at(x, y, floor)], life.kit)


def place_of(life: StillLife, camera: Camera, name: str) -> Float[Tensor, "2"]:
    """Return where on the ground the person stands: the same in every run."""
    near, across = torch.rand(2, generator=torch.Generator().manual_seed(derived_seed("passer by", name))).tolist()
    forward, right = camera.rotation[2, :2].double(), camera.rotation[0, :2].double()
    way = forward / forward.norm() + ASIDE * (2 * across - 1) * right
    direction = torch.cat([way / way.norm(), torch.zeros(1, dtype=torch.float64)]).float()[:, None]
    free = float(trace(life, Rays(camera.centre.double(), direction)).depth) - LEEWAY
    ahead = min((AHEAD[0] + (AHEAD[1] - AHEAD[0]) * near) * float(way.norm()), free)
    return camera.centre[:2].double() + max(LEAST, ahead) * way / way.norm()
