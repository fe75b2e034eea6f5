"""Scenes of one name that are not one: folders are often called alike (`dense`, `images`), and so are their files."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from gsx.core.data.images import read_image
from gsx.core.errors import GsxError
from gsx.experiments.run_folder.files import RunFiles, part


def told_apart(runs: Sequence[RunFiles]) -> list[RunFiles]:
    """The runs, those of another scene of the same name with its number (`RunFiles.scene`)."""
    first: dict[str, list[RunFiles]] = {}
    out = []
    for run in runs:
        known = first.setdefault(run.scene, [])
        number = next((n for n, other in enumerate(known) if not differ(run, other)), len(known))
        if number == len(known):
            known.append(run)
        out.append(replace(run, namesake=number))
    return out


def differ(run: RunFiles, other: RunFiles) -> bool:
    """Whether runs whose scenes lie in different folders show other pixels in a test photograph of one name and size;
    False where none can be compared."""
    if part(run.config, "scene").get("path") == part(other.config, "scene").get("path"):
        return False
    truths = dict(truths_of(other))
    return any(unlike(file, truths[key]) for key, file in truths_of(run) if key in truths)


def truths_of(run: RunFiles) -> Iterator[tuple[tuple[str, str], Path]]:
    """((name, size), file) of the photographs of test views that a run shows."""
    for view in run.pictures.get("views", []):
        if name := part(view, "files").get("truth"):
            yield (str(view.get("name")), str(view.get("size"))), run.folder / "renders" / Path(str(name)).name


def unlike(one: Path, other: Path) -> bool:
    """Whether two picture files show other pixels; False where one cannot be read."""
    try:
        return one.read_bytes() != other.read_bytes() and not torch.equal(read_image(one), read_image(other))
    except (OSError, GsxError):
        return False
