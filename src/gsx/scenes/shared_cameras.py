"""Decision whether other cameras fit a COLMAP model better, and the model with them.

`camera_groups` proposes them, `held_out` compares. The comparison takes minutes in large models: the cache keeps it.
"""

import logging
from collections.abc import Hashable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsx.core.errors import InputError
from gsx.core.files import is_file, read_json, write_json
from gsx.engine.cache import add_to_manifest, cache_folder, content_key, file_stamp, is_intact, make_folder
from gsx.scenes.bundle import move, prepared, registered
from gsx.scenes.camera_groups import Lenses, Proposal, proposal
from gsx.scenes.colmap_folders import model_files
from gsx.scenes.colmap_model import Model
from gsx.scenes.exif import lens_of
from gsx.scenes.held_out import SURE, Result, adjusted, candidates, compare, restored

logger = logging.getLogger(__name__)

METHOD = "cameras/1"  # part of the cache key: raise the number when the comparison changes
FILE = "comparison.json"
ANEW = "reconstruct the photos with scene=photos"
VERDICTS = {"one": "should be one", "two": "should be two"}


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Outcome of the comparison of proposed cameras with a model's own."""

    words: str = ""
    """Proposal, figures of all candidates, threshold and verdict, as one clause."""
    name: str = ""
    """Name of the candidate that replaces the cameras; empty: they stay."""


def camera_key(model: Model) -> tuple[object, ...]:
    """Return what identifies a model's files and the estimator, for keys of the cache."""
    import pycolmap

    stamps = [file_stamp(file) for file in model_files(model.folder).values()]
    return str(pycolmap.__version__), str(model.folder.resolve()), stamps


def proposal_of(model: Model, photos: Path) -> Proposal | None:
    """Return other cameras that may fit a model with photos in a folder better; None: nothing speaks for any."""
    return proposal(model, lenses_of(model, photos))


def lenses_of(model: Model, photos: Path) -> Lenses:
    """Return the lens of each photo that is there and readable."""
    found = {}
    for image in model.images:
        with suppress(InputError):
            if is_file(photos / image.name):
                found[image.name] = lens_of(photos / image.name)
    return found


# -- decision ----------------------------------------------------------------------------------------------------------


def decide(model: Model, proposed: Proposal) -> Decision:
    """Compare the proposed cameras with a model's own, or read that from the cache; InputError: an adjustment fails."""
    if proposed.thin:
        return Decision(words=f"{proposed.words}: undecided, too few observations: {ANEW}")
    compared = kept_comparison(model, proposed)
    if compared is None:
        compared = comparison(model, proposed)
        keep_comparison(model, proposed, compared)
    return decision(proposed, compared)


def decision(proposed: Proposal, compared: Mapping[str, Any]) -> Decision:
    """Return the verdict on a comparison: the candidate with the largest gain, if that is sure."""
    if compared["refusal"]:
        return Decision(words=f"{proposed.words}: undecided, {compared['refusal']}")
    baseline, *others = [Result(**fields) for fields in compared["results"]]
    best = max(others, key=lambda one: one.gain)
    verdict = VERDICTS[proposed.kind] if best.better() else "right as they are" if best.worse() else "undecided"
    figures = [f"{baseline.name} {baseline.median:.3f} px", *map(figure, others)]
    return Decision(
        words=f"{proposed.words}: held-out keypoints ({compared['held']}) are off by {', '.join(figures)}; {verdict} "
        f"(threshold {SURE:g} standard errors)",
        name=best.name if best.better() else "",
    )


def figure(one: Result) -> str:
    """Write the error of a candidate and its gain in standard errors."""
    gain = one.gain / one.error if one.error else 0.0
    side = "better" if gain > 0 else "worse"
    return f"{one.name} {one.median:.3f} px ({side} by {abs(gain):.1f} standard errors)"


def evidence_words(model: Model, proposed: Proposal) -> str:
    """Describe a proposal for `gsx scenes`: with the verdict if it was compared before, else with the remedy."""
    compared = None if proposed.thin else kept_comparison(model, proposed)
    if proposed.thin or compared is not None:
        return decide(model, proposed).words
    return f"{proposed.words}: scene.adjust=auto compares them with {OTHERS[proposed.kind]} on held-out keypoints"


OTHERS = {"one": "shared cameras", "two": "a camera for each lens"}
"""Cameras that are compared, by kind of proposal."""


# -- comparison --------------------------------------------------------------------------------------------------------


def comparison(model: Model, proposed: Proposal) -> dict[str, Any]:
    """Return the number of held-out keypoints and the candidates' results, or the reason for none."""
    source, _ = prepared(model.folder)
    if any(rig.num_sensors() > 1 for rig in source.rigs.values()):
        return {"refusal": "the cameras of a rig stay as they are", "held": 0, "results": []}
    results, held = compare(source, candidates(source, labels_of(source, proposed), proposed.kind), model.folder)
    refusal = "" if results else f"too few points that three photos observe ({held}): {ANEW}"
    return {"refusal": refusal, "held": held, "results": [asdict(one) for one in results]}


def labels_of(source: Any, proposed: Proposal) -> dict[int, Hashable]:
    """Return the proposed label of each image of a pycolmap.Reconstruction."""
    return {image.image_id: proposed.labels[image.name.replace("\\", "/")] for image in registered(source)}


def comparison_file(model: Model, proposed: Proposal) -> Path:
    """Return the place of a comparison in the cache."""
    labels = sorted((name, str(label)) for name, label in proposed.labels.items())
    return cache_folder("cameras", content_key(METHOD, camera_key(model), proposed.kind, labels)) / FILE


def kept_comparison(model: Model, proposed: Proposal) -> dict[str, Any] | None:
    """Return the comparison that the cache keeps, if any."""
    file = comparison_file(model, proposed)
    return dict(read_json(file)) if is_intact(file) else None


def keep_comparison(model: Model, proposed: Proposal, compared: Mapping[str, Any]) -> None:
    """Write a comparison to the cache."""
    file = comparison_file(model, proposed)
    make_folder(file.parent)
    write_json(file, compared)
    add_to_manifest(file)


# -- model -------------------------------------------------------------------------------------------------------------


def cameras_replaced(folder: Path, proposed: Proposal, name: str) -> Any:
    """Return the pycolmap.Reconstruction of a folder, adjusted with a candidate's cameras; InputError: it fails."""
    source, origin = prepared(folder)
    listed = candidates(source, labels_of(source, proposed), proposed.kind)
    chosen = next(one for one in listed if one.name == name)
    logger.info("bundle adjustment of %d images: %s", source.num_reg_images(), name)
    return move(restored(source, adjusted(source, chosen, folder), chosen), origin)
