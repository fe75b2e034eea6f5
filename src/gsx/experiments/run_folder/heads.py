"""Whether splat files and checkpoints are as long as their heads say; nothing else of them is read."""

import json
from pathlib import Path

from gsx.core.files import read_json
from gsx.core.gaussians.ply import TYPES

MOST_HEADER = 1 << 16
"""Bytes within which the header of a splat file ends."""


def splats_problem(path: Path) -> str:
    """What is wrong with the splat file of a run, as far as its header tells; empty: nothing."""
    try:
        with path.open("rb") as stream:
            length = length_of_ply(stream.read(MOST_HEADER))
        size = path.stat().st_size
    except (OSError, ValueError, LookupError) as error:
        return f"{path.name} cannot be read ({error or type(error).__name__})"
    return "" if size == length else f"{path.name} has {size:,} bytes, its header tells {length:,}"


def length_of_ply(head: bytes) -> int:
    """Bytes of a binary PLY of scalars that begins so.

    Raises:
        ValueError, LookupError: it has no such header.
    """
    header, end, _ = head.partition(b"end_header\n")
    if not (header.startswith(b"ply\nformat binary_little_endian") and end):
        raise ValueError("no complete header of a binary PLY")
    count, length = 0, len(header) + len(end)
    for words in map(str.split, header.decode("latin-1").splitlines()):
        if words[:1] == ["element"]:
            count = int(words[2])
        elif words[:1] == ["property"]:
            length += count * int(TYPES[words[1]][1:])
    return length


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
