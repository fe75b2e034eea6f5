"""Runs with augmenters against their baseline: the same composition and seed without any, on held-out real pixels."""

import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from gsx.core.options import flattened
from gsx.experiments.run_folder.files import RunFiles, part
from gsx.experiments.run_folder.run_key import EVALUATION, NAMES, WHERE
from gsx.experiments.run_folder.shapes import is_number

BESIDE = (*WHERE, *NAMES, *EVALUATION, "augmenter", "regenerator", "seed")
"""Keys in which a run may differ from its baseline, and runs of one comparison from each other (the seed)."""


@dataclass(kw_only=True)
class Comparison:
    """What an augmentation gains over the baseline: differences of each seed, dB."""

    scene: str
    backbone: str
    augmenters: str
    told: str
    """How it differs from others with the same augmenters; empty where there are none."""
    gains: dict[str, list[float]] = field(default_factory=dict)
    """By zoom."""
    cost: list[float] = field(default_factory=list)
    """Training time over that of the baseline."""
    seeds: list[int] = field(default_factory=list)


def compared(runs: Sequence[RunFiles]) -> list[Comparison]:
    """Every augmentation that has a baseline among the runs, in the order of the runs."""
    baselines = {
        (key_of(run), seed_of(run)): run for run in runs if run.evaluation and not part(run.config, "augmenter")
    }
    found: dict[tuple[str, str], Comparison] = {}
    for run in runs:
        baseline = baselines.get((key_of(run), seed_of(run)))
        if baseline is None or not run.evaluation or not part(run.config, "augmenter"):
            continue
        choice = json.dumps([run.config.get("augmenter"), run.config.get("regenerator")], sort_keys=True)
        names = " + ".join(map(str, part(run.config, "augmenter")))
        entry = found.setdefault(
            (key_of(run), choice),
            Comparison(scene=run.scene, backbone=run.backbone.split(" + ")[0], augmenters=names, told=""),
        )
        add(entry, run, baseline)
    told(found)
    return list(found.values())


def key_of(run: RunFiles) -> str:
    """What runs of one comparison share: the composition but for BESIDE, and the protocol."""
    shared = {key: value for key, value in run.config.items() if key not in BESIDE}
    return json.dumps([shared, run.protocol_hash], sort_keys=True, default=str)


def seed_of(run: RunFiles) -> int:
    """The run's seed."""
    seed = run.config.get("seed")
    return int(seed) if is_number(seed) else 0


def add(entry: Comparison, run: RunFiles, baseline: RunFiles) -> None:
    """Count one pair of runs in."""
    for factor, figures in zooms(run).items():
        other = zooms(baseline).get(factor)
        if other is not None:
            entry.gains.setdefault(factor, []).append(figures - other)
    own, other_own = (files.evaluation.get("train_seconds") for files in (run, baseline))
    if is_number(own) and is_number(other_own) and other_own > 0:
        entry.cost.append(own / other_own)
    entry.seeds.append(seed_of(run))


def zooms(run: RunFiles) -> dict[str, float]:
    """PSNR by zoom; x1 always."""
    found = {"1": run.evaluation.get("psnr")}
    found |= {factor: entry.get("psnr") for factor, entry in part(run.evaluation, "zoom").items()}
    return {factor: value for factor, value in found.items() if is_number(value)}


def told(found: dict[tuple[str, str], Comparison]) -> None:
    """Say in what comparisons with the same augmenters differ."""
    groups: dict[tuple[str, str], list[tuple[str, Comparison]]] = {}
    for (shared, choice), entry in found.items():
        groups.setdefault((shared, entry.augmenters), []).append((choice, entry))
    for members in groups.values():
        chosen = [[node for node in json.loads(choice) if isinstance(node, dict)] for choice, _ in members]
        flat = [{key: value for node in nodes for key, value in flattened(node).items()} for nodes in chosen]
        keys = [
            key for key in dict.fromkeys(key for one in flat for key in one) if len({str(f.get(key)) for f in flat}) > 1
        ]
        for one, (_, entry) in zip(flat, members, strict=True):
            entry.told = ", ".join(f"{key}={one.get(key, 'absent')}" for key in keys)


def baseline_rows(runs: Sequence[RunFiles]) -> list[dict[str, Any]]:
    """The comparisons as the template shows them: mean gain and spread over the seeds, by zoom."""
    return [
        {
            "scene": entry.scene,
            "backbone": entry.backbone,
            "augmenters": entry.augmenters,
            "told": entry.told,
            "seeds": len(set(entry.seeds)),
            "gains": {factor: (statistics.fmean(values), spread(values)) for factor, values in entry.gains.items()},
            "cost": statistics.fmean(entry.cost) if entry.cost else None,
        }
        for entry in compared(runs)
    ]


def spread(values: Sequence[float]) -> float:
    """Half the distance from the least to the largest."""
    return (max(values) - min(values)) / 2
