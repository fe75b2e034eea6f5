"""Diffusion models as regenerators: batches under a budget, sizes that fit, results kept for later runs."""

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.resize import resize, to_uint8
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import ConfigError, InputError, TrainingError
from gsx.core.packages import require
from gsx.core.shapes import Float
from gsx.core.training.regenerator import RegeneratorContext, Request
from gsx.engine.cache import cache_folder, content_key
from gsx.engine.cached_images import cache_image, read_cached_image
from gsx.engine.machine import machine_stamp
from gsx.regenerators.classical import refuse_enlarging
from gsx.regenerators.diffusion.model_specs import SD_X2_LATENT, SD_X4, Batch, ModelSpec, padded_to, spec_of
from gsx.regenerators.diffusion.models import (
    PACKAGES,
    code_stamp,
    find_model,
    fingerprint,
    number_type,
    open_pipeline,
    place,
)
from gsx.regenerators.diffusion.options import DiffusionOptions, PipelineOptions, RestorerOptions, UpscalerOptions
from gsx.regenerators.diffusion.tuning import Pace, Tuning

logger = logging.getLogger(__name__)

PICTURES = "diffusion_pictures"  # folder of the cache
MEMORY = ("allocate memory", "out of memory")
"""Words of errors that smaller batches may avoid."""
IRRELEVANT = ("download", "offload", "cached", "model", "revision")
"""Options that do not change results; the fingerprint stands for the model."""


class Diffusion:
    """One pipeline, opened at the first event."""

    def __init__(self, spec: ModelSpec, options: DiffusionOptions) -> None:
        self.spec, self.options = spec, options
        self.folder: Path | None = None
        self.pipe: Any = None
        self.identity = ""
        """Digest of everything that decides on a result but pictures, seeds, prompts and strengths."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError or InputError if a package or the model is missing, or a scale cannot be reached."""
        for scale in scales:
            rounds_to(scale, self.spec, self.options)
        tuning = self.options.tuning.steps if isinstance(self.options, RestorerOptions) else 0
        packages = (*PACKAGES, *(("peft",) if tuning else ()))
        require(f"regenerator {self.options.name}", packages, "gsx[diffusion]")
        if tuning and len(views) < 2:
            raise InputError(
                f"regenerator {self.options.name} needs at least 2 training views to be tuned, there is {len(views)}: "
                "choose regenerator/restore=sdxl_turbo_raw"
            )
        self.folder = find_model(self.options, self.spec)

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Open the pipeline once per run, and tune it if the options say so; TrainingError: it cannot be loaded."""
        if self.pipe is not None:
            return {}
        start, options = time.perf_counter(), self.options
        folder = self.folder or find_model(options, self.spec)
        files = fingerprint(folder, options, self.spec)
        dtype = number_type(options, context.device)
        pipe = open_pipeline(folder, options, self.spec, dtype)
        adapter, metrics = "", dict[str, float]()
        try:
            if isinstance(options, RestorerOptions) and options.tuning.steps:
                adapter, metrics = Tuning(pipe, options, self.spec, context, files).merged()
            place(pipe, options, context.device)
        except (RuntimeError, ValueError) as error:
            raise TrainingError(
                f"regenerator {options.name} cannot be made ready ({type(error).__name__}: {error}): if memory is "
                f"short, set {self.spec.where}.offload=model or a smaller dtype"
            ) from error
        deciding = {key: value for key, value in asdict(options).items() if key not in IRRELEVANT}
        machine = (code_stamp(), *machine_stamp(context.device), str(dtype))
        self.identity = content_key(files, adapter, deciding, machine)
        self.pipe = pipe
        logger.info("%s is ready after %.0f s: %s", options.name, time.perf_counter() - start, folder)
        return metrics

    @torch.no_grad()
    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Return each picture in steps of 1/255, as the cache keeps it; results with NaN or inf stay as they are."""
        images = {number: request.image.cpu().float() for number, request in enumerate(requests)}
        rounds = [rounds_to(request.scale, self.spec, self.options) for request in requests]
        for turn in range(max(rounds, default=0)):
            due = {n: replace(r, image=images[n]) for n, r in enumerate(requests) if rounds[n] > turn}
            images |= self.redrawn(due, turn)
        return [images[number] for number in range(len(requests))]

    def redrawn(self, requests: Mapping[int, Request], turn: int) -> dict[int, Float[Tensor, "3 H W"]]:
        """Apply the model once to pictures by number."""
        spec, progress, out = self.spec, Pace(self.options.name, len(requests)), dict[int, Tensor]()
        for group in self.batches(requests):
            numbers, images, windows = zip(*group, strict=True)
            photos = [photograph(requests[number], images[0]) for number in numbers] if spec.reference else []
            batch = Batch(
                images=torch.stack(images),
                prompts=[requests[number].prompt for number in numbers],
                seeds=[requests[number].seed for number in numbers],
                strength=requests[numbers[0]].strength,
                references=torch.stack(photos) if photos else None,
            )
            for number, inside, result in zip(numbers, windows, self.remembered(batch, turn), strict=True):
                out[number] = Window(*(spec.factor * side for side in astuple(inside))).cut(result)
            progress.advance(len(batch))
        return out

    def batches(self, requests: Mapping[int, Request]) -> Iterator[list[tuple[int, Tensor, Window]]]:
        """Yield (number, padded picture, window of the original in it) of requests with one size and strength."""
        alike: dict[tuple[object, ...], list[tuple[int, Tensor, Window]]] = {}
        for number, request in requests.items():
            image, inside = padded_to(request.image, self.spec.multiple, self.spec.least)
            alike.setdefault((*image.shape, request.strength), []).append((number, image, inside))
        for group in alike.values():
            pixels = group[0][1][0].numel() * self.spec.factor**2  # of a result
            count = max(1, self.options.batch_pixels // pixels)
            yield from (group[first : first + count] for first in range(0, len(group), count))

    def remembered(self, batch: Batch, turn: int) -> list[Float[Tensor, "3 H W"]]:
        """Return results of a batch, from the cache if it holds this very batch: a result may depend on the others."""
        contents = batch.contents()
        keys = [content_key(self.identity, contents, number, turn) for number in range(len(batch))]
        paths = [cache_folder(PICTURES, key) / "picture.png" for key in keys]
        kept = [read_cached_image(path) for path in paths] if self.options.cached else []
        if kept and all(result is not None for result in kept):
            return [result.float() / 255 for result in kept if result is not None]
        results = list(self.called(batch))
        for index, result in enumerate(results):
            if bool(torch.isfinite(result).all()):
                results[index] = to_uint8(result.clamp(0, 1)).float() / 255
                if self.options.cached:
                    cache_image(paths[index], results[index])
        return results

    def called(self, batch: Batch) -> Float[Tensor, "B 3 H W"]:
        """Call the pipeline, on half of the pictures where memory is short; TrainingError: it fails on one picture."""
        try:
            results: Tensor = self.spec.call(self.pipe, batch, self.options).detach().cpu().float()
            count, channels, height, width = batch.images.shape
            expected = (count, channels, height * self.spec.factor, width * self.spec.factor)
            if tuple(results.shape) != expected:
                raise ValueError(f"its results are {tuple(results.shape)} and should be {expected}")
            return results
        except Exception as error:  # whatever a library or a custom pipeline raises, the run must end in one sentence
            if not any(words in str(error).lower() for words in MEMORY):
                raise TrainingError(
                    f"regenerator {self.options.name} failed: {type(error).__name__}: {error}"
                ) from error
            if len(batch) == 1:
                where, (height, width) = self.spec.where, batch.images.shape[2:]
                raise TrainingError(
                    f"regenerator {self.options.name} runs out of memory at one picture of {width} x {height} px: set "
                    f"{where}.tiling=true, {where}.offload=model or a smaller dtype, or narrow the augmenter's windows"
                ) from error
        logger.warning("%s: %d pictures at a time are too many for the memory", self.options.name, len(batch))
        half = len(batch) // 2
        return torch.cat([self.called(batch.part(0, half)), self.called(batch.part(half, len(batch)))])


def any_pipeline(options: PipelineOptions) -> Diffusion:
    """Return the regenerator of a pipeline that its options describe."""
    return Diffusion(spec_of(options), options)


def rounds_to(scale: int, spec: ModelSpec, options: DiffusionOptions) -> int:
    """Return how many applications of a model reach a scale; ConfigError: none do."""
    if spec.factor == 1:
        refuse_enlarging(options.name, [scale])
        return 1
    rounds, reached = 0, 1
    while reached < scale:
        rounds, reached = rounds + 1, reached * spec.factor
    if reached != scale:
        ladder = ", ".join(f"x{spec.factor**power}" for power in (1, 2, 3))
        raise ConfigError(f"regenerator {options.name} enlarges {ladder}, not x{scale}: change the augmenter's scales")
    return rounds


def photograph(request: Request, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """Return the photograph of a request's training view at the size of its picture."""
    whole = to_uint8(request.view.image())
    return resize(whole, image.shape[2], image.shape[1], "bicubic").float() / 255


@dataclass(frozen=True, kw_only=True)
class CascadeOptions:
    """Options of conf/regenerator/upscale/sd_by_scale.yaml."""

    name: str
    x2: UpscalerOptions
    x4: UpscalerOptions


def factors_of(scale: int) -> list[int]:
    """Factor a scale into 4s and then a 2 (the paper: x8 is x4, then x2); ConfigError: it is no power of two."""
    power = scale.bit_length() - 1
    if scale != 1 << power:
        raise ConfigError(f"regenerator sd_by_scale enlarges x2, x4, x8, not x{scale}: change the augmenter's scales")
    return [4] * (power // 2) + [2] * (power % 2)


class Cascade:
    """Two upscalers, of which only those that the scales need are located and loaded."""

    def __init__(self, options: CascadeOptions) -> None:
        self.models = {
            2: Diffusion(replace(SD_X2_LATENT, part="x2"), options.x2),
            4: Diffusion(replace(SD_X4, part="x4"), options.x4),
        }
        self.needed: set[int] = set()

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """Raise ConfigError or InputError if a scale cannot be reached or a model is missing."""
        self.needed |= {factor for scale in scales for factor in factors_of(scale)}
        for factor in sorted(self.needed):
            self.models[factor].check(views, [factor], moved)

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Open the models that are needed."""
        prepared = {factor: self.models[factor].prepare(context) for factor in sorted(self.needed)}
        return {f"x{factor}_{name}": value for factor, metrics in prepared.items() for name, value in metrics.items()}

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Enlarge each picture by one model after the other."""
        images = [request.image for request in requests]
        chains = [factors_of(request.scale) for request in requests]
        for turn in range(max(map(len, chains), default=0)):
            for factor, model in self.models.items():
                due = [n for n, chain in enumerate(chains) if chain[turn : turn + 1] == [factor]]
                results = model.regenerate([replace(requests[n], image=images[n], scale=factor) for n in due])
                for n, result in zip(due, results, strict=True):
                    images[n] = result
        return images
