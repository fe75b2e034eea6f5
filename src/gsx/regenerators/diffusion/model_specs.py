"""Facts on each model: where it is, what sizes it takes, how `diffusers` calls it."""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.window import Window
from gsx.core.shapes import Float, Int
from gsx.engine.cache import content_key
from gsx.regenerators.diffusion.options import DiffusionOptions, PipelineOptions, UpscalerOptions


@dataclass(frozen=True, eq=False, kw_only=True)
class Batch:
    """Pictures of one size for one call."""

    images: Float[Tensor, "B 3 h w"]
    """Display values in [0, 1]."""
    prompts: Sequence[str]
    seeds: Sequence[int]
    strength: float
    """Amount of change from 0 to 1, the same for all."""
    references: Float[Tensor, "B 3 h w"] | None = None
    """Photographs of their training views."""

    def __len__(self) -> int:
        return len(self.prompts)

    def contents(self) -> list[str]:
        """Digest all inputs that decide a picture's result but the others of its batch, for each picture."""
        inputs = (self.images,) if self.references is None else (self.images, self.references)
        exact = [
            hashlib.sha256(b"".join(map(bytes_of, pictures))).hexdigest() for pictures in zip(*inputs, strict=True)
        ]
        parts = zip(exact, self.seeds, self.prompts, strict=True)
        return [content_key(one, seed, self.strength, prompt) for one, seed, prompt in parts]

    def part(self, first: int, last: int) -> "Batch":
        """Return pictures `first` up to `last`."""
        return Batch(
            images=self.images[first:last],
            prompts=self.prompts[first:last],
            seeds=self.seeds[first:last],
            strength=self.strength,
            references=None if self.references is None else self.references[first:last],
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelSpec:
    """A model and its pipeline."""

    hub: str
    """Its id on the hub."""
    gigabytes: float = 0
    """Size of the download, 10^9 bytes; 0: unknown."""
    loader: str
    """Class of `diffusers` that opens it."""
    accepted: Sequence[str] = ()
    """Classes that its model_index.json may name."""
    networks: Sequence[str] = ()
    """Folders with weights."""
    others: Sequence[str] = ()
    """Folders without weights."""
    factor: int
    """Results are this many times as wide and high."""
    multiple: int = 8
    """Divisor of both sides of a picture, px."""
    least: int = 8
    """Shortest side, px."""
    call: Callable[[Any, Batch, Any], Tensor]
    """(pipeline, pictures, options) -> results, display values."""
    reference: bool = False
    """It takes the photograph of the training view as well."""
    replaced: dict[str, Any] = field(default_factory=dict)
    """Parts that are not loaded, or set otherwise: no picture is marked or blackened."""
    code: Path | None = None
    """File of a pipeline that is not in `diffusers`."""
    part: str = ""
    """Key of its options where a regenerator has several models."""

    @property
    def where(self) -> str:
        """Return the key of its options."""
        role = "upscale" if self.factor > 1 else "restore"
        return ".".join(key for key in ("regenerator", role, self.part) if key)


def bytes_of(picture: Float[Tensor, "3 H W"]) -> bytes:
    """Return shape and values for a digest: flat pictures of different shapes have the same values."""
    return repr(tuple(picture.shape)).encode() + picture.numpy().tobytes()


def steps_for(strength: float, steps: int) -> int:
    """Return `steps`; for 0, as many as let image-to-image, which executes int(steps * strength), execute one.

    floor(1/s) + 1, the authors' rule, which for s = 1 would execute two; ceil(1/s) ends in none for some strengths
    (diffusers).
    """
    return steps or (1 if strength == 1 else math.floor(1 / strength) + 1)


def pictures_of(pipe: Any, batch: Batch, steps: int, guidance: float, **more: Any) -> Tensor:
    """Call a pipeline; returns its pictures, unrounded."""
    generators = [torch.Generator().manual_seed(seed) for seed in batch.seeds]  # one each, independent of the device
    arguments = {"prompt": list(batch.prompts), "image": batch.images, "generator": generators} | more
    return pipe(**arguments, num_inference_steps=steps, guidance_scale=guidance, output_type="pt").images


def upscale_latents(pipe: Any, batch: Batch, options: UpscalerOptions) -> Tensor:
    """Call StableDiffusionLatentUpscalePipeline."""
    return pictures_of(pipe, batch, options.steps, options.guidance)


def upscale_pixels(pipe: Any, batch: Batch, options: UpscalerOptions) -> Tensor:
    """Call StableDiffusionUpscalePipeline."""
    return pictures_of(pipe, batch, options.steps, options.guidance, noise_level=options.noise_level)


def restore(pipe: Any, batch: Batch, options: DiffusionOptions) -> Tensor:
    """Call StableDiffusionXLImg2ImgPipeline; a strength at which no step would be executed changes nothing."""
    steps = steps_for(batch.strength, options.steps) if batch.strength > 0 else 0
    if int(steps * batch.strength) < 1:
        return batch.images
    return pictures_of(pipe, batch, steps, options.guidance, strength=batch.strength)


def redraw(pipe: Any, batch: Batch, options: PipelineOptions) -> Tensor:
    """Call any pipeline that takes `image` and `prompt`."""
    more = dict(options.arguments)
    if options.prompt:
        more["prompt"] = [options.prompt] * len(batch)
    if batch.references is not None:
        more[options.reference] = batch.references
    return pictures_of(pipe, batch, options.steps, options.guidance, **more)


def spec_of(options: PipelineOptions) -> ModelSpec:
    """Return the spec of a pipeline that its options describe."""
    return ModelSpec(
        hub=options.model,
        loader="DiffusionPipeline",
        factor=options.scale,
        multiple=options.multiple,
        least=options.least,
        call=redraw,
        reference=bool(options.reference),
        code=Path(options.custom) if options.custom else None,
        replaced={"custom_pipeline": options.custom, "trust_remote_code": True} if options.custom else {},
    )


SD_X2_LATENT = ModelSpec(
    hub="stabilityai/sd-x2-latent-upscaler",
    gigabytes=2.3,
    loader="StableDiffusionLatentUpscalePipeline",
    accepted=("StableDiffusionLatentUpscalePipeline",),
    networks=("vae", "text_encoder", "unet"),
    others=("tokenizer", "scheduler"),
    factor=2,
    multiple=32,
    least=64,
    call=upscale_latents,
)
SD_X4 = ModelSpec(
    hub="stabilityai/stable-diffusion-x4-upscaler",
    gigabytes=3.5,
    loader="StableDiffusionUpscalePipeline",
    accepted=("StableDiffusionUpscalePipeline",),
    networks=("vae", "text_encoder", "unet"),
    others=("tokenizer", "scheduler", "low_res_scheduler"),
    factor=4,
    call=upscale_pixels,
    replaced={"safety_checker": None, "feature_extractor": None, "watermarker": None},
)
SDXL_TURBO = ModelSpec(
    hub="stabilityai/sdxl-turbo",
    gigabytes=6.9,
    loader="StableDiffusionXLImg2ImgPipeline",
    accepted=("StableDiffusionXLPipeline", "StableDiffusionXLImg2ImgPipeline"),
    networks=("vae", "text_encoder", "text_encoder_2", "unet"),
    others=("tokenizer", "tokenizer_2", "scheduler"),
    factor=1,
    call=restore,
    replaced={"add_watermarker": False},
)


def mirrored(side: int, before: int, after: int) -> Int[Tensor, "n"]:
    """Return pixels 0 to side - 1 with reflections at both ends: -1 is pixel 1, -2 is pixel 2."""
    period = max(1, 2 * side - 2)
    there_and_back = torch.arange(-before, side + after).remainder(period)
    return torch.minimum(there_and_back, period - there_and_back).clamp(max=side - 1)


def padded_to(image: Float[Tensor, "3 h w"], multiple: int, least: int) -> tuple[Float[Tensor, "3 H W"], Window]:
    """Extend a picture to sides that a model takes; returns it and the window of the original in it."""
    height, width = image.shape[1:]
    down, right = (-(-max(side, least) // multiple) * multiple - side for side in (height, width))
    window = Window(left=right // 2, top=down // 2, width=width, height=height)
    rows = mirrored(height, window.top, down - window.top).to(image.device)
    columns = mirrored(width, window.left, right - window.left).to(image.device)
    return image[:, rows][:, :, columns], window
