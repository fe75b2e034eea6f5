"""Every numeric option at values nobody means: refused before there is a folder, or a finite model."""

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
from faults.record import record, some
from gsx.builtin import plugins
from gsx.core.options import flattened
from gsx.experiments.runs.compose import compose
from gsx.formats.ply import read_ply

pytestmark = pytest.mark.faults

PARTS = 8
VALUES = ["-1", "0", "1e308", str(2**64), "nan", "inf", "-inf"]
CHEAP = ["rasterizer=eager", "iterations=2", "training.log_every=1"]
SUBJECTS = {
    "gs3d": [*OVERRIDES, *CHEAP, "regenerator/upscale=lanczos", "regenerator/restore=identity",
             "augmenter=[upscale,bootstrap]",
             *(f"augmenter.{name}.checks.{check}.action=warn" for name in ("upscale", "bootstrap")
               for check in ("colour", "agreement", "displacement"))],
    "regenerators": [*OVERRIDES, *CHEAP],
    "mip_splatting": [*OVERRIDES[1:], *CHEAP, "backbone=mip_splatting"],
    "scaffold": [*OVERRIDES[1:], *CHEAP, "backbone=scaffold"],
    "octree_scaffold": [*OVERRIDES[1:], *CHEAP, "backbone=octree_scaffold"],
    "octree_gs3d": [*OVERRIDES[1:], *CHEAP, "backbone=octree_gs3d"],
}  # fmt: skip
"""Compositions whose numbers are tried; of the later ones those that earlier ones do not have."""
ENDLESS = {"iterations", "length"}
"""Keys that make a run long, which is what is asked for."""
MEMORY, SECONDS = 8 << 30, 60
"""What a run may take: bytes of data, seconds."""


def is_number(value: Any) -> bool:
    """Whether an option holds a number, or a list of them."""
    if isinstance(value, list):
        return bool(value) and all(map(is_number, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def tried() -> list[tuple[str, str, str]]:
    """(subject, key, value): each key once."""
    found: dict[str, tuple[str, Any]] = {}
    for subject, words in SUBJECTS.items():
        flat = flattened(compose(words, plugins()).resolved)
        numbers = {key: value for key, value in flat.items() if is_number(value) and key not in ENDLESS}
        found = {key: (subject, value) for key, value in numbers.items()} | found
    return [
        (subject, key, f"[{','.join([value] * len(usual))}]" if isinstance(usual, list) else value)
        for key, (subject, usual) in found.items()
        for value in VALUES
    ]


def bounded(words: list[str]) -> int:
    """The command line in bounded memory and time."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    signal.alarm(SECONDS)
    return command(words)


def problem(ended: Ended, folder: Path, value: str) -> str:
    """What is wrong with how a run ended; empty: nothing."""
    if ended.code == 0:
        if not math.isfinite(float(value.strip("[]").split(",")[0])):
            return "a number that is none is taken"
        tensors = load_file(sorted((folder / "checkpoints").glob("*.safetensors"))[-1])
        sound = all(bool(torch.isfinite(one.double()).all()) for one in tensors.values())
        sound = sound and len(read_ply(folder / "point_cloud.ply")["x"]) > 0
        return "" if sound else "the model is not finite"
    if ended.code != 2 or len(ended.sentences) != 1 or "Traceback" in ended.said:
        last = (ended.said.strip().splitlines() or [""])[-1]
        return f"code {ended.code}: {last[:200]}"
    return f"refused when there was a folder: {ended.sentences[0][:200]}" if folder.exists() else ""


@pytest.mark.parametrize("part", range(PARTS))
def test_every_number(tmp_path: Path, part: int) -> None:
    wrong = []
    preload([*SUBJECTS["gs3d"], f"folder={tmp_path / 'run'}"], tmp_path / "first")
    with record("a numeric option at -1, 0, 1e308, 2^64, nan, inf, -inf", part) as counts:
        for subject, key, value in some(tried()[part::PARTS]):
            place = tmp_path / "place"
            words = [*SUBJECTS[subject], f"{key}={value}", f"folder={place / 'run'}"]
            found = problem(in_child(lambda words=words: bounded(words), place), place / "run", value)
            if found:
                wrong.append(f"{key}={value} ({subject}): {found}")
            counts.cases += 1
            shutil.rmtree(place, ignore_errors=True)
        assert not wrong, "\n".join(wrong)
