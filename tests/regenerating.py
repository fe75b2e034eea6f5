"""Pictures to regenerate, and requests for them."""

import torch
from torch import Tensor

from gsx.core.camera import Camera, look_at
from gsx.core.images import to_uint8
from gsx.core.regenerator import Request, box_average
from gsx.core.scene import View

EDGE = 48


def stripes(seed: int, edge: int = EDGE) -> Tensor:
    """Crisp bars of two colours in some direction, as 8-bit RGB: an enlargement by a filter blurs their edges."""
    generator = torch.Generator().manual_seed(seed)
    angle, phase = (float(value) for value in torch.rand(2, generator=generator) * 3.14159)
    row, column = torch.meshgrid(torch.arange(edge * 4.0), torch.arange(edge * 4.0), indexing="ij")
    wave = torch.sin((column * torch.cos(torch.tensor(angle)) + row * torch.sin(torch.tensor(angle))) / 11 + phase)
    colours = torch.rand(2, 3, 1, 1, generator=generator) * 0.5 + torch.tensor([0.0, 0.5]).view(2, 1, 1, 1)
    picture = torch.where(wave > 0, colours[0], colours[1])
    return to_uint8(box_average(picture, 4))


class Photo:
    def __init__(self, image: Tensor) -> None:
        self.stored = image

    def image(self, camera: object) -> Tensor:
        return self.stored

    def max_zoom(self, camera: object) -> float:
        return 1.0


def camera(edge: int = EDGE) -> Camera:
    return look_at([0.0, -4.0, 0.0], [0.0, 0.0, 0.0], fov_x=0.9, width=edge, height=edge)


def request(image: Tensor, scale: int = 2) -> Request:
    seen = camera(image.shape[2])
    return Request(
        image=image, scale=scale, camera=seen, view=View("a", seen, Photo(to_uint8(image))), number=0, photo=True,
        seed=22, strength=0.0, strongest=0.0, prompt="", step=1,
    )  # fmt: skip
