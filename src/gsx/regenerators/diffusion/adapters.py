"""LoRA adapters: added to a model, kept on disk, read again, merged."""

import hashlib
import json
import logging
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from gsx.core.errors import InputError, TrainingError
from gsx.core.files import replace_file
from gsx.engine.cache import add_to_manifest, is_intact, make_folder
from gsx.regenerators.diffusion.options import TuningOptions

logger = logging.getLogger(__name__)

ADAPTERS = "lora"  # folder of the cache
WEIGHTS, FACTS = "adapter.safetensors", "adapter.json"


def add_adapter(pipe: Any, tuning: TuningOptions, seed: int) -> list[torch.nn.Parameter]:
    """Add low-rank changes of some layers, zero at first, in float32; freeze the rest; returns what to train."""
    from peft import LoraConfig

    for network in (pipe.unet, pipe.vae, pipe.text_encoder, pipe.text_encoder_2):
        network.requires_grad_(False)
    config = LoraConfig(
        r=tuning.rank, lora_alpha=tuning.rank, init_lora_weights="gaussian", target_modules=list(tuning.layers)
    )
    with torch.random.fork_rng():  # peft draws from the global generator
        torch.manual_seed(seed)
        pipe.unet.add_adapter(config)
    adapted = [parameter for parameter in pipe.unet.parameters() if parameter.requires_grad]
    for parameter in adapted:
        parameter.data = parameter.data.float()
    return adapted


def adapter_bytes(pipe: Any) -> bytes:
    """Return the adapter as `diffusers` writes it."""
    from peft.utils import get_peft_model_state_dict

    with TemporaryDirectory() as folder:
        pipe.save_lora_weights(folder, unet_lora_layers=get_peft_model_state_dict(pipe.unet), weight_name=WEIGHTS)
        return (Path(folder) / WEIGHTS).read_bytes()


def copy_from_cache(shared: Path, own: Path) -> bool:
    """Copy the cache's adapter to the run's folder; returns whether there is one."""
    if not is_intact(shared / FACTS):
        return False
    try:
        read_facts(shared)
        copy_adapter(shared, own)
    except (OSError, TrainingError) as error:
        logger.warning("%s; it is learnt again", error)
        return False
    return True


def share(own: Path, shared: Path) -> None:
    """Copy the run's adapter to the cache; warn if that cannot be written."""
    try:
        copy_adapter(own, make_folder(shared))
        add_to_manifest(shared / FACTS)  # which hold the digest of the weights
    except (OSError, InputError) as error:
        logger.warning("%s: later runs will learn again", error)


def copy_adapter(source: Path, target: Path) -> None:
    """Copy an adapter between folders; the facts come last, as the mark of a whole one."""
    target.mkdir(parents=True, exist_ok=True)
    for name in (WEIGHTS, FACTS):
        replace_file(target / name, (source / name).read_bytes())


def read_facts(folder: Path) -> dict[str, Any]:
    """Read the facts on an adapter; TrainingError: it is damaged."""
    try:
        facts: dict[str, Any] = json.loads((folder / FACTS).read_text(encoding="utf-8"))
        if hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest() == facts["sha256"]:
            return facts
        problem = f"{WEIGHTS} is not the file that was written"
    except (OSError, ValueError, KeyError) as error:
        problem = str(error)
    raise TrainingError(f"the adapter in {folder} is damaged ({problem}): remove the folder, and it is learnt again")


def merge(pipe: Any, folder: Path) -> None:
    """Add an adapter to the weights of a model."""
    pipe.load_lora_weights(folder, weight_name=WEIGHTS, local_files_only=True)
    pipe.fuse_lora()
    pipe.unload_lora_weights()
