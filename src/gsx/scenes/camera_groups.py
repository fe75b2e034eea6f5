"""Evidence on which photos of a COLMAP model share a camera: sizes, EXIF, focal lengths with their uncertainty.

A model may have a camera for each photo although one took them all, or one camera although two lenses took part. This
module only proposes other cameras. Whether they fit better is decided on held-out keypoints (gsx.scenes.held_out).
"""

import math
import statistics
from collections import Counter, defaultdict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from gsx.scenes.colmap_model import Model, ModelImage
from gsx.scenes.exif import NO_LENS, Lens
from gsx.scenes.keypoint_fit import LEAST, focal_change

ALIKE = 0.02  # largest difference of the sides of photos by one camera: undistortion trims each by some pixels
OTHER_LENS = 1.1  # ratio of neighbouring focal lengths, in order, from which two lenses took part
EQUAL = 1e-3  # spread of focal lengths below which it is of no use to share one
APART = 5.0  # distance of two groups of focal lengths in their own standard deviations: 3.5 for evenly spread ones
FARTHEST = 0.01  # smallest difference of two lenses' focal lengths
FEWEST = 3  # photos of a lens

Lenses = Mapping[str, Lens]
"""Lens of each photo by EXIF, by name of image; photos without EXIF may be absent."""


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """Other cameras for the images of a model."""

    kind: str
    """one | two: cameras that should be one, or one camera for two lenses."""
    labels: Mapping[str, Hashable]
    """Label of the proposed camera by name of image; equal labels share a camera."""
    words: str
    """Description of the cameras, with numbers."""
    unusual: bool
    """True if focal lengths differ by more than their uncertainty explains."""
    thin: bool
    """True if most photos have too few observations to compare cameras."""


def proposal(model: Model, lenses: Lenses) -> Proposal | None:
    """Return other cameras that may fit better; None: nothing speaks for any."""
    return sharing(model, lenses) or splitting(model, lenses)


# -- cameras that should be one ----------------------------------------------------------------------------------------


def sharing(model: Model, lenses: Lenses) -> Proposal | None:
    """Return the proposal to share cameras of one kind, size and lens; None: no two differ by more than `EQUAL`."""
    images = by_camera(model.images)
    groups = [group for group in camera_groups(model, lenses, images) if spread_of(model, group) > EQUAL]
    if not groups:
        return None
    labels: dict[str, Hashable] = {image.name: ("camera", image.camera_id) for image in model.images}
    labels |= {image.name: ("shared", at) for at, group in enumerate(groups) for one in group for image in images[one]}
    largest = max(groups, key=len)
    uncertainty = focal_uncertainty(model, [image for number in largest for image in images[number]])
    spread = spread_of(model, largest)
    return Proposal(
        kind="one",
        labels=labels,
        words=sharing_words(model, largest, uncertainty),
        unusual=spread > EQUAL and spread > 3 * uncertainty,
        thin=math.isnan(uncertainty),
    )


def by_camera(images: Sequence[ModelImage]) -> dict[int, list[ModelImage]]:
    """Return images by their camera."""
    found = defaultdict[int, list[ModelImage]](list)
    for image in images:
        found[image.camera_id].append(image)
    return found


def camera_groups(model: Model, lenses: Lenses, images: Mapping[int, Sequence[ModelImage]]) -> list[list[int]]:
    """Return groups of at least two cameras of one model, lens and about one size and focal length."""
    kinds = defaultdict[Hashable, list[int]](list)
    for number, own in images.items():
        lens = Counter(lenses.get(image.name, NO_LENS) for image in own).most_common(1)[0][0]
        kinds[model.cameras[number].model_name, lens].append(number)
    sized = [group for kind in kinds.values() for group in by_size(model, kind)]
    return [group for alike in sized for group in by_focal_length(model, alike) if len(group) > 1]


def by_size(model: Model, numbers: Sequence[int]) -> list[list[int]]:
    """Group cameras whose sides differ by no more than `ALIKE` from the first of their group."""
    groups: list[list[int]] = []
    for number in numbers:
        near = (group for group in groups if alike(model.cameras[group[0]], model.cameras[number]))
        group = next(near, None)
        if group is None:
            groups.append([number])
        else:
            group.append(number)
    return groups


def alike(one: Any, other: Any) -> bool:
    """Return whether two pycolmap cameras have about one size."""
    pairs = (one.width, other.width), (one.height, other.height)
    return all(abs(a - b) <= ALIKE * max(a, b) for a, b in pairs)


def by_focal_length(model: Model, numbers: Sequence[int]) -> list[list[int]]:
    """Group cameras so that neighbouring focal lengths of a group differ by less than `OTHER_LENS`."""
    ordered = sorted(numbers, key=lambda number: model.cameras[number].mean_focal_length())
    groups = [ordered[:1]]
    for before, number in pairwise(ordered):
        ratio = model.cameras[number].mean_focal_length() / model.cameras[before].mean_focal_length()
        if ratio < OTHER_LENS:
            groups[-1].append(number)
        else:
            groups.append([number])
    return groups


def spread_of(model: Model, numbers: Sequence[int]) -> float:
    """Return the standard deviation of the logarithms of focal lengths."""
    return statistics.pstdev([math.log(model.cameras[number].mean_focal_length()) for number in numbers])


def focal_uncertainty(model: Model, images: Sequence[ModelImage]) -> float:
    """Return the median uncertainty of focal lengths, a share of them; NaN: most images have too few observations."""
    fits = [focal_change(image, model.cameras[image.camera_id]) for image in images]
    known = [fit[1] for fit in fits if fit is not None]
    return statistics.median(known) if 2 * len(known) > len(fits) else math.nan


def sharing_words(model: Model, numbers: Sequence[int], uncertainty: float) -> str:
    """Describe cameras of one kind and size: number, size, focal lengths with their spread and uncertainty."""
    cameras = [model.cameras[number] for number in numbers]
    focal = sorted(camera.mean_focal_length() for camera in cameras)
    sizes = "x".join(span(sorted(sides)) for sides in ([c.width for c in cameras], [c.height for c in cameras]))
    unsure = f"below {LEAST} observations in most photos" if math.isnan(uncertainty) else f"{uncertainty:.2%}"
    return (
        f"{len(cameras)} {cameras[0].model_name} cameras of one size ({sizes}) with focal lengths of "
        f"{focal[0]:.1f} to {focal[-1]:.1f} px (spread {spread_of(model, numbers):.2%}, own uncertainty {unsure})"
    )


def span(values: Sequence[int]) -> str:
    """Write the first and last of sorted numbers, once if they are equal."""
    return str(values[0]) if values[0] == values[-1] else f"{values[0]}-{values[-1]}"


# -- one camera for two lenses -----------------------------------------------------------------------------------------


def splitting(model: Model, lenses: Lenses) -> Proposal | None:
    """Return the proposal to split cameras by EXIF or by focal lengths that fit their photos; None: no such groups."""
    labels: dict[str, Hashable] = {image.name: (image.camera_id, 0) for image in model.images}
    words, split = [], list[ModelImage]()
    for number, images in by_camera(model.images).items():
        found = by_lens(images, lenses) or by_own_focal_length(images, model.cameras[number])
        if found:
            labels |= {image.name: (number, at) for image, at in zip(images, found[0], strict=True)}
            words.append(f"one camera for {len(images)} photos, {found[1]}")
            split += images
    thin = math.isnan(focal_uncertainty(model, split)) if split else True
    return Proposal(kind="two", labels=labels, words=", ".join(words), unusual=True, thin=thin) if words else None


def by_lens(images: Sequence[ModelImage], lenses: Lenses) -> tuple[list[int], str] | None:
    """Return the lens of each image by EXIF, as numbers, and words; None: one, or photos without, or too few each."""
    own = [lenses.get(image.name, NO_LENS) for image in images]
    kinds = Counter(own)
    if len(kinds) < 2 or NO_LENS in kinds or min(kinds.values()) < FEWEST:
        return None
    numbers = {lens: at for at, lens in enumerate(sorted(kinds))}
    counts = " and ".join(f"{kinds[lens]} at {lens[2]:g} mm" for lens in numbers)
    return [numbers[lens] for lens in own], f"which EXIF assigns to {len(kinds)} lenses ({counts})"


def by_own_focal_length(images: Sequence[ModelImage], camera: Any) -> tuple[list[int], str] | None:
    """Return the group of each image by the focal length that fits it best, and words; None: one group.

    An image with too few observations joins the larger group.
    """
    fits = {at: fit[0] for at, image in enumerate(images) if (fit := focal_change(image, camera)) is not None}
    cut = best_cut(sorted(fits.values()))
    if cut is None:
        return None
    below = {at for at, change in fits.items() if change < cut.value}
    rest = int(2 * len(below) < len(fits))
    groups = [rest if at not in fits else int(at not in below) for at in range(len(images))]
    words = f"whose focal lengths form two groups {cut.distance:.1%} apart ({len(below)} and {len(fits) - len(below)})"
    return groups, words


@dataclass(frozen=True)
class Cut:
    """Boundary between two groups of numbers."""

    value: float
    distance: float
    """Distance of the groups' means."""


def best_cut(values: Sequence[float]) -> Cut | None:
    """Return the boundary that leaves the least variance within two groups of sorted numbers; None: one group."""
    cuts = range(FEWEST, len(values) - FEWEST + 1)
    if not cuts:
        return None
    at = min(cuts, key=lambda cut: within(values[:cut]) + within(values[cut:]))
    low, high = values[:at], values[at:]
    distance = statistics.fmean(high) - statistics.fmean(low)
    deviation = math.sqrt((within(low) + within(high)) / len(values))
    apart = distance > APART * deviation and distance > FARTHEST
    return Cut((low[-1] + high[0]) / 2, distance) if apart else None


def within(values: Sequence[float]) -> float:
    """Return the sum of squared distances from the mean."""
    mean = statistics.fmean(values)
    return math.fsum((value - mean) ** 2 for value in values)
