"""Bundle adjustment of a COLMAP model by its own observations, where these contradict it.

A wrong pose, focal length or lens shifts the keypoints of a whole picture (gsx.scenes.keypoint_fit). COLMAP's bundle
adjustment then moves cameras and points to where they explain the observations best (gsx.scenes.bundle). Photos that
one lens took may share a camera, and those of two lenses get two (gsx.scenes.shared_cameras).

Training on the photographs cannot do this: it absorbs a wrong lens by points at wrong depths.
"""

from pathlib import Path

from gsx.core.errors import InputError
from gsx.engine.cache import cache_folder, content_key
from gsx.scenes.bundle import SHIFT, bundle_adjusted
from gsx.scenes.cached_models import cached_model
from gsx.scenes.camera_groups import Proposal, proposal
from gsx.scenes.colmap_model import Model, read_model
from gsx.scenes.keypoint_fit import shift_of, unmeasured
from gsx.scenes.shared_cameras import (
    Decision,
    camera_key,
    cameras_replaced,
    decide,
    evidence_words,
    lenses_of,
    proposal_of,
)

WHEN = ("never", "auto", "always")
METHOD = "adjusted/3"  # part of the cache key: raise the number when the adjustment changes


def adjust_model(model: Model, when: str, photos: Path) -> tuple[Model, list[str]]:
    """Return the model, adjusted if `scene.adjust` says so, and notes; InputError: it cannot be solved.

    EXIF of the images in the folder `photos` counts as evidence on lenses.
    """
    if when == "never":
        return model, unusual_cameras(model, photos)
    before, proposed = shift_of(model), proposal_of(model, photos)
    chosen = decide(model, proposed) if proposed else Decision()
    notes = [f"Cameras: {chosen.words}."] if proposed else []
    if when == "auto" and not chosen.name and not (before is not None and before > SHIFT):
        return model, [
            f"Nothing is adjusted: {fit_words(before)}{unmeasured(model)} ({test_words(when, before)}).",
            *notes,
        ]
    after = adjusted_model(model, proposed, chosen)
    lens = f", {chosen.name}" if chosen.name else ""
    return after, [
        *(note for note in model.notes if note not in after.notes),
        f"Bundle adjustment of poses, intrinsics{lens} and points ({test_words(when, before)}): before it "
        f"{fit_words(before)}, then {fit_words(shift_of(after))}{unmeasured(after)}{lens_words(model, after)}.",
        *notes,
    ]


def adjusted_model(model: Model, proposed: Proposal | None, chosen: Decision) -> Model:
    """Return the adjusted model, from the cache if it was adjusted before; InputError: it cannot be solved."""
    if proposed is None or not chosen.name:
        key = content_key(METHOD, *camera_key(model))
        return read_model(cached_model(cache_folder("adjusted", key), lambda work: bundle_adjusted(model.folder)))
    labels = sorted((name, str(label)) for name, label in proposed.labels.items())
    key = content_key(METHOD, *camera_key(model), chosen.name, labels)
    replaced = cached_model(
        cache_folder("adjusted", key), lambda work: cameras_replaced(model.folder, proposed, chosen.name)
    )
    return read_model(replaced)


def unusual_cameras(model: Model, photos: Path) -> list[str]:
    """Return a note if focal lengths of a model differ beyond their uncertainty, although nothing is adjusted."""
    try:
        proposed = proposal(model, lenses_of(model, photos) if len(model.cameras) > 1 else {})
    except InputError:  # of a lens: the first photo that needs it is refused by name
        return []
    return [f"Cameras: {evidence_words(model, proposed)}."] if proposed and proposed.unusual else []


def camera_lines(model: Model, photos: Path) -> list[str]:
    """Return a line on cameras that may not fit the lenses, for `gsx scenes`."""
    proposed = proposal_of(model, photos)
    return [evidence_words(model, proposed)] if proposed else []


def fit_words(shift: float | None) -> str:
    """Describe how cameras fit their observations."""
    return "too few observations" if shift is None else f"pictures are {shift:.2f} px off the cameras' observations"


def test_words(when: str, shift: float | None) -> str:
    """Name the switch, with its threshold if there was a test."""
    return f"scene.adjust={when}" + (f", threshold {SHIFT:g} px" if when == "auto" and shift is not None else "")


def fit_line(model: Model) -> str:
    """Describe how a model's cameras fit, with a remedy."""
    try:
        shift, rest = shift_of(model), unmeasured(model)
    except InputError as problem:  # of a lens
        return str(problem)
    wrong = shift is not None and shift > SHIFT
    return fit_words(shift) + str(rest) + (": scene.adjust=auto estimates poses and intrinsics anew" if wrong else "")


def lens_words(before: Model, after: Model) -> str:
    """Describe the change of focal lengths, and the number of lenses that got distortion."""
    lens = {image.name: after.cameras[image.camera_id] for image in after.images}
    pairs = [(before.cameras[image.camera_id], lens[image.name]) for image in before.images]
    ratios = [new.mean_focal_length() / old.mean_focal_length() for old, new in pairs]
    low, high = min(ratios), max(ratios)
    bent = len({new.camera_id for old, new in pairs if new.model_name != old.model_name})
    words = f"; focal lengths times {low:.4f}" + (f" to {high:.4f}" if high - low > 1e-4 else "")
    return words + (f", {bent} cameras got distortion" if bent else "")
