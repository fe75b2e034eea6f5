"""Checkpoints: safetensors and a JSON sidecar with its sha256, written atomically, no pickle.

A checkpoint holds everything that a resumed run needs to continue with the same bits. The sidecar is written last: a
checkpoint without one does not exist. A damaged checkpoint is skipped with a warning. One that this process may not
read, or of another schema, is an error instead: training on from an older one would overwrite it.
"""

import hashlib
import logging
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.errors import CheckpointError, InputError
from gsx.core.files import read_json, refuse_lfs_pointer, replace_file, sidecars, step_of, write_json
from gsx.core.training.parameter_table import restore_table, table_tensors
from gsx.core.training.run import Run
from gsx.experiments.run_folder.shapes import Shape, fits, is_number

logger = logging.getLogger(__name__)

SCHEMA = 1
GENERATOR = "run.generator"
LONGEST = 1e12
"""Upper limit of training time in seconds."""
SIDECAR: Shape = {
    "step": int,
    "seconds": is_number,
    "views": {"train": [str], "test": [str]},
    "sampler": [int],
    "orders?": int,
}


def save(run: Run) -> Path:
    """Write the checkpoint of the current step and remove all but the newest `training.checkpoints_kept`."""
    folder = run.folder / "checkpoints"
    folder.mkdir(parents=True, exist_ok=True)
    path = write(run, folder)
    for old in sidecars(folder)[: -run.training.checkpoints_kept]:
        old.unlink()
        old.with_suffix(".safetensors").unlink(missing_ok=True)
    return path


def write(run: Run, folder: Path) -> Path:
    """Write a checkpoint of the current step into a folder."""
    from safetensors.torch import save as to_bytes

    held = table_tensors(run.backbone.table)
    for prefix, module in run.modules.items():
        held |= {f"{prefix}.{name}": value for name, value in module.state_dict().items()}
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in held.items()}
    tensors[GENERATOR] = run.generator.get_state()
    data = to_bytes(tensors)
    path = folder / f"step_{run.step:07d}.safetensors"
    replace_file(path, data)
    sidecar = {
        "schema": SCHEMA,
        "step": run.step,
        "seconds": run.progress.seconds,
        "sampler": run.sampler.order,
        "orders": run.sampler.orders,
        "views": view_names(run),
        "origin": run.scene.origin,
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    write_json(path.with_suffix(".json"), sidecar)
    return path


def view_names(run: Run) -> dict[str, list[str]]:
    """Return the names of training and test views: a run continues only with the same."""
    return {"train": [v.name for v in run.scene.train], "test": [v.name for v in run.scene.test]}


def read(sidecar: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return sidecar and tensors of one checkpoint.

    Raises:
        CheckpointError: it is missing, truncated, altered, or not what gsx writes.
        InputError: it is of another schema.
        OSError: this process may not read it, or cannot read it now.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load as from_bytes

    path = sidecar.with_suffix(".safetensors")
    try:
        meta, data = read_json(sidecar), path.read_bytes()
    except (FileNotFoundError, ValueError) as error:
        raise unusable(path, f"cannot be read ({error})") from error
    if not isinstance(meta, dict):
        raise unusable(sidecar, "holds no JSON object")
    schema = meta.get("schema")
    if isinstance(schema, int) and schema != SCHEMA:
        raise InputError(
            f"checkpoint {path} has schema {schema}, this gsx reads schema {SCHEMA}: use the version of gsx named in "
            "the run's environment.json, or move the checkpoint away to use an older one"
        )
    refuse_lfs_pointer(path)
    if hashlib.sha256(data).hexdigest() != meta.get("sha256"):
        raise unusable(path, "is truncated or altered")
    if schema != SCHEMA or not is_valid(meta, step_of(sidecar)):
        raise unusable(sidecar, "is not what gsx writes")
    try:
        return meta, from_bytes(data)
    except SafetensorError as error:
        raise unusable(path, f"cannot be read ({error})") from error


def unusable(path: Path, problem: str) -> CheckpointError:
    """Return the error for a damaged checkpoint."""
    return CheckpointError(f"checkpoint {path} {problem}: remove it to use an older one")


def is_valid(meta: dict[str, Any], step: int) -> bool:
    """Return True if a sidecar has the form that `write` gives that of a step."""
    if not fits(meta, SIDECAR) or meta["step"] != step or not 0 <= meta["seconds"] < LONGEST:
        return False
    return meta.get("orders", 0) >= 0 and all(0 <= view < len(meta["views"]["train"]) for view in meta["sampler"])


def newest(folder: Path) -> tuple[dict[str, Any], dict[str, Tensor], list[Path]]:
    """Return sidecar and tensors of a run's newest undamaged checkpoint, and the sidecars of newer damaged ones.

    Raises:
        CheckpointError: there is none.
        InputError, OSError: a newer one is not damaged, but cannot be read here.
    """
    problems, damaged = [], list[Path]()
    for sidecar in reversed(sidecars(folder / "checkpoints")):
        try:
            return *read(sidecar), damaged
        except CheckpointError as error:
            logger.warning("%s", error)
            problems.append(str(error))
            damaged.append(sidecar)
    if problems:
        raise CheckpointError(f"no checkpoint in {folder / 'checkpoints'} is usable: {problems[0]}")
    if (folder / "config.yaml").is_file():
        raise CheckpointError(f"{folder} holds no checkpoint: its run ended before the first one; train anew")
    raise CheckpointError(f"{folder} holds no checkpoint: give the folder of a run (a splat file is not a checkpoint)")


def restore(run: Run, training: bool = False) -> None:
    """Bring a freshly built run to the state of its newest checkpoint.

    training: rename newer damaged checkpoints, which must not outlive good ones. Without it nothing is changed: they
    may be half-written files of another process.

    Raises:
        CheckpointError: there is no usable one, or it is of a run with other views or options.
        InputError, OSError: a newer one is not damaged, but cannot be read here.
    """
    meta, tensors, damaged = newest(run.folder)
    refuse_other_views(run, meta["views"])
    try:
        run.generator.set_state(tensors.pop(GENERATOR).to(torch.uint8))
    except (KeyError, RuntimeError, TypeError) as error:
        raise CheckpointError(f"the checkpoint of {run.folder} has no random state ({error}): remove it") from error
    for prefix, module in run.modules.items():
        names = [name for name in tensors if name.startswith(f"{prefix}.")]
        module.load_state_dict({name.removeprefix(f"{prefix}."): tensors.pop(name) for name in names})
    run.backbone.table = restore_table(run.backbone.table, tensors)
    run.step, run.progress.seconds = int(meta["step"]), float(meta["seconds"])
    run.sampler.order = list(meta["sampler"])
    run.sampler.orders = meta.get("orders", -(-run.step // run.sampler.count))  # older runs do not count orders
    for sidecar in damaged if training and run.ranks.first else ():
        sidecar.rename(sidecar.with_suffix(".damaged"))


def refuse_other_views(run: Run, trained: dict[str, list[str]]) -> None:
    """Raise CheckpointError if the scene has other views, or splits them otherwise, than during training."""
    for part, names in view_names(run).items():
        if names != trained[part]:
            changed = sorted(set(names) ^ set(trained[part]))
            raise CheckpointError(
                f"{run.folder} was trained with other {part} views (now {len(names)}, then {len(trained[part])}; "
                f"first difference: {changed[0] if changed else 'their order'}): restore the scene and its split"
            )
