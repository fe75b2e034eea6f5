"""Every numeric option at values nobody means: refused before a folder exists, or a run that ends finite or guarded."""

import math
import resource
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from tiny import OVERRIDES

from faults.children import Ended, command, in_child, preload
from faults.record import record
from gsx.builtin import plugins
from gsx.core.options import flattened
from gsx.experiments.runs.compose import compose

pytestmark = pytest.mark.faults

VALUES = ["-1", "0", "1e308", str(2**64), "nan", "inf", "-inf"]
CHEAP = ["regenerator/upscale=lanczos", "regenerator/restore=identity", "rasterizer=eager", "iterations=2",
         "training.log_every=1"]  # fmt: skip
SUBJECTS = {
    "gs3d": [*OVERRIDES, *CHEAP, "augmenter=[upscale,bootstrap]"],
    "octree_scaffold": [*OVERRIDES[1:], *CHEAP, "backbone=octree_scaffold"],
    "octree_gs3d": [*OVERRIDES[1:], *CHEAP, "backbone=octree_gs3d"],
}
"""Compositions whose numbers are tried; of the later ones those that earlier ones do not have."""
ENDLESS = {"iterations", "length"}
"""Keys that make a run long, which is what is asked for."""
MEMORY, SECONDS = 8 << 30, 60
"""What a run may take: bytes of data, seconds."""


def numeric(words: list[str]) -> list[str]:
    """Keys of a composition that hold numbers, those of lists as wholes."""

    def is_number(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool)

    flat = flattened(compose(words, plugins()).resolved)
    return [key for key, value in flat.items() if is_number(value) and key not in ENDLESS]


def keys() -> list[tuple[str, str]]:
    """(subject, key), each key once."""
    found: dict[str, str] = {}
    for subject, words in SUBJECTS.items():
        found = dict.fromkeys(numeric(words), subject) | found
    return [(subject, key) for key, subject in found.items()]


def bounded(words: list[str]) -> int:
    """The command line in bounded memory and time."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    signal.alarm(SECONDS)
    return command(words)


def finite(folder: Path) -> bool:
    """Whether there is a model, and all of it is finite."""
    tensors = load_file(sorted((folder / "checkpoints").glob("*.safetensors"))[-1])
    return all(bool(torch.isfinite(value.double()).all()) for value in tensors.values())


def problem(ended: Ended, folder: Path, value: str) -> str:
    """What is wrong with how a run ended; empty: nothing."""
    if ended.code == 0:
        if not math.isfinite(float(value)):
            return "a number that is none is taken"
        return "" if finite(folder) else "the model is not finite"
    sentences = [line for line in ended.said.splitlines() if line.startswith("gsx: ")]
    if ended.code != 2 or len(sentences) != 1 or "Traceback" in ended.said:
        last = (ended.said.strip().splitlines() or [""])[-1]
        return f"code {ended.code}: {last[:200]}"
    return ""


@pytest.mark.parametrize("part", range(8))
def test_every_number(tmp_path: Path, part: int) -> None:
    wrong = []
    preload(SUBJECTS["gs3d"] + [f"folder={tmp_path / 'run'}"], tmp_path / "first")
    with record("a numeric option at -1, 0, 1e308, 2^64, nan, inf, -inf", part) as counts:
        for subject, key in keys()[part::8]:
            for value in VALUES:
                place = tmp_path / "place"
                words = [*SUBJECTS[subject], f"{key}={value}", f"folder={place / 'run'}"]
                found = problem(in_child(lambda words=words: bounded(words), place), place / "run", value)
                if found:
                    wrong.append(f"{key}={value} ({subject}): {found}")
                counts.cases += 1
                shutil.rmtree(place, ignore_errors=True)
        assert not wrong, "\n".join(wrong)
