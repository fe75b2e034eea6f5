"""Diffusion models as regenerators: batches under a budget, sizes that fit, results kept for later runs."""

import hashlib
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
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
from gsx.regenerators.diffusion.model_specs import Batch, ModelSpec, spec_of
from gsx.regenerators.diffusion.models import (
    PACKAGES,
    code_stamp,
    fingerprint,
    located,
    number_type,
    opened,
    place,
)
from gsx.regenerators.diffusion.options import DiffusionOptions, PipelineOptions, RestorerOptions
from gsx.regenerators.diffusion.pace import Pace
from gsx.regenerators.diffusion.sizes import enlarged, grown
from gsx.regenerators.diffusion.tuning import Tuned, bytes_of, tuned

logger = logging.getLogger(__name__)

PICTURES = "diffusion_pictures"
"""Kind of the results in the cache."""
MEMORY = ("allocate memory", "out of memory")
"""Words of errors that smaller batches may avoid."""
IRRELEVANT = ("download", "offload", "cached", "model", "revision")
"""Options that do not change results; what the model is says its fingerprint."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PaddedImage:
    """A picture as the model takes it."""

    number: int
    """Of its request."""
    image: Float[Tensor, "3 H W"]
    inside: Window
    """Where in it the given picture is."""
    request: Request
    reference: Float[Tensor, "3 H W"] | None
    """The photograph of its training view, where the model is shown it."""


class Diffusion:
    """One pipeline, opened at the first event."""

    def __init__(self, spec: ModelSpec, options: DiffusionOptions) -> None:
        self.spec, self.options = spec, options
        self.folder: Path | None = None
        self.pipe: Any = None
        self.identity = ""
        """Of everything but pictures, seeds, prompts and strengths that decides on a result."""

    def check(self, views: Sequence[View], scales: Sequence[int], moved: bool) -> None:
        """The packages and the model are there, the scales can be reached: all that can be known before training."""
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
        self.folder = located(self.options, self.spec)

    def prepare(self, context: RegeneratorContext) -> dict[str, float]:
        """Opens the pipeline, and tune it to the scene if it is to be; once per run.

        Raises:
            TrainingError: it cannot be loaded or does not fit into memory; the run keeps its checkpoint.
        """
        if self.pipe is not None:
            return {}
        begun = time.perf_counter()
        options = self.options
        folder = self.folder or located(options, self.spec)
        files = fingerprint(folder, options, self.spec)
        dtype = number_type(options, context.device)
        pipe = opened(folder, options, self.spec, dtype)
        found = Tuned()
        try:
            if isinstance(options, RestorerOptions) and options.tuning.steps:
                found = tuned(pipe, options, self.spec, context, files)
            place(pipe, options, context.device)
        except (RuntimeError, ValueError) as error:
            raise TrainingError(
                f"regenerator {options.name} cannot be made ready ({type(error).__name__}: {error}): if memory is "
                f"short, set {self.spec.where}.offload=model or a smaller dtype"
            ) from error
        telling = {key: value for key, value in asdict(options).items() if key not in IRRELEVANT}
        machine = (code_stamp(), *machine_stamp(context.device), str(dtype))
        self.identity = content_key(files, found.digest, telling, machine)
        self.pipe = pipe
        logger.info("%s is ready after %.0f s: %s", options.name, time.perf_counter() - begun, folder)
        return found.figures

    @torch.no_grad()
    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Each picture, in order, in steps of 1/255, as it is kept; what is not finite is given back as it is."""
        images = {number: request.image.cpu().float() for number, request in enumerate(requests)}
        rounds = [rounds_to(request.scale, self.spec, self.options) for request in requests]
        for turn in range(max(rounds, default=0)):
            asked = {n: replace(r, image=images[n]) for n, r in enumerate(requests) if rounds[n] > turn}
            images |= self.redrawn(asked, turn)
        return [images[number] for number in range(len(requests))]

    def redrawn(self, asked: Mapping[int, Request], turn: int) -> dict[int, Float[Tensor, "3 H W"]]:
        """Some of the pictures after one application more."""
        spec, progress = self.spec, Pace(self.options.name, len(asked))
        padded = []
        for number, request in asked.items():
            image, inside = grown(request.image, spec.multiple, spec.least)
            photo = photograph(request, image) if spec.reference else None
            padded.append(PaddedImage(number=number, image=image, inside=inside, request=request, reference=photo))
        out: dict[int, Tensor] = {}
        for together in batches(padded, self.options.batch_pixels // spec.factor**2):
            for part, result in zip(together, self.remembered(together, turn), strict=True):
                out[part.number] = enlarged(part.inside, spec.factor).cut(result)
            progress.more(len(together))
        return out

    def remembered(self, together: Sequence[PaddedImage], turn: int) -> list[Float[Tensor, "3 H W"]]:
        """Results of a batch, from the cache if it holds this batch: what is drawn may depend on the company."""
        contents = [content_of(part) for part in together]
        paths = [self.path(contents, number, turn) for number in range(len(together))]
        kept = [read_cached_image(path) for path in paths] if self.options.cached else []
        if kept and all(result is not None for result in kept):
            return [result.float() / 255 for result in kept if result is not None]
        results = [rounded(result) for result in self.called(batch_of(together))]
        for path, result in zip(paths, results, strict=True):
            if self.options.cached and bool(torch.isfinite(result).all()):
                cache_image(path, result)
        return results

    def called(self, batch: Batch) -> Float[Tensor, "B 3 H W"]:
        """Results of one call, in halves where memory does not suffice."""
        try:
            return self.of_the_right_size(batch, self.spec.call(self.pipe, batch, self.options).detach().cpu().float())
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

    def of_the_right_size(self, batch: Batch, results: Tensor) -> Float[Tensor, "B 3 H W"]:
        """The results, or ValueError if the pipeline has made something else of its pictures."""
        count, channels, height, width = batch.images.shape
        expected = (count, channels, height * self.spec.factor, width * self.spec.factor)
        if tuple(results.shape) != expected:
            raise ValueError(f"its results are {tuple(results.shape)} and should be {expected}")
        return results

    def path(self, contents: Sequence[str], number: int, turn: int) -> Path:
        """Where the result of one picture of a batch is kept."""
        return cache_folder(PICTURES, content_key(self.identity, contents, number, turn)) / "picture.png"


def any_pipeline(options: PipelineOptions) -> Diffusion:
    """One that its options alone describe."""
    return Diffusion(spec_of(options), options)


def rounds_to(scale: int, spec: ModelSpec, options: DiffusionOptions) -> int:
    """How often a model is applied to reach a scale."""
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


def batches(padded: Sequence[PaddedImage], pixels: int) -> list[list[PaddedImage]]:
    """Pictures of one size and strength together, so many pixels at a time, one picture at least."""
    alike: dict[tuple[object, ...], list[PaddedImage]] = {}
    for part in padded:
        alike.setdefault((*part.image.shape, part.request.strength), []).append(part)
    out = []
    for group in alike.values():
        count = max(1, pixels // group[0].image[0].numel())
        out += [group[first : first + count] for first in range(0, len(group), count)]
    return out


def photograph(request: Request, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """That of the training view which a picture was made from, at the picture's size."""
    whole = to_uint8(request.view.image())
    return resize(whole, image.shape[2], image.shape[1], "bicubic").float() / 255


def batch_of(together: Sequence[PaddedImage]) -> Batch:
    """One call's worth."""
    references = [part.reference for part in together if part.reference is not None]
    return Batch(
        references=torch.stack(references) if references else None,
        images=torch.stack([part.image for part in together]),
        prompts=[part.request.prompt for part in together],
        seeds=[part.request.seed for part in together],
        strength=together[0].request.strength,
    )


def content_of(part: PaddedImage) -> str:
    """Of all that a picture's result depends on, but for its company."""
    request, exact = part.request, hashlib.sha256()
    for picture in (part.image, part.reference):
        if picture is not None:
            exact.update(bytes_of(picture))
    return content_key(exact.hexdigest(), request.seed, request.strength, request.prompt)


def rounded(result: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """In steps of 1/255, if it is finite."""
    return to_uint8(result.clamp(0, 1)).float() / 255 if bool(torch.isfinite(result).all()) else result
