"""Pretrained upscalers: SPAN, Real-ESRGAN, and any network in a file of ncnn or ONNX."""

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.reduction import Reduction
from gsx.core.data.resize import to_uint8
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import replace_file
from gsx.core.shapes import Float, UInt8
from gsx.core.training.regenerator import RegeneratorContext, Request
from gsx.engine.cache import cache_folder, content_key
from gsx.engine.cached_images import cache_image, read_cached_image
from gsx.regenerators.pretrained.model_files import RUNNERS, SCALES, Model, PretrainedOptions, locate_models
from gsx.regenerators.pretrained.process import NetworkProcess
from gsx.regenerators.pretrained.tiles import Picture, run_in_tiles

Enlarge: TypeAlias = Callable[[Float[Tensor, "3 h w"], int, Reduction], Tensor]
"""(picture, scale, filter of the scene) -> picture `scale` times as large."""
MOST_PASSES = 4
"""Most networks that are applied one after the other."""
TRIAL = 24
"""Side of the picture that each network is tried with before training, px."""


class PhotoStore:
    """Photos at several times their size, in 8 bits, in memory and in the cache."""

    def __init__(self, gigabytes: float, enlarge: Enlarge, recipe: Callable[[], object]) -> None:
        self.gigabytes, self.enlarge, self.recipe = gigabytes, enlarge, recipe
        self.pixels = 0
        """Pixels of all training photos; 0: unknown."""
        self.enlarged: dict[tuple[int, int], UInt8[Tensor, "3 H W"]] = {}
        """Enlarged photos by number of the view and scale."""

    def expect(self, views: Sequence[View]) -> None:
        """Counts the pixels that there will be to enlarge."""
        self.pixels = sum(view.camera.width * view.camera.height for view in views)

    def has(self, request: Request) -> bool:
        """Returns whether a request is a photo without mask, or a window of it if all photos fit at its scale."""
        whole = request.camera.size == request.view.camera.size
        fits = 0 < 3 * self.pixels * request.scale**2 <= 1e9 * self.gigabytes
        return (whole or fits) and request.photo and request.scale > 1 and request.view.counted() is None

    def cut(self, request: Request) -> Float[Tensor, "3 H W"]:
        """Returns the requested window of the enlarged photo."""
        key, window = (request.number, request.scale), enlarged_window(request)
        picture = self.enlarged[key] if key in self.enlarged else self.made(request)
        if tuple(picture.shape[1:]) != (window.height, window.width):  # a whole photo is requested once
            self.enlarged[key] = picture
        return window.cut(picture).float() / 255

    def made(self, request: Request) -> UInt8[Tensor, "3 H W"]:
        """Reads the enlarged photo of a request from the cache, or makes it."""
        photo = request.view.image()
        path = self.path(photo, request)
        cached = read_cached_image(path)
        if cached is not None:
            return cached
        result = self.enlarge(photo, request.scale, request.reduction)
        if not bool(torch.isfinite(result).all()):
            raise InputError(
                f"regenerator: the network returns values that are not finite for '{request.view.name}'. "
                "Choose another network, or leave that photo out."
            )
        picture = to_uint8(result.clamp(0, 1))
        cache_image(path, picture)
        return picture

    def path(self, photo: Float[Tensor, "3 h w"], request: Request) -> Path:
        """Returns the place of an enlarged photo in the cache, by all that decides its pixels."""
        digest = hashlib.sha256(to_uint8(photo).numpy().tobytes()).hexdigest()
        recipe = content_key(self.recipe(), request.scale, asdict(request.reduction))
        return cache_folder("enlarged_photos", recipe) / f"{content_key(digest, photo.shape)}.png"


def enlarged_window(request: Request) -> Window:
    """Returns the window of a request on the enlarged photo."""
    camera, whole, scale = request.camera, request.view.camera, request.scale
    left, top = round(whole.cx - camera.cx), round(whole.cy - camera.cy)
    return Window(left=scale * left, top=scale * top, width=scale * camera.width, height=scale * camera.height)


class Pretrained:
    """Enlargement by pretrained networks, one after the other where no single one has the scale."""

    def __init__(self, options: PretrainedOptions) -> None:
        self.options = options
        self.process = NetworkProcess(options.vulkan)
        self.photos = PhotoStore(options.photos_gb, self.enlarge, self.recipe)
        self.located: dict[int, Model] | None = None
        self.raise_if_stopping: Callable[[], None] = lambda: None
        """Raises `Stopped` if the training run is stopping: a photo takes minutes by a large network."""

    @property
    def models(self) -> dict[int, Model]:
        """Networks by scale, located once; errors as `locate_models`."""
        if self.located is None:
            self.located = locate_models(self.options, "regenerator.ROLE")
        return self.located

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raises ConfigError or InputError if a scale cannot be reached, or a network is missing or unusable."""
        needed = {factor for scale in scales for factor in factors_of(scale, self.models, self.options.name)}
        if not needed and max(scales) == 1:
            raise ConfigError(f"regenerator {self.options.name} has no network of scale 1: give x1.file")
        for factor in sorted(needed):
            self.try_network(self.models[factor])

    def try_network(self, model: Model) -> None:
        """Raises ConfigError if a network fails on a grey picture or has another scale; InputError: it cannot run."""
        image = torch.full((3, TRIAL, TRIAL), 0.5)
        result = self.process.run(model.file, image.numpy())
        shape = tuple(result.shape)
        if len(shape) != 3 or shape[0] != 3 or shape[1] != shape[2] or shape[1] % TRIAL:
            raise ConfigError(f"{model.file} makes {shape} of (3, {TRIAL}, {TRIAL}): give a network for RGB pictures")
        if not np.isfinite(result).all():
            raise ConfigError(f"{model.file} makes values of a grey picture that are not finite: give another network")
        if shape[1] != model.scale * TRIAL:
            raise ConfigError(
                f"{model.file} enlarges x{shape[1] // TRIAL}: give it as x{shape[1] // TRIAL}.file, not x{model.scale}"
            )

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Writes the origin of the networks to the run folder, and reserves memory for enlarged photos."""
        self.photos.expect(context.views)
        self.raise_if_stopping = context.raise_if_stopping
        path = context.folder / f"{self.options.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, json.dumps(self.provenance(), indent=2).encode())
        return {}

    def provenance(self) -> dict[str, Any]:
        """Returns package, licence, files and digests of the networks."""
        package = self.options.package
        return {
            "name": self.options.name,
            "package": f"{package} {version(package)}" if package else "",
            "licence": self.options.licence,
            "networks": {
                f"x{scale}": {"file": model.file.name, "sha256": model.sha256} for scale, model in self.models.items()
            },
        }

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Returns each picture `scale` times as large; windows of photos are cut from whole enlarged photos."""
        return [
            self.photos.cut(one) if self.photos.has(one) else self.enlarge(one.image.cpu(), one.scale, one.reduction)
            for one in requests
        ]

    def enlarge(self, image: Float[Tensor, "3 h w"], scale: int, reduction: Reduction) -> Float[Tensor, "3 H W"]:
        """Enlarges a picture by one network after the other, and reduces what is too large as the scene does."""
        factors = factors_of(scale, self.models, self.options.name)
        for factor in factors:
            image = self.run(self.models[factor], image)
        excess = math.prod(factors) // scale
        return reduction.reduce(image, excess) if excess > 1 else image

    def run(self, model: Model, image: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 H W"]:
        """Runs one network on a picture."""
        network, picture = partial(self.run_part, model), image.numpy().astype("float32")
        return torch.from_numpy(run_in_tiles(network, picture, model.scale, self.options.tile, self.options.border))

    def run_part(self, model: Model, part: Picture) -> Picture:
        """Runs a network on a part of a picture, unless the training run is stopping.

        Raises:
            InputError: the result has another size, as that of a network for even sides may have.
        """
        self.raise_if_stopping()
        result = self.process.run(model.file, part)
        expected = (3, *(model.scale * side for side in part.shape[1:]))
        if result.shape != expected:
            raise InputError(
                f"{model.file} makes {result.shape} of {part.shape}, not {expected}: give a network for pictures of "
                "any size"
            )
        return result

    def recipe(self) -> object:
        """Returns all that decides the pixels of an enlarged picture, but the picture."""
        networks = {scale: model.sha256 for scale, model in self.models.items()}
        runners = sorted({RUNNERS[model.file.suffix][0] for model in self.models.values()})
        recipe = networks, self.options.tile, self.options.border, [(name, version(name)) for name in runners]
        return (*recipe, "vulkan") if self.options.vulkan else recipe


def factors_of(scale: int, available: Iterable[int], name: str) -> tuple[int, ...]:
    """Returns the networks to apply in turn: the fewest whose product is the scale, else its least multiple.

    Empty for scale 1 without a network of that scale: pictures stay as they are.

    Raises:
        ConfigError: no multiple can be reached.
    """
    scales = sorted(available, reverse=True)
    if scale == 1:
        return (1,) if 1 in scales else ()
    larger = [one for one in scales if one > 1]
    chains = [c for n in range(1, MOST_PASSES + 1) for c in itertools.combinations_with_replacement(larger, n)]
    reached = [chain for chain in chains if math.prod(chain) % scale == 0]
    if not reached:
        have = ", ".join(f"x{one}" for one in sorted(scales)) or "none"
        remedy = "choose other scales or another regenerator" if larger else f"give x{min(scale, SCALES[-1])}.file"
        raise ConfigError(f"regenerator {name} cannot enlarge x{scale} by its networks ({have}): {remedy}")
    return min(reached, key=lambda chain: (math.prod(chain), len(chain)))
