"""Which run a composition is: one name for one training, wherever and however it is carried out."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from gsx.core.cache import content_key
from gsx.core.errors import InputError
from gsx.core.locks import lock
from gsx.core.run_files import RunFiles, part

WHERE = ("folder", "output", "device", "data_root", "tracker", "reuse", "init", "trunk_gb", "trunk_at")
"""Keys that say where and how a run is carried out."""
NAMES = ("variant", "length", "budget", "dataset")
"""Keys that name what other keys hold."""
JUDGING = ("eval", "metrics")
"""Keys of what is looked at when training is over."""
OPERATING = ("cache_gb", "download", "offload", "batch_pixels", "slicing")
"""Keys of scenes and regenerators that say with which means, and change no result."""
WATCHING = ("log_every", "checkpoint_every", "checkpoints_kept", "test_points")
"""Keys of `training` that change nothing at all."""


def trained(config: dict[str, Any]) -> dict[str, Any]:
    """What of a resolved composition decides what is trained."""
    told = (*WHERE, *NAMES, *JUDGING, "regenerator")
    kept = {key: value for key, value in config.items() if key not in told}
    kept["regenerator"] = {role: without(node, OPERATING) for role, node in asked_for(config).items()}
    kept["scene"] = without(part(config, "scene"), OPERATING)
    if dataset := part(config, "dataset"):  # the same scene, wherever its folder lies
        kept["scene"]["path"] = [dataset.get("name"), dataset.get("scene")]
    kept["training"] = {key: value for key, value in part(config, "training").items() if key not in WATCHING}
    return kept


def asked_for(config: dict[str, Any]) -> dict[str, Any]:
    """The regenerators that augmenters may ask for: those of their roles, or all where one does not name its role."""
    nodes = [node for node in part(config, "augmenter").values() if isinstance(node, dict)]
    roles = {node.get("role") for node in nodes}
    return {role: node for role, node in part(config, "regenerator").items() if roles & {role, None}}


def without(node: Any, keys: tuple[str, ...]) -> Any:
    """A node without some keys, at any depth."""
    if not isinstance(node, dict):
        return node
    return {key: without(value, keys) for key, value in node.items() if key not in keys}


def composition_key(config: dict[str, Any]) -> str:
    """A short digest: compositions that train the same have the same."""
    return content_key(sorted_items(trained(config)))


def sorted_items(value: Any) -> Any:
    """A value whose text does not depend on the order in which mappings were written, but for that of augmenters."""
    if isinstance(value, dict):
        items = [(key, inner) for key, inner in value.items()]
        return [
            (key, [(name, sorted_items(node)) for name, node in inner.items()])
            if key == "augmenter" and isinstance(inner, dict)
            else (key, sorted_items(inner))
            for key, inner in sorted(items, key=lambda item: str(item[0]))
        ]
    return [sorted_items(inner) for inner in value] if isinstance(value, list | tuple) else value


def place_of(config: dict[str, Any]) -> Path:
    """The folder of a composition: <output>/<scene>/<backbone>/<digest>."""
    scene = part(config, "scene")
    name = Path(str(scene.get("path") or "")).name or str(scene.get("name"))
    backbone = str(part(config, "backbone").get("name"))
    output = Path(str(config.get("output", "outputs")))
    return output / re.sub(r"[^\w.-]", "_", name) / backbone / composition_key(config)


def judging(config: dict[str, Any]) -> dict[str, Any]:
    """How a composition wants to be judged; saved with every evaluation."""
    return {key: config.get(key) for key in JUDGING}


def finished(files: RunFiles, config: dict[str, Any]) -> bool:
    """Whether a run folder holds all that a composition asks for: trained just so, to the end, and judged the same."""
    return (
        files.status.get("state") == "ok"
        and files.evaluation.get("step") == config["iterations"]
        and files.evaluation.get("judged") == judging(config)
        and composition_key(files.config) == composition_key(config)
    )


@contextmanager
def claimed(folder: Path) -> Iterator[bool]:
    """Whether this process alone works on a folder, as long as the context lasts; the claim of a killed one is void."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / f".{folder.name}.lock").open("w") as stream:
        yield locked(stream, folder)


def locked(stream: IO[str], folder: Path) -> bool:
    """Whether this process has got the lock of an open file.

    Raises:
        InputError: the file system knows no locks.
    """
    try:
        return lock(stream)
    except OSError as error:
        raise InputError(
            f"{folder.parent} lies on a file system without locks ({error.strerror}), which keep processes from "
            "training the same run: choose another place, output=FOLDER"
        ) from error
