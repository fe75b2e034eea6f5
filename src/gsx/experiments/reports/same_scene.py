"""Scenes of one name that differ: folders are often called alike (`dense`, `images`), and so are their files."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from gsx.core.data.images import read_image
from gsx.core.errors import GsxError
from gsx.experiments.run_folder.files import RunFiles, part


def number_namesakes(runs: Sequence[RunFiles]) -> list[RunFiles]:
    """Numbers the scenes of one name that differ (`RunFiles.namesake`)."""
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
    """Returns whether scenes in different folders have other pixels in a test photo of one name and size."""
    if part(run.config, "scene").get("path") == part(other.config, "scene").get("path"):
        return False
    truths, others = truths_of(run), truths_of(other)
    return any(unlike(truths[key], others[key]) for key in truths.keys() & others.keys())


def truths_of(run: RunFiles) -> dict[tuple[str, str], Path]:
    """Returns the photos of drawn test views by name and size."""
    return {
        (str(view.get("name")), str(view["size"])): run.folder / "renders" / Path(view["files"]["truth"]).name
        for view in run.pictures.get("views", [])
        if part(view, "files").get("truth")
    }


def unlike(one: Path, other: Path) -> bool:
    """Returns whether two picture files have other pixels; False where one cannot be read."""
    try:
        return one.read_bytes() != other.read_bytes() and not torch.equal(read_image(one), read_image(other))
    except (OSError, GsxError):
        return False
