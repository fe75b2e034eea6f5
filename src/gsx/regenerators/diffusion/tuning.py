"""A LoRA for one scene: the model learns to turn renders of held-out views into their photographs.

It is trained as the run calls it: from the render's latent, noised as little as the strengths of the run allow, it
predicts the photograph's in the one step that image-to-image executes.
"""

import hashlib
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
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
from gsx.regenerators.diffusion import adapters
from gsx.regenerators.diffusion.adapters import FACTS, WEIGHTS
from gsx.regenerators.diffusion.model_specs import Batch, ModelSpec, bytes_of, padded_to, steps_for
from gsx.regenerators.diffusion.models import code_stamp
from gsx.regenerators.diffusion.options import RestorerOptions, TuningOptions
from gsx.regenerators.networks import Pair, held_out_pairs, mean_square, random_part, with_own

LOG_SECONDS = 10.0  # between two lines of progress
logger = logging.getLogger(__name__)
REASONS = {
    "raw": "tuning does not help on held-out renders",
    "renders": "held-out renders are closest to their photographs as they are (regenerator/restore=identity)",
}
"""Why an adapter is not merged, by `closest`."""
WEIGHT_DECAY = 1e-2
LARGEST_NORM = 1.0  # to which gradients are clipped


class Pace:
    """Progress of a batch of work, with an estimate of the time that is left."""

    def __init__(self, name: str, total: int) -> None:
        self.name, self.total, self.done = name, total, 0
        self.start = self.logged = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds since the work began."""
        return time.perf_counter() - self.start

    def advance(self, count: int) -> None:
        """Count finished work, and log it from time to time."""
        self.done += count
        now = time.perf_counter()
        if now - self.logged > LOG_SECONDS and self.done < self.total:
            each = (now - self.start) / self.done
            left = each * (self.total - self.done)
            logger.info("%s: %d of %d, %.1f s each, %.0f s left", self.name, self.done, self.total, each, left)
            self.logged = now


@dataclass(frozen=True, eq=False)
class Tuning:
    """A model, and the scene that it is tuned to."""

    pipe: Any
    options: RestorerOptions
    spec: ModelSpec
    context: RegeneratorContext
    model_digest: str
    """`fingerprint` of the model."""

    def merged(self) -> tuple[str, dict[str, float]]:
        """Merge the adapter of this scene into the model: the run's own, one from the cache, or a new one.

        Returns the adapter's digest and metrics. The digest is empty, and nothing merged, unless the adapter brings
        held-out renders closer to their photographs than the raw model does, and than they are.

        Raises:
            TrainingError: it cannot be learnt or read, or is another model's; the run keeps its checkpoint.
        """
        own = self.context.folder / self.options.name
        if not (own / FACTS).is_file():
            learnt, measured = divide(self.context, self.options.tuning)
            shared = cache_folder(adapters.ADAPTERS, self.key(learnt, measured))
            if not adapters.copy_from_cache(shared, own):
                self.pipe.to(self.context.device)
                complete = self.write_adapter(learnt, measured, own)
                if self.options.cached and complete:  # what the clock has cut short is this run's alone
                    adapters.share(own, shared)
        facts = adapters.read_facts(own)
        if facts.get("model_sha256") != self.model_digest or facts.get("tuning") != asdict(self.options.tuning):
            raise TrainingError(
                f"the adapter in {own} was learnt with other files of the model, or other tuning options: use those "
                "with which the run began, or remove the folder to learn anew"
            )
        metrics = {name: math.nan if value is None else value for name, value in facts["figures"].items()}
        if not facts["used"]:
            return "", metrics
        adapters.merge(self.pipe, own)
        return facts["sha256"], metrics

    def key(self, learnt: Sequence[Pair], measured: Sequence[Pair]) -> str:
        """Return a digest of everything that decides the adapter."""
        digest = hashlib.sha256()
        for part in (image for pair in (*learnt, *measured) for image in pair):
            digest.update(bytes_of(part))
        options = self.options
        machine = (code_stamp(), version("peft"), *machine_stamp(self.context.device))
        deciding = (asdict(options.tuning), options.dtype, options.steps, options.guidance)
        return content_key(self.model_digest, deciding, digest.hexdigest(), self.context.seed, machine)

    def write_adapter(self, learnt: Sequence[Pair], measured: Sequence[Pair], folder: Path) -> bool:
        """Train an adapter, measure before and after, and write it; returns whether all steps were taken."""
        options, context = self.options, self.context
        metrics = {"error_of_renders": mean_square(measured), "error_raw": self.error(measured)}
        start = time.perf_counter()
        try:
            complete = self.learn(learnt)
        except (RuntimeError, ValueError) as error:
            raise TrainingError(
                f"regenerator {options.name} cannot be tuned ({type(error).__name__}: {error}): lower "
                "regenerator.restore.tuning.batch or .crop, set .checkpointing=true, or choose sdxl_turbo_raw"
            ) from error
        metrics["seconds"] = time.perf_counter() - start
        metrics["error_tuned"] = self.error(measured)
        weights = adapters.adapter_bytes(self.pipe)
        self.pipe.unet.delete_adapters("default")
        best = closest(metrics)
        if best != "tuned":
            logger.warning("%s: %s, the model stays as it is", options.name, REASONS[best])
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(folder / WEIGHTS, weights)
        facts = {
            "used": best == "tuned",
            "best": best,
            "whole": complete,
            "figures": metrics,
            "sha256": hashlib.sha256(weights).hexdigest(),
            "model": options.model,
            "model_sha256": self.model_digest,
            "tuning": asdict(options.tuning),
            "views": [view.name for view in context.views],
            "step": context.step,
            "seed": context.seed,
        }
        write_json(folder / FACTS, facts)
        return complete

    @torch.no_grad()
    def error(self, pairs: Sequence[Pair]) -> float:
        """Return the mean squared error of restored renders."""
        return mean_square((self.restored(render, n), photo) for n, (render, photo) in enumerate(pairs))

    def restored(self, render: Float[Tensor, "3 h w"], seed: int) -> Float[Tensor, "3 h w"]:
        """Restore a render as the run does, at the middle of its strengths."""
        image, inside = padded_to(render, self.spec.multiple, self.spec.least)
        tuning = self.options.tuning
        batch = Batch(images=image[None], prompts=[tuning.prompt], seeds=[seed], strength=sum(tuning.strengths) / 2)
        return inside.cut(self.spec.call(self.pipe, batch, self.options)[0].cpu().float().clamp(0, 1))

    def learn(self, pairs: Sequence[Pair]) -> bool:
        """Add an adapter to the model and train it; returns whether all steps were taken."""
        pipe, name, tuning = self.pipe, self.options.name, self.options.tuning
        generator = torch.Generator().manual_seed(self.context.seed)
        adapted = adapters.add_adapter(pipe, tuning, self.context.seed)
        optimiser = torch.optim.AdamW(adapted, lr=tuning.rate, weight_decay=WEIGHT_DECAY)
        rates = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: rate_at(step, tuning))
        crops = self.crops(pairs, generator)
        conditions = conditions_of(pipe, tuning.prompt, crops[0].shape[2:])
        renders, photos = (encoded(pipe, images) for images in crops)
        least, greatest = noise_steps(pipe, self.options)
        progress = Pace(f"{name} is tuned", tuning.steps)
        pipe.unet.train()
        if tuning.checkpointing:
            pipe.unet.enable_gradient_checkpointing()
        for step in range(tuning.steps):
            self.context.raise_if_stopping()
            if tuning.seconds and progress.seconds > tuning.seconds:
                logger.warning("%s is tuned for %d of %d steps: tuning.seconds", name, step, tuning.steps)
                break
            picked = torch.randint(len(renders), (tuning.batch,), generator=generator)
            when = torch.randint(least, greatest + 1, (tuning.batch,), generator=generator)
            noise = torch.randn(renders[picked].shape, generator=generator)
            loss = (one_step(pipe, renders[picked], when, noise, conditions) - photos[picked]).square().mean()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(adapted, LARGEST_NORM)
            optimiser.step()
            rates.step()
            progress.advance(1)
        if tuning.checkpointing:
            pipe.unet.disable_gradient_checkpointing()
        pipe.unet.eval()
        return progress.done == tuning.steps

    def crops(self, pairs: Sequence[Pair], generator: torch.Generator) -> list[Float[Tensor, "N 3 h w"]]:
        """Cut [renders, photographs] at the same places, mirrored at random, to sides that the model takes."""
        crop, spec = self.options.tuning.crop, self.spec
        height, width = (min(crop, *(pair[0].shape[axis] for pair in pairs)) for axis in (1, 2))
        parts = [random_part(pairs, (height, width), generator) for _ in range(self.options.tuning.crops)]
        sides = zip(*parts, strict=True)
        return [torch.stack([padded_to(image, spec.multiple, spec.least)[0] for image in side]) for side in sides]


def closest(metrics: dict[str, float]) -> str:
    """Return which is closest to held-out photographs: tuned, raw, or the renders; of equals the last of these."""
    errors = {"renders": metrics["error_of_renders"], "raw": metrics["error_raw"], "tuned": metrics["error_tuned"]}
    return min(errors, key=lambda name: errors[name] if math.isfinite(errors[name]) else math.inf)


def divide(context: RegeneratorContext, options: TuningOptions) -> tuple[list[Pair], list[Pair]]:
    """Return pairs of most training views to learn from, and the middles of others, spread evenly, to measure on."""
    pairs = held_out_pairs(context, options.halves)
    every = max(2, round(1 / options.held_out))
    measured = range(min(every, len(pairs)) // 2, len(pairs), every)
    learnt = [number for number in range(len(pairs)) if number not in measured]
    return with_own(pairs, context, learnt), [middle(pairs[number], options.crop) for number in measured]


def middle(pair: Pair, crop: int) -> Pair:
    """Cut the middle out of both, `crop` px wide and high at most."""
    height, width = (min(crop, side) for side in pair[0].shape[1:])
    top, left = (pair[0].shape[1] - height) // 2, (pair[0].shape[2] - width) // 2
    window = Window(left=left, top=top, width=width, height=height)
    render, photo = (window.cut(image) for image in pair)
    return render, photo


def rate_at(step: int, tuning: TuningOptions) -> float:
    """Return the factor of the rate: a linear rise times half a cosine."""
    rising = min(1.0, (step + 1) / max(1, tuning.warm_up))
    return rising * 0.5 * (1 + math.cos(math.pi * step / tuning.steps))


def noise_steps(pipe: Any, options: RestorerOptions) -> tuple[int, int]:
    """Return the first and last step of the noise schedule at which image-to-image starts at the run's strengths."""
    schedule = pipe.scheduler
    if schedule.config.prediction_type != "epsilon":
        raise ValueError(f"the model predicts {schedule.config.prediction_type}; only epsilon can be tuned")
    starts = []
    for strength in options.tuning.strengths:
        steps = steps_for(strength, options.steps)
        schedule.set_timesteps(steps)
        starts.append(int(schedule.timesteps[steps - max(1, int(steps * strength))]))
    return min(starts), max(starts)


def conditions_of(pipe: Any, prompt: str, size: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the embedded prompt and the network's other conditions for one picture."""
    with torch.no_grad():
        words, _, pooled, _ = pipe.encode_prompt(prompt, do_classifier_free_guidance=False)
    height, width = size
    times = torch.tensor([[height, width, 0, 0, height, width]], dtype=words.dtype, device=words.device)
    return words, {"text_embeds": pooled, "time_ids": times}


@torch.no_grad()
def encoded(pipe: Any, images: Float[Tensor, "N 3 h w"]) -> Float[Tensor, "N C u v"]:
    """Encode to latents, one picture at a time, in float32 and main memory."""
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
    """Noise latents x as at steps of the schedule and denoise them once: x - sigma eps(x / sqrt(1 + sigma^2))."""
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
