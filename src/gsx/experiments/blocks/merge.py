"""One splat file of runs that trained on the blocks of a scene: each gives the splats in its cell."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import pad

from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.core.options import flattened
from gsx.core.plugins import Plugins
from gsx.experiments.run_folder.run_key import UNCHANGED
from gsx.experiments.runs.bake import bake
from gsx.experiments.runs.export import explicit_of, refuse_export, write_model
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.overrides import words_of
from gsx.experiments.runs.saved_settings import read_config
from gsx.experiments.runs.settings import COMPETITOR, SEVERAL, Settings
from gsx.scenes.blocks import parsed_block, scene_cells

logger = logging.getLogger(__name__)

BLOCK = "scene.block"
FREE = (BLOCK, "scene.block_margin", "scene.block_share", "scene.cache_gb", "scene.iterations")
"""Settings of the scene in which blocks may differ."""


@dataclass(frozen=True, kw_only=True)
class Trained:
    """Run on a block."""

    folder: Path
    settings: Settings


def merge_blocks(folders: Sequence[Path], path: Path, plugins: Plugins) -> list[str]:
    """Writes the splats of all blocks as one file; returns the settings of the whole scene.

    Raises:
        ConfigError, InputError: a run is on no block, a block is missing or twice, runs are on different scenes or of
            different rules, or the format cannot hold the model.
    """
    refuse_export(path)
    blocks = ordered([Trained(folder=one, settings=settings_of(one, plugins)) for one in folders])
    refuse_different(blocks)
    whole = settings_of(blocks[0].folder, plugins, [f"{BLOCK}=''"])
    cells = scene_cells(load_scene(whole), len(blocks))
    parts, run = list[Gaussians](), None
    for block, cell in zip(blocks, cells, strict=True):
        run, _ = open_run(block.folder, plugins)
        gaussians = explicit_of(run, None) or bake(run)
        inside = cell.holds(gaussians.means.detach().cpu())
        word = block.settings.resolved["scene"]["block"]
        logger.info("block %s: %d of %d splats are in its cell", word, int(inside.sum()), len(inside))
        parts.append(Gaussians(**{name: value.detach().cpu()[inside] for name, value in vars(gaussians).items()}))
    assert run is not None
    write_model(run, joined(parts), path, [f"merged of {len(parts)} blocks"])
    scene, zooms = dict(whole.resolved["scene"]), whole.resolved["eval"]["zoom"]
    return [f"scene={scene.pop('name')}", *words_of({"scene": scene, "eval": {"zoom": zooms}})]


def settings_of(folder: Path, plugins: Plugins, overrides: Sequence[str] = ()) -> Settings:
    """Reads the settings of a run, with some of its keys set to other values."""
    return read_config(folder / "config.yaml", plugins, overrides, (*SEVERAL, COMPETITOR))


def ordered(runs: Sequence[Trained]) -> list[Trained]:
    """Returns runs in the order of their blocks; InputError: one is on no block, or a block is missing or twice."""
    found: dict[int, Trained] = {}
    counts: dict[int, Path] = {}
    for run in runs:
        word = run.settings.resolved["scene"].get("block", "")
        if not word:
            raise InputError(f"'{run.folder}' was trained on a whole scene: give runs with {BLOCK}=NUMBER/COUNT")
        number, count = parsed_block(word)
        if number in found:
            raise InputError(f"'{found[number].folder}' and '{run.folder}' are both on block {word}: give one of them")
        found[number], counts[count] = run, run.folder
    if len(counts) > 1:
        raise InputError(f"runs are on blocks of {' and '.join(map(str, sorted(counts)))}: give those of one division")
    (count,) = counts
    if missing := [f"{number}/{count}" for number in range(1, count + 1) if number not in found]:
        raise InputError(f"there is no run on block {', '.join(missing)}: train it with {BLOCK}={missing[0]}")
    return [found[number] for number in sorted(found)]


def refuse_different(blocks: Sequence[Trained]) -> None:
    """Raises InputError if runs are on different scenes, or draw by different rules."""
    first = drawn_alike(blocks[0].settings)
    for block in blocks[1:]:
        other = drawn_alike(block.settings)
        if differing := [key for key in first.keys() | other.keys() if first.get(key) != other.get(key)]:
            key = sorted(differing)[0]
            raise InputError(
                f"'{blocks[0].folder}' has {key}={first.get(key)}, and '{block.folder}' has {other.get(key)}: merge "
                "runs that differ in their block alone"
            )


def drawn_alike(settings: Settings) -> dict[str, Any]:
    """Returns the settings that merged runs have in common: scene, type of model, and rules of the rasterizer.

    Settings that older runs lack do not count with the values by which they change nothing.
    """
    values = {key: value for key, value in flattened(settings.resolved).items() if UNCHANGED.get(key, ...) != value}
    rules = ("rasterizer.dilation", "rasterizer.compensate", "backbone.name", "backbone.filter")
    scene = {key: value for key, value in values.items() if key.startswith("scene.") and key not in FREE}
    return scene | {key: values[key] for key in rules if key in values}


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """Returns all splats in one table; bands of harmonics that a part lacks are 0."""
    bands = max(part.sh_rest.shape[1] for part in parts)
    padded = [{**vars(part), "sh_rest": pad(part.sh_rest, (0, 0, 0, bands - part.sh_rest.shape[1]))} for part in parts]
    return Gaussians(**{name: torch.cat([part[name] for part in padded]) for name in padded[0]})
