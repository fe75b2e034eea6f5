"""Options of diffusion models; values in conf/regenerator, with their sources."""

from dataclasses import dataclass
from typing import Annotated, Any

from gsx.core.options import without_effect
from gsx.core.ranges import Range, Rate, Seconds, Share, Steps

DTYPES = ("auto", "float32", "bfloat16", "float16")
OFFLOADS = ("none", "model", "sequential")


@dataclass(frozen=True, kw_only=True)
class DiffusionOptions:
    """Options of every pipeline: source of the model, use of memory, arguments."""

    name: str
    model: str
    """Folder that holds model_index.json, or an id on the Hugging Face hub."""
    revision: str
    """Branch, tag or commit of an id."""
    variant: str
    """Part of the names of weight files, such as fp16; empty: none."""
    download: bool = without_effect()
    """Fetch an id that is not on this machine; otherwise nothing uses the network."""
    dtype: str
    """auto: bfloat16 on a GPU, float32 on the CPU."""
    offload: str = without_effect()
    """Parts kept in main memory while idle: none, model (whole networks), sequential (layers; slow)."""
    slicing: bool = without_effect()
    """Encode and decode one picture of a batch at a time."""
    tiling: bool
    """Encode and decode large pictures in overlapping tiles; changes results slightly."""
    batch_pixels: Annotated[int, Range(1, 1 << 31)] = without_effect()
    """Pixels of the results of one call; one picture at least."""
    cached: bool = without_effect()
    """Keep results in the cache for later runs."""
    guidance: Annotated[float, Range(0, 1000)]
    """1: none (no second pass without the prompt)."""
    steps: Annotated[int, Range(0, 10000)]
    """Denoising steps; of a restorer 0: as many as make it execute exactly one."""

    def __post_init__(self) -> None:
        where = f"regenerator {self.name}"
        if not self.model:
            raise ValueError(f"{where}: model is empty; give a folder with model_index.json, or an id on the hub")
        if self.dtype not in DTYPES:
            raise ValueError(f"{where}: dtype is '{self.dtype}'; choose from {', '.join(DTYPES)}")
        if self.offload not in OFFLOADS:
            raise ValueError(f"{where}: offload is '{self.offload}'; choose from {', '.join(OFFLOADS)}")


@dataclass(frozen=True, kw_only=True)
class UpscalerOptions(DiffusionOptions):
    """Options of an upscaler."""

    steps: Annotated[int, Range(1, 10000)]
    """Denoising steps."""
    noise_level: Annotated[int, Range(0, 10000)]
    """Noise on the input, as a step of the model's schedule (x4 alone)."""


@dataclass(frozen=True, kw_only=True)
class PipelineOptions(DiffusionOptions):
    """Options of any other pipeline from picture to picture."""

    steps: Annotated[int, Range(1, 10000)]
    """Its num_inference_steps; `guidance` is its guidance_scale."""
    custom: str
    """File of a pipeline that is not in `diffusers`; empty: the class that model_index.json names."""
    scale: Annotated[int, Range(1, 64)]
    """Its results are this many times as wide and high; 1: it restores."""
    multiple: Annotated[int, Range(1, 4096)]
    """Divisor of both sides of a picture, px."""
    least: Annotated[int, Range(1, 4096)]
    """Shortest side, px."""
    prompt: str
    """Prompt in place of the augmenter's; empty: that one."""
    reference: str
    """Argument that takes the photograph of the same training view, enlarged or reduced to the picture's size; empty:
    none."""
    arguments: dict[str, Any]
    """Its other arguments."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.custom and not self.custom.endswith(".py"):
            raise ValueError(f"regenerator {self.name}: custom is '{self.custom}'; give a file ending in .py")
        ours = {"image", "prompt", "generator", "output_type", "num_inference_steps", "guidance_scale", self.reference}
        if taken := sorted(set(self.arguments) & ours):
            raise ValueError(f"regenerator {self.name}: arguments may not hold {', '.join(taken)}: gsx sets them")

    def named_code(self) -> str:
        """Return the file of the pipeline."""
        return self.custom


@dataclass(frozen=True, kw_only=True)
class TuningOptions:
    """Per-scene LoRA on (render, photograph) pairs."""

    steps: Steps
    """Training steps; 0: the model is used as it is."""
    rank: Annotated[int, Range(1, 4096)]
    layers: list[str]
    """Ends of the names of the adapted layers."""
    rate: Rate
    warm_up: Steps
    """Steps in which the rate rises to `rate`."""
    batch: Annotated[int, Range(1, 4096)]
    crop: Annotated[int, Range(1, 4096)]
    """Edge of a training crop, px."""
    crops: Annotated[int, Range(1, 10**6)]
    """Training crops, encoded once."""
    held_out: Share
    """Share of the training views that is held out to measure on."""
    halves: Annotated[float, Range(0, 100)] = 0.35
    """Share of the run's steps so far that the models of half of the views train. The default: older runs."""
    strengths: Annotated[list[float], Range(0, 1)]
    """Least and greatest strength of the run's calls."""
    prompt: str
    seconds: Seconds
    """Learning ends after this time; 0: never. A run cut short by it cannot be repeated bit for bit."""
    checkpointing: bool
    """Compute activations twice to save memory."""

    def __post_init__(self) -> None:
        where = "regenerator.restore.tuning"
        if not (self.rate > 0 and self.halves > 0 and 0 < self.held_out < 1):
            raise ValueError(f"{where}: rate and halves must be above 0, held_out between 0 and 1")
        if len(self.strengths) != 2 or not 0 < self.strengths[0] <= self.strengths[1]:
            raise ValueError(f"{where}.strengths is {list(self.strengths)}; give the least and the greatest, up to 1")


@dataclass(frozen=True, kw_only=True)
class RestorerOptions(DiffusionOptions):
    """Options of a restorer by image-to-image."""

    tuning: TuningOptions

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tuning.steps and self.dtype == "float16":
            raise ValueError(
                f"regenerator {self.name}: gradients vanish in dtype=float16; take bfloat16, float32 or tuning.steps=0"
            )
