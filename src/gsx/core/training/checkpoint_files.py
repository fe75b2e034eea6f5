"""Which checkpoints a folder holds."""

from pathlib import Path


def sidecars(folder: Path) -> list[Path]:
    """Sidecars of a checkpoint folder, oldest first."""
    return sorted(path for path in folder.glob("step_*.json") if path.stem.removeprefix("step_").isdecimal())


def step_of(sidecar: Path) -> int:
    """The step a checkpoint was written at."""
    return int(sidecar.stem.removeprefix("step_"))
