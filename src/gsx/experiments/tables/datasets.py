"""The datasets of the paper: what they consist of, what is on this machine, and where the rest can be had."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gsx.core.errors import command
from gsx.core.files import expand_home, file_count


def missing(dataset: dict[str, Any], scene: str, root: Path) -> str:
    """Returns why a scene cannot be trained; empty if its files are complete."""
    folder = expand_home(root) / dataset["folder"] / scene if dataset["folder"] else None  # else it is built in
    if folder is None:
        return ""
    if not folder.is_dir():
        return f"{folder} is not there"
    absent = [name for name in dataset["needs"] if not (folder / name).exists()]
    if absent:
        return f"{folder} lacks {', '.join(absent)}"
    published = dataset.get("images", {}).get(scene, 0)
    found = file_count(folder / "images") if published else 0
    few = f"{folder}/images holds {found} of the {published} published images"
    return f"{few} (++dataset.images.{scene}={found} takes them)" if found < published else ""


def licence_of(dataset: dict[str, Any]) -> str:
    """Returns a dataset's licence in words."""
    return (
        f"licence: {dataset.get('licence') or 'none found that its authors state; ask them before you publish with it'}"
    )


def size_of(archive: dict[str, Any]) -> str:
    """Returns an archive's size in words."""
    if size := archive.get("megabytes", 0):
        return f"about {size / 1e3:.3g} GB" if size >= 1e3 else f"about {size} MB"
    return "size unknown until its server states it" if archive.get("url") else "fetched by hand"


def described(dataset: dict[str, Any], root: Path) -> Iterator[str]:
    """Describes a dataset in lines: what is expected, found and missing, and where it can be had."""
    scenes = list(dataset["scenes"])
    lacking = {scene: reason for scene in scenes if (reason := missing(dataset, scene, root))}
    archives = dataset.get("archives", [])
    found = [scene for scene in scenes if scene not in lacking]
    yield f"{dataset['name']}: {dataset['title']}, {len(found)} of {len(scenes)} scenes found"
    if dataset["folder"]:
        yield f"  expected: {root / dataset['folder']}/SCENE with {', '.join(dataset['needs']) or 'its files'}"
    yield f"  found:    {', '.join(found) or 'none'}"
    whole = [scene for scene, reason in lacking.items() if reason.endswith("is not there")]
    if whole:
        yield f"  missing:  {', '.join(whole)}"
    for scene, reason in lacking.items():
        if scene not in whole:
            yield f"  damaged:  {reason}"
    if lacking:
        yield f"  from:     {dataset['obtained']}"
    for archive in archives:
        yield f"  archive:  {archive['file']}, {size_of(archive)}"
    if archives:
        yield f"  {licence_of(dataset).replace(': ', ':  ', 1)}"
    if any(archive.get("url") and lacking.keys() & set(archive["scenes"]) for archive in archives):
        yield f"  fetch:    {command('datasets', '--get', dataset['name'])}"
