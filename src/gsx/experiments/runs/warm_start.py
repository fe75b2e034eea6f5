"""States that runs share until their first pseudo views: trained once, kept in the cache, and branched from.

With `init=warm_start` a run starts from the latest kept state of an earlier run that differs only in its augmenters,
and keeps states for later ones. The result has the same bits as a run from scratch.
"""

import hashlib
import json
import logging
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsx.core.errors import CheckpointError, InputError
from gsx.core.files import read_json, replace_file, replace_text, write_json
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run, StepResult
from gsx.engine.cache import (
    add_to_manifest,
    cache_folder,
    content_key,
    file_stamp,
    is_intact,
    make_folder,
    source_revision,
    trim,
)
from gsx.engine.machine import machine_stamp
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.run_folder.run_key import scene_stamp, trained

logger = logging.getLogger(__name__)

BRANCH = "branch.json"
"""File of a run that branched, with the step and the seconds of training saved."""

SHARES = (10 / 40, 15 / 40, 20 / 40, 22 / 40, 30 / 40)
"""Shares of a run after which states are kept: where the paper's variants begin (the paper, Experimental Setup), and
last where conf/augmenter/upscale does."""


def common_steps(run: Run) -> int:
    """Return the steps that a run shares with its baseline: up to the first pseudo views, or all of them."""
    return min([run.iterations, *(augmenter.begins() for augmenter in run.augmenters.values())])


def warm_start_folder(run: Run, idle: Collection[str], plugins: Mapping[str, str]) -> Path:
    """Return the folder of states of such runs; `idle`: keys that change no result; `plugins`: versions."""
    machine = (*machine_stamp(run.device), run.raster.path)
    parts = (
        json.dumps(trained(without_augmenters(run.config), idle), sort_keys=True, default=str),
        scene_stamp(run.config),  # lines that are kept with a state include test views
        training_data_digest(run),
        source_revision(),
        sorted(plugins.items()),
        machine,
    )
    return cache_folder("warm_starts", content_key(*parts))


def without_augmenters(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the composition of the baseline."""
    return {key: value for key, value in config.items() if key not in ("augmenter", "regenerator", "checks")}


def training_data_digest(run: Run) -> str:
    """Return a digest of the training data: cameras, points, and the files of photos."""
    digest = hashlib.sha256(run.scene.points.positions.numpy().tobytes())
    digest.update(run.scene.points.colours.numpy().tobytes())
    for view in run.scene.train:
        camera = view.camera
        digest.update(camera.rotation.numpy().tobytes() + camera.translation.numpy().tobytes())
        digest.update(repr((view.name, camera.size, camera.fx, camera.fy, camera.cx, camera.cy)).encode())
        digest.update(b"" if camera.lens is None else repr(camera.lens).encode())
        digest.update(repr("" if view.file is None else file_stamp(view.file)).encode())
    return digest.hexdigest()


def adopt(run: Run, folder: Path) -> None:
    """Bring a new run to the latest kept state that it shares with an earlier one, if there is any."""
    common = common_steps(run)
    for sidecar in reversed([path for path in checkpoint.sidecars(folder) if checkpoint.step_of(path) <= common]):
        try:
            checkpoint.read(sidecar)
            if not is_intact(lines_at(sidecar)):
                raise CheckpointError(f"{sidecar} lacks the lines up to its step")
            branch(run, sidecar)
        except (CheckpointError, OSError) as error:
            logger.warning("%s", error)
            with suppress(OSError):
                sidecar.unlink()  # it is kept again
            continue
        return
    logger.info("init=warm_start: no earlier run of this composition to branch from; its states will be kept")


def branch(run: Run, sidecar: Path) -> None:
    """Start from a kept state: copy its checkpoint and its lines of metrics.jsonl."""
    checkpoints = run.folder / "checkpoints"
    checkpoints.mkdir(parents=True, exist_ok=True)
    tensors, lines = sidecar.with_suffix(".safetensors"), read_json(lines_at(sidecar))["lines"]
    replace_file(checkpoints / tensors.name, tensors.read_bytes())
    replace_text(run.folder / "metrics.jsonl", "".join(json.dumps(line) + "\n" for line in lines))
    replace_file(checkpoints / sidecar.name, sidecar.read_bytes())  # last: without it a checkpoint does not exist
    checkpoint.restore(run, training=True)
    write_json(run.folder / BRANCH, {"step": run.step, "seconds": run.progress.seconds})
    logger.info(
        "init=warm_start: branching at step %d from an earlier run, %.0f s saved", run.step, run.progress.seconds
    )


def lines_at(sidecar: Path) -> Path:
    """Return the file with the lines of metrics.jsonl up to a kept state."""
    return sidecar.with_name(f"lines_{sidecar.stem}.json")


class WarmStartKeeper:
    """Listener that keeps states for other runs to branch from."""

    def __init__(self, folder: Path, gigabytes: float, steps: Collection[int] = ()) -> None:
        self.folder, self.gigabytes, self.steps = folder, gigabytes, steps

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Keep this state if runs can share it; a cache that cannot be written is not an error."""
        common = common_steps(run)
        steps = {*(self.steps or (round(share * run.iterations) for share in SHARES)), common}
        if run.step not in steps or run.step > common or run.complete:
            return
        try:
            self.keep(run)
        except (OSError, InputError) as error:
            logger.warning("init=warm_start: the state of step %d is not kept (%s)", run.step, error)

    def keep(self, run: Run) -> None:
        """Write the state to the cache."""
        folder = make_folder(self.folder)
        kept = [path for path in checkpoint.sidecars(folder) if checkpoint.step_of(path) == run.step]
        if kept and is_intact(lines_at(kept[0])):
            return
        lines = lines_at(folder / f"step_{run.step:07d}.json")
        write_json(lines, {"lines": run.progress.curves})
        add_to_manifest(lines)
        checkpoint.write(run, folder)  # its sidecar has the digest of its tensors
        trim(self.gigabytes)
