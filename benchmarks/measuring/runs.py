"""Whole runs as a user starts them: processes of their own, by the command line."""

import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from gsx.core.files import read_json, write_json

STAMP = "%Y-%m-%d %H:%M:%S,%f"
"""Of a line of log.txt."""


def train(
    folder: Path, overrides: Sequence[str], environment: Mapping[str, str] = {}, log: Path | None = None
) -> dict[str, Any]:
    """evaluation.json of `gsx OVERRIDES` in that folder; a run that is finished there is not trained again.

    What a run that was cut off has left is removed. The wall-clock time of the process is kept beside the folder, what
    it prints in `log`.

    Raises:
        subprocess.CalledProcessError: the run failed.
    """
    if not (folder / "evaluation.json").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        begun = time.perf_counter()
        gsx([*overrides, f"folder={folder}"], environment, log)
        write_json(clock_of(folder), {"wall_seconds": time.perf_counter() - begun})
    return read_json(folder / "evaluation.json")


def gsx(words: Sequence[str], environment: Mapping[str, str] = {}, log: Path | None = None) -> None:
    """`gsx WORDS`; what it prints goes to `log`, if one is given.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    command = [sys.executable, "-m", "gsx", *words]
    if log is None:
        subprocess.run(command, check=True, env=os.environ | environment)
        return
    with log.open("w") as stream:
        subprocess.run(command, check=True, env=os.environ | environment, stdout=stream, stderr=subprocess.STDOUT)


def clock_of(folder: Path) -> Path:
    """The file with the wall-clock time of a run's process."""
    return folder.with_name(f"{folder.name}.clock.json")


def wall_seconds(folder: Path) -> float | None:
    """Wall-clock time of the process that made the run, start-up included; None if `train` did not start it."""
    path = clock_of(folder)
    return read_json(path)["wall_seconds"] if path.is_file() else None


def evaluate_seconds(folder: Path, evaluation: Mapping[str, Any]) -> float | None:
    """Seconds of evaluation: as evaluation.json has them, else by the times in log.txt; None where neither tells."""
    if "evaluate_seconds" in evaluation:
        return evaluation["evaluate_seconds"]
    lines = [line for line in (folder / "log.txt").read_text().splitlines() if moment(line)]
    begun = next((moment(line) for line in reversed(lines) if " evaluating " in line), None)
    ended = moment(lines[-1]) if lines else None
    return (ended - begun).total_seconds() if begun and ended else None


def moment(line: str) -> datetime | None:
    """When a line of log.txt was written; None for the further lines of a message."""
    try:
        return datetime.strptime(" ".join(line.split()[:2]), STAMP)
    except ValueError:
        return None


def shown(entry: Mapping[str, Any]) -> str:
    """PSNR of a zoomed render, and of the x1 render resized."""
    return f"{entry['psnr']:.2f} ({entry['enlarged_psnr']:.2f})"


def in_shell(overrides: Sequence[str]) -> str:
    """The command as it is typed."""
    return shlex.join(["gsx", *overrides])
