"""Whether splat files and checkpoints are as long as their heads say; nothing else of them is read."""

import json
from pathlib import Path

from gsx.core.errors import InputError
from gsx.core.files import read_json
from gsx.formats.detect import MOST_HEADER
from gsx.formats.ply import length_of


def splats_problem(path: Path) -> str:
    """What is wrong with the splat file of a run, as far as its header tells; empty: nothing."""
    try:
        with path.open("rb") as stream:
            length = length_of(stream.read(MOST_HEADER))
        size = path.stat().st_size
    except (OSError, InputError) as error:
        return f"{path.name} cannot be read ({error})"
    return "" if size == length else f"{path.name} has {size:,} bytes, its header tells {length:,}"


def newest_checkpoint(folder: Path) -> int:
    """Step of a run's newest checkpoint; -1: it has none."""
    from gsx.core.training.checkpoint import sidecars, step_of

    return max(map(step_of, sidecars(folder / "checkpoints")), default=-1)


def checkpoint_problem(folder: Path) -> str:
    """What is wrong with a run's newest checkpoint, as far as its sidecar and head tell; empty: nothing, or it is not
    there."""
    from gsx.core.training.checkpoint import sidecars, sound, step_of

    for sidecar in sidecars(folder / "checkpoints")[-1:]:
        tensors = sidecar.with_suffix(".safetensors")
        try:
            meta, size, length = read_json(sidecar), tensors.stat().st_size, length_of_tensors(tensors)
        except FileNotFoundError:
            return ""
        except (OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
            return f"checkpoint {tensors.name} cannot be read ({error})"
        if size != length:
            return f"checkpoint {tensors.name} has {size:,} bytes, its head tells {length:,}"
        if not (isinstance(meta, dict) and sound(meta, step_of(sidecar))):
            return f"checkpoint {sidecar.name} is not what gsx writes"
    return ""


def length_of_tensors(path: Path) -> int:
    """Bytes of a safetensors file by its head.

    Raises:
        OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError: it has none, or cannot be read.
    """
    with path.open("rb") as stream:
        told = int.from_bytes(stream.read(8), "little")
        if told > path.stat().st_size:
            raise ValueError(f"its head would have {told:,} bytes")
        head = json.loads(stream.read(told))
    ends = [entry["data_offsets"][1] for name, entry in head.items() if name != "__metadata__"]
    return 8 + told + max(ends, default=0)
