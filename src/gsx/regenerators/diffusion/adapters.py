"""LoRA adapters: added to a model, kept on disk, taken up again, merged."""

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

ADAPTERS = "lora"
"""Kind of the adapters in the cache."""


WEIGHTS, FACTS = "adapter.safetensors", "adapter.json"


def add_adapter(pipe: Any, tuning: TuningOptions, seed: int) -> list[torch.nn.Parameter]:
    """What is trained: low-rank changes of some layers, zero at first, in float32; everything else is frozen."""
    from peft import LoraConfig

    for network in (pipe.unet, pipe.vae, pipe.text_encoder, pipe.text_encoder_2):
        network.requires_grad_(False)
    with torch.random.fork_rng():  # peft draws from the global generator
        torch.manual_seed(seed)
        pipe.unet.add_adapter(
            LoraConfig(
                r=tuning.rank,
                lora_alpha=tuning.rank,
                init_lora_weights="gaussian",
                target_modules=list(tuning.layers),
            )
        )
    adapted = [parameter for parameter in pipe.unet.parameters() if parameter.requires_grad]
    for parameter in adapted:
        parameter.data = parameter.data.float()
    return adapted


def adapter_bytes(pipe: Any) -> bytes:
    """The adapter as `diffusers` writes it."""
    from peft.utils import get_peft_model_state_dict

    with TemporaryDirectory() as folder:
        pipe.save_lora_weights(folder, unet_lora_layers=get_peft_model_state_dict(pipe.unet), weight_name=WEIGHTS)
        return (Path(folder) / WEIGHTS).read_bytes()


def adopted(shared: Path, own: Path) -> bool:
    """Whether the cache had the adapter; it is then in the run's folder too."""
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
    """Lets later runs have the adapter; a cache that cannot be written is no error."""
    try:
        copy_adapter(own, make_folder(shared))
        add_to_manifest(shared / FACTS)  # which have the digest of the weights
    except (OSError, InputError) as error:
        logger.warning("%s: later runs will learn again", error)


def copy_adapter(source: Path, target: Path) -> None:
    """From folder to folder; what tells that it is whole comes last."""
    target.mkdir(parents=True, exist_ok=True)
    for name in (WEIGHTS, FACTS):
        replace_file(target / name, (source / name).read_bytes())


def read_facts(folder: Path) -> dict[str, Any]:
    """What is known of the adapter in a folder."""
    try:
        facts: dict[str, Any] = json.loads((folder / FACTS).read_text(encoding="utf-8"))
        if hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest() == facts["sha256"]:
            return facts
        problem = f"{WEIGHTS} is not the file that was written"
    except (OSError, ValueError, KeyError) as error:
        problem = str(error)
    raise TrainingError(f"the adapter in {folder} is damaged ({problem}): remove the folder, and it is learnt again")


def merge(pipe: Any, folder: Path) -> None:
    """Adds an adapter to the weights of a model."""
    pipe.load_lora_weights(folder, weight_name=WEIGHTS, local_files_only=True)
    pipe.fuse_lora()
    pipe.unload_lora_weights()
