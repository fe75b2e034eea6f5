"""Super-resolution learnt from the scene's own photographs (ours; the idea: ZSSR, Shocher et al. 2018).

Photographs reduced by two as the scene reduces them, and themselves, are pairs of input and truth; textures that recur
at several distances are what it learns. Every result reduces to its input (`reduction.projected`), x4 and x8 by
recursion.
"""

import hashlib
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from gsx.core.data.reduction import Reduction, projected
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError
from gsx.core.ranges import Interval, Range, Rate, Seconds
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request
from gsx.engine.cache import add_to_manifest, cache_folder, content_key, is_intact, source_digest
from gsx.engine.machine import machine_stamp, multiplies_bfloat16
from gsx.regenerators.networks import fit, initialise, read_tensors, write_tensors

logger = logging.getLogger(__name__)

STEP = 2  # factor of one application


@dataclass(frozen=True, kw_only=True)
class SceneSROptions:
    """Options of conf/regenerator/upscale/scene_sr.yaml."""

    name: str
    channels: Annotated[int, Range(1, 1024)]
    layers: Annotated[int, Range(1, 100)]
    steps: Interval
    batch: Annotated[int, Range(1, 4096)]
    crop: Annotated[int, Range(8, 4096)]
    """Edge of a training crop at the low resolution, px."""
    rate: Rate
    noise: Annotated[float, Range(0, 255)]
    """Standard deviation of noise added to inputs, in 8-bit levels: renders are not photographs."""
    seconds: Seconds
    """Training ends after this time; 0: never. A run cut short by it cannot be repeated bit for bit."""

    def __post_init__(self) -> None:
        if not self.rate > 0:
            raise ValueError("regenerator.upscale.rate is 0, by which nothing is learnt; give more")


class Enlarger(nn.Module):
    """Bicubic enlargement plus detail from convolutions on the low resolution."""

    def __init__(self, channels: int, layers: int, generator: torch.Generator) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, channels, 3, padding=1)
        self.middle = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in range(layers))
        self.last = nn.Conv2d(channels, 3 * STEP * STEP, 3, padding=1)
        for layer in (self.first, *self.middle):
            initialise(layer, generator)
        nn.init.zeros_(self.last.weight)  # training starts from the plain enlargement
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, image: Float[Tensor, "B 3 h w"], bfloat16: bool = False) -> Float[Tensor, "B 3 H W"]:
        """Double width and height; `bfloat16`: the type of the convolutions."""
        with torch.autocast(image.device.type, torch.bfloat16, enabled=bfloat16):
            detail = self.detail(image).float()
        return interpolate(image, scale_factor=STEP, mode="bicubic", align_corners=False) + detail

    def detail(self, image: Float[Tensor, "B 3 h w"]) -> Float[Tensor, "B 3 H W"]:
        """Return what is added to the bicubic enlargement; channels-last memory makes it a fifth faster."""
        features = torch.relu(self.first((image - 0.5).contiguous(memory_format=torch.channels_last)))
        for layer in self.middle:
            features = features + torch.relu(layer(features))
        return nn.functional.pixel_shuffle(self.last(features), STEP)


class SceneSR:
    """A super-resolution network that learns once per scene, before its first pictures."""

    def __init__(self, options: SceneSROptions) -> None:
        self.options = options
        self.network: Enlarger | None = None

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError for a scale that is no power of two."""
        odd = [scale for scale in scales if scale & (scale - 1)]
        if odd:
            raise ConfigError(f"regenerator scene_sr enlarges x2, x4, x8, not x{odd[0]}: change the augmenter's scales")

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Train, or read the network of an earlier run with the same photos and options."""
        if self.network is not None:
            return {}
        photos = [view.image() for view in context.views]
        generator = torch.Generator().manual_seed(context.seed)
        self.network = Enlarger(self.options.channels, self.options.layers, generator).to(context.device)
        path = kept_at(self.options, photos, context.reduction, context.seed, context.device)
        if is_intact(path) and (found := read_tensors(path)) is not None:
            self.network.load_state_dict(found)
            return {"learnt_before": 1.0}
        start = time.perf_counter()
        loss, complete = train(self.network, photos, context, self.options)
        seconds = time.perf_counter() - start
        logger.info("scene_sr learnt from %d photographs in %.0f s", len(photos), seconds)
        if complete:
            try:
                write_tensors(path, self.network.state_dict())
                add_to_manifest(path)
            except OSError as error:
                logger.warning("%s cannot be written (%s): the next run learns again", path, error.strerror)
        return {"seconds": seconds, "loss": loss}

    @torch.no_grad()
    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Return each picture `scale` times as large."""
        assert self.network is not None
        return [enlarged(self.network, request) for request in requests]


def enlarged(network: Enlarger, request: Request) -> Float[Tensor, "3 H W"]:
    """Double a picture until it is large enough; the result reduces to its input."""
    image = source = request.image.to(next(network.parameters()).device)
    for _ in range(round(math.log2(request.scale))):
        image = projected(network(image[None])[0], image, STEP, request.reduction)
    if request.scale > STEP and request.reduction.filter != "area":  # two reductions are not one by twice the factor
        image = projected(image, source, request.scale, request.reduction)
    return image


def train(
    network: Enlarger,
    photos: Sequence[Float[Tensor, "3 H W"]],
    context: RegeneratorContext,
    options: SceneSROptions,
) -> tuple[float, bool]:
    """Train; returns (mean loss of the last tenth, whether all steps were taken).

    Convolutions use bfloat16 where the device multiplies it, and learn as much; results are computed in float32.
    """
    generator, reduction = torch.Generator().manual_seed(context.seed), context.reduction
    device = next(network.parameters()).device
    bfloat16 = multiplies_bfloat16(device)

    def loss_of() -> Tensor:
        low, truth = (part.to(device) for part in pairs(photos, reduction, options, generator))
        noise = torch.randn(low.shape, generator=generator).to(device) * options.noise / 255
        out = network(low + noise, bfloat16)
        off = reduction.inner(reduction.reduce(out, STEP) - low)
        return (out - truth).abs().mean() + off.abs().mean()

    losses = fit(network, loss_of, context, options.steps, options.rate, options.seconds)
    if len(losses) < options.steps:
        logger.warning("scene_sr stops after %d of %d steps: regenerator.upscale.seconds", len(losses), options.steps)
    tail = [float(loss) for loss in losses[-max(1, len(losses) // 10) :]]
    return sum(tail) / max(1, len(tail)), len(losses) == options.steps


def pairs(
    photos: Sequence[Float[Tensor, "3 H W"]], reduction: Reduction, options: SceneSROptions, generator: torch.Generator
) -> tuple[Float[Tensor, "B 3 h w"], Float[Tensor, "B 3 H W"]]:
    """Return (reduced crops of photographs, the crops); both lose the borders that the reduction's filter reaches."""
    edge = options.crop + 2 * reduction.rim
    larger = torch.stack([crop(photos, edge, generator) for _ in range(options.batch)])
    low = reduction.inner(reduction.reduce(larger, STEP))
    left = (larger.shape[2] - STEP * low.shape[2]) // 2
    window = Window(left=left, top=left, width=STEP * low.shape[3], height=STEP * low.shape[2])
    return low, larger[(..., *window.pixels)]


def crop(photos: Sequence[Float[Tensor, "3 H W"]], edge: int, generator: torch.Generator) -> Float[Tensor, "3 h w"]:
    """Cut a random part out of a photograph, turned and mirrored; its side is 2 `edge` or the shortest photo's."""
    photo = photos[int(torch.randint(len(photos), (), generator=generator))]
    size = STEP * min(edge, *(min(p.shape[1:]) // STEP for p in photos))
    top, left = (int(torch.randint(whole - size + 1, (), generator=generator)) for whole in photo.shape[1:])
    part = photo[:, top : top + size, left : left + size]
    turns = int(torch.randint(8, (), generator=generator))
    part = part.rot90(turns % 4, (1, 2))
    return part.flip(2) if turns >= 4 else part


def kept_at(
    options: SceneSROptions, photos: Sequence[Tensor], reduction: Reduction, seed: int, device: torch.device
) -> Path:
    """Return the network's place in the cache, by everything that decides its weights: inputs, code and machine."""
    digest = hashlib.sha256()
    for photo in photos:
        digest.update(repr(tuple(photo.shape)).encode())
        digest.update((photo * 255).round().to(torch.uint8).numpy().tobytes())
    machine = [*machine_stamp(device), multiplies_bfloat16(device)]
    code = source_digest(Path(__file__), Path(__file__).with_name("networks.py"))
    key = content_key(asdict(options), asdict(reduction), code, digest.hexdigest(), seed, machine)
    return cache_folder("scene_sr", key) / "network.safetensors"
