"""Runs with augmenters against their baseline: the same composition and seed without any, on held-out real pixels."""

import json
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from gsx.core.options import flattened
from gsx.experiments.run_folder.files import RunFiles, part
from gsx.experiments.run_folder.run_key import EVALUATION, NAMES, WHERE
from gsx.experiments.run_folder.shapes import is_number

FREE = (*WHERE, *NAMES, *EVALUATION, "augmenter", "regenerator", "seed")
"""Keys in which a run may differ from its baseline, and runs of one comparison from each other (the seed)."""


@dataclass(kw_only=True)
class Comparison:
    """Gains of an augmentation over the baseline: differences of each seed, dB."""

    scene: str
    backbone: str
    augmenters: str
    options: dict[str, Any]
    """Options of its augmenters and regenerators, by dotted key."""
    gains: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Gains by zoom."""
    cost: list[float] = field(default_factory=list)
    """Training time over that of the baseline."""
    seeds: list[int] = field(default_factory=list)

    def add(self, run: RunFiles, baseline: RunFiles, seed: int) -> None:
        """Adds one pair of runs."""
        before, now = zooms(baseline), zooms(run)
        for factor in now.keys() & before.keys():
            self.gains[factor].append(now[factor] - before[factor])
        seconds, baseline_seconds = (files.evaluation.get("train_seconds") for files in (run, baseline))
        if is_number(seconds) and is_number(baseline_seconds) and baseline_seconds > 0:
            self.cost.append(seconds / baseline_seconds)
        self.seeds.append(seed)


def compared(runs: Sequence[RunFiles]) -> list[list[Comparison]]:
    """Compares every augmentation that has a baseline among the runs; groups those that differ in options alone."""
    evaluated = [run for run in runs if run.evaluation]
    seeds = [int(seed) if is_number(seed := run.config.get("seed")) else 0 for run in evaluated]
    pairs = list(zip(evaluated, seeds, strict=True))
    baselines = {(key_of(run), seed): run for run, seed in pairs if not part(run.config, "augmenter")}
    groups: dict[tuple[str, str], dict[str, Comparison]] = {}
    for run, seed in pairs:
        baseline = baselines.get((key_of(run), seed))
        if baseline is not None and part(run.config, "augmenter"):
            names = " + ".join(map(str, part(run.config, "augmenter")))
            group = groups.setdefault((key_of(run), names), {})
            backbone, chosen = (
                run.backbone.split(" + ")[0],
                [run.config.get("augmenter"), run.config.get("regenerator")],
            )
            options = flattened(part(run.config, "augmenter")) | flattened(part(run.config, "regenerator"))
            entry = Comparison(scene=run.scene, backbone=backbone, augmenters=names, options=options)
            group.setdefault(json.dumps(chosen, sort_keys=True, default=str), entry).add(run, baseline, seed)
    return [list(group.values()) for group in groups.values()]


def key_of(run: RunFiles) -> str:
    """Returns what runs of one comparison share: the composition except FREE, and the protocol."""
    shared = {key: value for key, value in run.config.items() if key not in FREE}
    return json.dumps([shared, run.protocol_hash], sort_keys=True, default=str)


def zooms(run: RunFiles) -> dict[str, float]:
    """Returns PSNR by zoom; x1 always."""
    figures = {"1": run.evaluation.get("psnr")}
    figures |= {factor: entry.get("psnr") for factor, entry in part(run.evaluation, "zoom").items()}
    return {factor: value for factor, value in figures.items() if is_number(value)}


def baseline_rows(runs: Sequence[RunFiles]) -> list[dict[str, Any]]:
    """Returns the comparisons as the template shows them: mean gain and spread over the seeds, by zoom."""
    return [row_of(entry, group) for group in compared(runs) for entry in group]


def row_of(entry: Comparison, group: Sequence[Comparison]) -> dict[str, Any]:
    """Returns the row of a comparison, with the options in which it differs from others of its group."""
    keys = dict.fromkeys(key for one in group for key in one.options)
    varied = [key for key in keys if len({str(one.options.get(key)) for one in group}) > 1]
    return {
        "scene": entry.scene,
        "backbone": entry.backbone,
        "augmenters": entry.augmenters,
        "differences": ", ".join(f"{key}={entry.options.get(key, 'absent')}" for key in varied),
        "seeds": len(set(entry.seeds)),
        "gains": {factor: (statistics.fmean(values), spread(values)) for factor, values in entry.gains.items()},
        "cost": statistics.fmean(entry.cost) if entry.cost else None,
    }


def spread(values: Sequence[float]) -> float:
    """Returns half the range."""
    return (max(values) - min(values)) / 2
