"""Pictures to regenerate, and requests for them."""

from collections.abc import Callable, Sequence
from importlib.resources import as_file, files

import torch
from omegaconf import OmegaConf
from torch import Tensor

from gsx.augmenters.checks import Checks
from gsx.augmenters.pseudo_details import PseudoDetails
from gsx.augmenters.pseudo_options import PseudoOptions
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.reduction import as_blocks, box_average
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.training.augmenter import AugmenterContext
from gsx.core.training.regenerator import Regenerator, RegeneratorContext, Request
from gsx.core.training.run import Run
from gsx.experiments.runs.typed import typed

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


def strict_checks() -> Checks:
    """conf/checks/strict.yaml."""
    with as_file(files("gsx.conf") / "checks" / "strict.yaml") as path:
        return typed(Checks, OmegaConf.to_container(OmegaConf.load(path)), "checks")


class Made:
    """A regenerator made of a function."""

    def __init__(self, enlarge: Callable[[Request], Tensor]) -> None:
        self.enlarge = enlarge

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        return {}

    def regenerate(self, requests: Sequence[Request]) -> list[Tensor]:
        return [self.enlarge(request) for request in requests]


def through_an_autoencoder(request: Request) -> Tensor:
    """The input, enlarged, with an error of 20 dB that no reduction takes out."""
    generator = torch.Generator().manual_seed(request.number)
    noise = torch.randn(request.image.shape, generator=generator)
    noise -= noise.mean((1, 2), keepdim=True)
    return as_blocks((request.image + 0.1 * noise).clamp(0, 1), request.scale)


def noisy(options: PseudoOptions, name: str, run: Run) -> PseudoDetails:
    """An augmenter by these options on the scene of a run, redrawn through an autoencoder."""
    regenerator = of_role(Made(through_an_autoencoder))
    context = AugmenterContext(name=name, scene=run.scene, iterations=40000, seed=0, regenerator=regenerator)
    return PseudoDetails(options, context)


def of_role(regenerator: Regenerator) -> Callable[[str], Regenerator]:
    """Returns what a context holds: this regenerator for every role."""
    return lambda role: regenerator
