"""Quick checks of splat files and checkpoints: their length against their headers."""

from pathlib import Path

from gsx.core.errors import InputError
from gsx.core.files import read_json
from gsx.formats.detect import MOST_HEADER
from gsx.formats.ply import length_of


def splats_problem(path: Path) -> str:
    """Describe what is wrong with a splat file by its header; empty: nothing."""
    try:
        with path.open("rb") as stream:
            length = length_of(stream.read(MOST_HEADER))
        size = path.stat().st_size
    except (OSError, InputError) as error:
        return f"{path.name} cannot be read ({error})"
    return "" if size == length else f"{path.name} has {size:,} bytes, its header says {length:,}"


def newest_checkpoint(folder: Path) -> int:
    """Return the step of a run's newest checkpoint; -1: it has none."""
    from gsx.core.training.checkpoint_files import sidecars, step_of

    return max(map(step_of, sidecars(folder / "checkpoints")), default=-1)


def checkpoint_problem(folder: Path) -> str:
    """Describe what is wrong with a run's newest checkpoint by its sidecar and header; empty: nothing, or none."""
    from safetensors import SafetensorError, safe_open

    from gsx.core.training.checkpoint_files import sidecars, step_of
    from gsx.experiments.run_folder.checkpoint import is_valid

    for sidecar in sidecars(folder / "checkpoints")[-1:]:
        tensors = sidecar.with_suffix(".safetensors")
        try:
            meta = read_json(sidecar)
            with safe_open(tensors, "numpy"):  # compares the file's size with its header
                pass
        except FileNotFoundError:
            return ""
        except (OSError, ValueError, SafetensorError) as error:
            return f"checkpoint {tensors.name} cannot be read ({error})"
        if not (isinstance(meta, dict) and is_valid(meta, step_of(sidecar))):
            return f"checkpoint {sidecar.name} is not what gsx writes"
    return ""
