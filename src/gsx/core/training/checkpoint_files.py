"""Checkpoint files of a folder."""

from pathlib import Path


def sidecars(folder: Path) -> list[Path]:
    """Returns the JSON files of a checkpoint folder, oldest first."""
    return sorted(path for path in folder.glob("step_*.json") if path.stem.removeprefix("step_").isdecimal())


def step_of(sidecar: Path) -> int:
    """Returns the step of a checkpoint."""
    return int(sidecar.stem.removeprefix("step_"))
