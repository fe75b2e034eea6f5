"""A LoRA for one scene: the model learns to take renders of unseen views to their photographs.

It is trained as it will be called: the render's latent, noised as little as the strengths of the run allow, is to
become the photograph's in the one step that image-to-image executes.
"""

import hashlib
import logging
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.window import Window
from gsx.core.errors import TrainingError
from gsx.core.files import replace_file, write_json
from gsx.core.shapes import Float, Int
from gsx.core.training.regenerator import RegeneratorContext
from gsx.engine.cache import cache_folder, content_key
from gsx.engine.machine import machine_stamp
from gsx.regenerators.diffusion.adapters import (
    ADAPTERS,
    FACTS,
    WEIGHTS,
    adapter_bytes,
    add_adapter,
    adopted,
    merge,
    read_facts,
    share,
)
from gsx.regenerators.diffusion.model_specs import Batch, ModelSpec, steps_for
from gsx.regenerators.diffusion.models import code_stamp
from gsx.regenerators.diffusion.options import RestorerOptions, TuningOptions
from gsx.regenerators.diffusion.pace import Pace
from gsx.regenerators.diffusion.sizes import grown
from gsx.regenerators.pairs import Pair, held_out_pairs, mean_square, random_part, with_own

logger = logging.getLogger(__name__)

REASONS = {
    "raw": "tuning does not help on held-out renders",
    "renders": "held-out renders are closest to their photographs as they are (regenerator/restore=identity)",
}
"""Why an adapter is not merged, by what is closest to the photographs."""


WEIGHT_DECAY = 1e-2
LARGEST_NORM = 1.0
"""To which gradients are clipped."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tuned:
    """What has become of a model."""

    digest: str = ""
    """Of the adapter that was merged into it; empty: none."""
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Pairs:
    """Renders and photographs of training views."""

    own: Sequence[Pair]
    """To learn from."""
    others: Sequence[Pair]
    """To measure on: the middles of views that are not learnt from."""


def tuned(pipe: Any, options: RestorerOptions, spec: ModelSpec, context: RegeneratorContext, files: str) -> Tuned:
    """Merges the adapter of this scene into a model: the run's own, one from the cache, or a new one.

    It must bring held-out renders closer to their photographs than the model as it was does, and than they are.

    Raises:
        TrainingError: it cannot be learnt or read; the run keeps its checkpoint.
    """
    own = context.folder / options.name
    if not (own / FACTS).is_file():
        pairs = divided(context, options.tuning)
        shared = cache_folder(ADAPTERS, key_of(pairs, options, context, files))
        if not adopted(shared, own):
            whole = new_adapter(pipe.to(context.device), options, spec, context, pairs, files, own)
            if options.cached and whole:  # what the clock has cut short is this run's alone
                share(own, shared)
    facts = read_facts(own)
    refuse_another(facts, own, options, files)
    figures = {name: math.nan if value is None else value for name, value in facts["figures"].items()}
    if not facts["used"]:
        return Tuned(figures=figures)
    merge(pipe, own)
    return Tuned(digest=facts["sha256"], figures=figures)


def refuse_another(facts: dict[str, Any], folder: Path, options: RestorerOptions, files: str) -> None:
    """Raises TrainingError if an adapter was learnt for another model, or otherwise."""
    if facts.get("model_sha256") != files or facts.get("tuning") != asdict(options.tuning):
        raise TrainingError(
            f"the adapter in {folder} was learnt with other files of the model, or other tuning options: go on with "
            "those that the run was begun with, or remove the folder to learn anew"
        )


def key_of(pairs: Pairs, options: RestorerOptions, context: RegeneratorContext, files: str) -> str:
    """Of everything that decides what is learnt."""
    digest = hashlib.sha256()
    for part in (image for pair in (*pairs.own, *pairs.others) for image in pair):
        digest.update(bytes_of(part))
    machine = (code_stamp(), version("peft"), *machine_stamp(context.device))
    telling = (asdict(options.tuning), options.dtype, options.steps, options.guidance)
    return content_key(files, telling, digest.hexdigest(), context.seed, machine)


def bytes_of(picture: Float[Tensor, "3 H W"]) -> bytes:
    """Shape and values, for a digest: pictures of one colour and of other shapes have the same values."""
    return repr(tuple(picture.shape)).encode() + picture.numpy().tobytes()


def new_adapter(
    pipe: Any,
    options: RestorerOptions,
    spec: ModelSpec,
    context: RegeneratorContext,
    pairs: Pairs,
    files: str,
    folder: Path,
) -> bool:
    """Learns from most of the pairs, measure on the others before and after, and write what came of it into a folder.

    Returns whether all steps were taken.
    """
    others = pairs.others
    figures = {"error_of_renders": mean_square(others), "error_raw": error_of(pipe, options, spec, others)}
    begun = time.perf_counter()
    try:
        whole = learn(pipe, options, spec, pairs.own, context)
    except (RuntimeError, ValueError) as error:
        raise TrainingError(
            f"regenerator {options.name} cannot be tuned ({type(error).__name__}: {error}): lower "
            "regenerator.restore.tuning.batch or .crop, set .checkpointing=true, or choose sdxl_turbo_raw"
        ) from error
    figures["seconds"] = time.perf_counter() - begun
    figures["error_tuned"] = error_of(pipe, options, spec, others)
    weights = adapter_bytes(pipe)
    pipe.unet.delete_adapters("default")
    best = closest(figures)
    if best != "tuned":
        logger.warning("%s: %s, the model stays as it is", options.name, REASONS[best])
    folder.mkdir(parents=True, exist_ok=True)
    replace_file(folder / WEIGHTS, weights)
    write_json(
        folder / FACTS,
        {
            "used": best == "tuned",
            "best": best,
            "whole": whole,
            "figures": figures,
            "sha256": hashlib.sha256(weights).hexdigest(),
            "model": options.model,
            "model_sha256": files,
            "tuning": asdict(options.tuning),
            "views": [view.name for view in context.views],
            "step": context.step,
            "seed": context.seed,
        },
    )
    return whole


def closest(figures: dict[str, float]) -> str:
    """What is closest to the photographs of held-out renders: tuned, raw, or the renders; the last of equals."""
    errors = {"renders": figures["error_of_renders"], "raw": figures["error_raw"], "tuned": figures["error_tuned"]}
    return min(errors, key=lambda name: errors[name] if math.isfinite(errors[name]) else math.inf)


def divided(context: RegeneratorContext, options: TuningOptions) -> Pairs:
    """Held-out renders of most training views, and of others, spread evenly over the views, to measure on."""
    pairs = held_out_pairs(context, options.halves)
    every = max(2, round(1 / options.held_out))
    measured = range(min(every, len(pairs)) // 2, len(pairs), every)
    learnt = [number for number in range(len(pairs)) if number not in measured]
    return Pairs(
        own=with_own(pairs, context, learnt), others=[middle(pairs[number], options.crop) for number in measured]
    )


def middle(pair: Pair, crop: int) -> Pair:
    """The same part of both, `crop` px wide at most."""
    height, width = (min(crop, side) for side in pair[0].shape[1:])
    top, left = (pair[0].shape[1] - height) // 2, (pair[0].shape[2] - width) // 2
    window = Window(left=left, top=top, width=width, height=height)
    render, photo = (window.cut(image) for image in pair)
    return render, photo


@torch.no_grad()
def error_of(pipe: Any, options: RestorerOptions, spec: ModelSpec, pairs: Sequence[Pair]) -> float:
    """Mean squared error of restored renders."""
    numbered = enumerate(pairs)
    return mean_square((restored(pipe, options, spec, render, n), photo) for n, (render, photo) in numbered)


def restored(
    pipe: Any, options: RestorerOptions, spec: ModelSpec, render: Float[Tensor, "3 h w"], seed: int
) -> Float[Tensor, "3 h w"]:
    """A render after the call that the run makes, half-way between its strengths."""
    image, inside = grown(render, spec.multiple, spec.least)
    strength = sum(options.tuning.strengths) / 2
    batch = Batch(images=image[None], prompts=[options.tuning.prompt], seeds=[seed], strength=strength)
    return inside.cut(spec.call(pipe, batch, options)[0].cpu().float().clamp(0, 1))


def cropped(
    pairs: Sequence[Pair], options: TuningOptions, spec: ModelSpec, generator: torch.Generator
) -> tuple[Float[Tensor, "N 3 h w"], Float[Tensor, "N 3 h w"]]:
    """Crops at the same places of renders and photographs, mirrored at random, of sides that the model takes."""
    height, width = (min(options.crop, *(pair[0].shape[axis] for pair in pairs)) for axis in (1, 2))
    parts = [random_part(pairs, (height, width), generator) for _ in range(options.crops)]
    renders, photos = (
        torch.stack([grown(image, spec.multiple, spec.least)[0] for image in images])
        for images in zip(*parts, strict=True)
    )
    return renders, photos


def learn(
    pipe: Any, options: RestorerOptions, spec: ModelSpec, pairs: Sequence[Pair], context: RegeneratorContext
) -> bool:
    """Gives the model an adapter and train it; whether all steps were taken."""
    generator, tuning = torch.Generator().manual_seed(context.seed), options.tuning
    adapted = add_adapter(pipe, tuning, context.seed)
    optimiser = torch.optim.AdamW(adapted, lr=tuning.rate, weight_decay=WEIGHT_DECAY)
    rates = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: rate_at(step, tuning))
    crops = cropped(pairs, tuning, spec, generator)
    conditions = conditions_of(pipe, tuning.prompt, crops[0].shape[2:])
    renders, photos = (encoded(pipe, images) for images in crops)
    least, greatest = noise_steps(pipe, options)
    progress = Pace(f"{options.name} is tuned", tuning.steps)
    with as_trained(pipe.unet, tuning.checkpointing):
        for step in range(tuning.steps):
            context.raise_if_stopping()
            if tuning.seconds and progress.seconds > tuning.seconds:
                logger.warning("%s is tuned for %d of %d steps: tuning.seconds", options.name, step, tuning.steps)
                return False
            picked = torch.randint(len(renders), (tuning.batch,), generator=generator)
            when = torch.randint(least, greatest + 1, (tuning.batch,), generator=generator)
            noise = torch.randn(renders[picked].shape, generator=generator)
            loss = (one_step(pipe, renders[picked], when, noise, conditions) - photos[picked]).square().mean()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(adapted, LARGEST_NORM)
            optimiser.step()
            rates.step()
            progress.more(1)
    return True


def rate_at(step: int, tuning: TuningOptions) -> float:
    """Share of the rate: it rises, then falls as a cosine."""
    rising = min(1.0, (step + 1) / max(1, tuning.warm_up))
    return rising * 0.5 * (1 + math.cos(math.pi * step / tuning.steps))


def noise_steps(pipe: Any, options: RestorerOptions) -> tuple[int, int]:
    """First and last step of the noise schedule at which image-to-image begins with the strengths of the run."""
    schedule = pipe.scheduler
    if schedule.config.prediction_type != "epsilon":
        raise ValueError(f"the model predicts {schedule.config.prediction_type}; only epsilon can be tuned")
    begins = []
    for strength in options.tuning.strengths:
        steps = steps_for(strength, options.steps)
        schedule.set_timesteps(steps)
        begins.append(int(schedule.timesteps[steps - max(1, int(steps * strength))]))
    return min(begins), max(begins)


def conditions_of(pipe: Any, prompt: str, size: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
    """(embedded prompt, what else the network is told) for one picture."""
    with torch.no_grad():
        words, _, pooled, _ = pipe.encode_prompt(prompt, do_classifier_free_guidance=False)
    height, width = size
    times = torch.tensor([[height, width, 0, 0, height, width]], dtype=words.dtype, device=words.device)
    return words, {"text_embeds": pooled, "time_ids": times}


@torch.no_grad()
def encoded(pipe: Any, images: Float[Tensor, "N 3 h w"]) -> Float[Tensor, "N C u v"]:
    """Latents, one picture at a time, in float32 and in main memory."""
    vae = pipe.vae
    dtype = next(vae.parameters()).dtype
    if vae.config.force_upcast:
        vae.float()
    own = next(vae.parameters())
    latents = [vae.encode((2 * image[None] - 1).to(own)).latent_dist.mean.float().cpu() for image in images]
    vae.to(dtype)
    return torch.cat(latents) * vae.config.scaling_factor


def one_step(
    pipe: Any,
    latents: Float[Tensor, "B C u v"],
    when: Int[Tensor, "B"],
    noise: Float[Tensor, "B C u v"],
    conditions: tuple[Tensor, dict[str, Tensor]],
) -> Float[Tensor, "B C u v"]:
    """Latents, noised as at steps of the schedule, a step of the model later: x - sigma eps(x / sqrt(1 + sigma^2))."""
    words, others = conditions
    device, dtype, count = words.device, words.dtype, len(latents)
    kept = pipe.scheduler.alphas_cumprod[when]
    sigma = ((1 - kept) / kept).sqrt().view(-1, 1, 1, 1).float()
    noisy = latents + sigma * noise
    with torch.autocast(device.type, dtype=dtype, enabled=dtype != torch.float32):
        predicted = pipe.unet(
            (noisy / (sigma.square() + 1).sqrt()).to(device, dtype),
            when.to(device),
            words.expand(count, -1, -1),
            added_cond_kwargs={key: value.expand(count, -1) for key, value in others.items()},
        ).sample
    return noisy - sigma * predicted.float().cpu()


@contextmanager
def as_trained(unet: Any, checkpointing: bool) -> Iterator[None]:
    """A network in its state for training, afterwards in that for use."""
    unet.train()
    if checkpointing:
        unet.enable_gradient_checkpointing()
    try:
        yield
    finally:
        if checkpointing:
            unet.disable_gradient_checkpointing()
        unet.eval()
