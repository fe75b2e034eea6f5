"""Loading of pipelines from a folder or an id. Nothing uses the network unless `download=true`."""

import hashlib
import json
import logging
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from gsx.core.errors import InputError, TrainingError, first_line
from gsx.core.files import expand_home
from gsx.engine.cache import content_key, source_digest
from gsx.regenerators.diffusion.model_specs import ModelSpec
from gsx.regenerators.diffusion.options import DiffusionOptions

logger = logging.getLogger(__name__)

INDEX = "model_index.json"
PACKAGES = ("diffusers", "transformers", "accelerate")


def find_model(options: DiffusionOptions, spec: ModelSpec) -> Path:
    """Return the folder of a model, fetched first with `download=true`; InputError: it is missing or unusable."""
    folder = expand_home(options.model)
    if not folder.is_dir():
        folder = snapshot(options, spec)
    inspect(folder, options, spec)
    return folder


def snapshot(options: DiffusionOptions, spec: ModelSpec) -> Path:
    """Return the folder of a hub's id in the cache of huggingface_hub."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError

    include, exclude = patterns(options)
    try:
        return Path(
            snapshot_download(
                options.model,
                revision=options.revision,
                allow_patterns=include,
                ignore_patterns=exclude,
                local_files_only=not options.download,
            )
        )
    except HFValidationError:
        why = "it is no folder, and no id of the form owner/model"
    except Exception as error:  # each version of the hub's client raises its own families of errors
        if partial := getattr(error, "snapshot_path", None):  # `inspect` reports what is missing
            return Path(partial)
        why = first_line(error) if options.download else "it is no folder, and not in the cache of the hub's client"
    raise InputError(f"regenerator {options.name} finds no model '{options.model}' ({why}). {remedy(options, spec)}")


def patterns(options: DiffusionOptions) -> tuple[list[str], list[str]]:
    """Return patterns of the files of a model, in the networks' folders, and of those of other variants."""
    weights = f"*/*.{options.variant}*.safetensors" if options.variant else "*/*.safetensors"
    exclude = [] if options.variant else ["*/*.*.safetensors"]
    return [INDEX, "*/*.json", "*/*.txt", "*/*.model", weights], exclude


def remedy(options: DiffusionOptions, spec: ModelSpec) -> str:
    """Return the files and their size, where to put them, and the command that does so, as sentences."""
    name, folder = spec.hub, f"models/{spec.hub.split('/')[-1]}"
    include, exclude = patterns(options)
    filters = " ".join(f"--include '{one}'" for one in include) + "".join(f" --exclude '{one}'" for one in exclude)
    folders = ", ".join((*spec.networks, *spec.others)) or "that it names"
    size = f", about {spec.gigabytes:g} GB" if spec.gigabytes else ""
    return (
        f"It needs {INDEX} and the folders {folders}{size}: hf download {name} {filters} --local-dir {folder}; then "
        f"{spec.where}.model={folder}. Or let gsx fetch it: {spec.where}.download=true. "
        "Without diffusion: budget=quick"
    )


def inspect(folder: Path, options: DiffusionOptions, spec: ModelSpec) -> None:
    """Raise InputError if a folder lacks what the spec needs; weights are checked by their headers."""
    from safetensors import SafetensorError, safe_open

    pipeline = class_named(folder, options, spec)
    if spec.accepted and pipeline not in spec.accepted:
        raise InputError(
            f"regenerator {options.name}: {folder / INDEX} is that of a {pipeline}, and must be that of a "
            f"{' or '.join(spec.accepted)}: set {spec.where}.model to another folder"
        )
    name = f"*.{options.variant}.safetensors" if options.variant else "*.safetensors"
    missing = [part for part in (*spec.networks, *spec.others) if not (folder / part).is_dir()]
    missing += [f"{part}/{name}" for part in spec.networks if not weights_of(folder / part, options)]
    if missing:
        raise InputError(f"regenerator {options.name}: {folder} lacks {', '.join(missing)}. {remedy(options, spec)}")
    if spec.code is not None and not spec.code.is_file():
        raise InputError(f"regenerator {options.name}: there is no file custom={spec.code}")
    for path in all_weights(folder, options):
        try:
            with safe_open(path, framework="pt"):  # fails if the header does not fit the file's length
                pass
        except (OSError, SafetensorError) as error:
            raise InputError(f"regenerator {options.name}: {path} is damaged ({error}): fetch it again") from error


def class_named(folder: Path, options: DiffusionOptions, spec: ModelSpec) -> str:
    """Return the class of pipeline that a folder's index names."""
    try:
        return str(json.loads((folder / INDEX).read_text(encoding="utf-8"))["_class_name"])
    except FileNotFoundError:
        raise InputError(f"regenerator {options.name}: {folder} holds no {INDEX}. {remedy(options, spec)}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"regenerator {options.name}: {folder / INDEX} cannot be read ({error}): fetch it again"
        ) from error


def weights_of(folder: Path, options: DiffusionOptions) -> list[Path]:
    """Return a network's files of weights: NAME.safetensors, or NAME.VARIANT.safetensors, either in numbered pieces."""
    files = sorted(folder.glob("*.safetensors"))
    if options.variant:
        return [path for path in files if path.stem.partition(".")[2].partition("-")[0] == options.variant]
    return [path for path in files if "." not in path.stem]


def all_weights(folder: Path, options: DiffusionOptions) -> list[Path]:
    """Return the files that `diffusers` reads: of each network the variant's, else the plain ones."""
    plain = replace(options, variant="")
    parts = sorted(part for part in folder.iterdir() if part.is_dir())
    return [path for part in parts for path in weights_of(part, options) or weights_of(part, plain)]


def fingerprint(folder: Path, options: DiffusionOptions, spec: ModelSpec) -> str:
    """Return the SHA-256 of all files that decide what a model draws."""
    digest = hashlib.sha256()
    files = [path for path in folder.rglob("*") if path.suffix in (".json", ".txt", ".model", ".py")]
    files += all_weights(folder, options)
    files += [spec.code] if spec.code is not None else []
    for path in sorted(set(files)):
        digest.update(f"{path.name} {path.parent.name} {path.stat().st_size}\n".encode())
        with path.open("rb") as stream:
            while piece := stream.read(1 << 24):
                digest.update(piece)
    return digest.hexdigest()


def code_stamp() -> str:
    """Return a digest of the regenerators' code and of the versions of its libraries: results may change with them."""
    versions = (version(package) for package in ("torch", *PACKAGES, "safetensors"))
    return content_key(source_digest(Path(__file__).parents[1]), *versions)


def number_type(options: DiffusionOptions, device: torch.device) -> torch.dtype:
    """Return the type in which a model computes."""
    name = options.dtype
    if name == "auto":
        name = "bfloat16" if device.type == "cuda" else "float32"
    return {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}[name]


def open_pipeline(folder: Path, options: DiffusionOptions, spec: ModelSpec, dtype: torch.dtype) -> Any:
    """Load the pipeline of a folder into main memory; TrainingError: it cannot be loaded."""
    import diffusers

    for library in ("diffusers", "transformers"):
        logging.getLogger(library).setLevel(logging.ERROR)  # advice about packages that are not needed
    try:
        pipe = getattr(diffusers, spec.loader).from_pretrained(
            folder,
            local_files_only=True,
            use_safetensors=True,
            variant=options.variant or None,
            dtype=dtype,
            **spec.replaced,
        )
    except Exception as error:  # whatever the libraries raise, the run must end in one sentence
        raise TrainingError(
            f"regenerator {options.name}: {folder} cannot be loaded ({type(error).__name__}: {first_line(error)}); "
            "fetch the model again, or choose another"
        ) from error
    pipe.set_progress_bar_config(disable=True)
    autoencoder: Any = getattr(pipe, "vae", None)
    if options.slicing and hasattr(autoencoder, "enable_slicing"):
        autoencoder.enable_slicing()
    if options.tiling and hasattr(autoencoder, "enable_tiling"):
        autoencoder.enable_tiling()
    return pipe


def place(pipe: Any, options: DiffusionOptions, device: torch.device) -> None:
    """Move a pipeline to the device, or as `offload` says."""
    if options.offload != "none" and device.type == "cpu":
        logger.warning("regenerator %s: offload=%s does nothing on the CPU", options.name, options.offload)
    if options.offload == "none" or device.type == "cpu":
        pipe.to(device)
    elif options.offload == "model":
        pipe.enable_model_cpu_offload(device=device)
    else:
        pipe.enable_sequential_cpu_offload(device=device)
