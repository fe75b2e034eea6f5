"""Comparison of cameras of a COLMAP model on held-out keypoints.

Each candidate assigns cameras to images. It is adjusted to four fifths of the observations and has to predict the rest:
a camera of each photo's own always fits its own observations better, and predicts others worse if it is not needed.
Candidates are adjusted on a common raster, on which photos of slightly different sizes may share a camera.
"""

import copy
import logging
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsx.core.shapes import Float
from gsx.scenes.bundle import BENT, adjust, centre_of, registered, widened
from gsx.scenes.keypoint_fit import LEAST

logger = logging.getLogger(__name__)

SEED = 0  # of the choice of held-out observations
FOLDS = 5  # parts of the observations, held out in turn
LARGEST = 100_000  # observations in all adjustments of a candidate: larger models hold out fewer parts, or points
TOLERANCE = 1e-6  # share of the cost per step at which an adjustment ends: held-out errors no longer change
SURE = 1.0  # standard errors by which a candidate has to be better: shared cameras that are no worse do no harm
FINEST = 0.05  # px: smaller errors of keypoints are as good as none
RADIAL = {"PINHOLE": "RADIAL", "SIMPLE_PINHOLE": "RADIAL"}  # cameras with radial distortion, by those without

Point = tuple[int, int]
"""Image and index of a keypoint."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Cameras of the images of a model."""

    name: str
    labels: Mapping[int, Hashable]
    """Label of the camera by image; equal labels share a camera."""
    scaled: bool = False
    """True if sizes differ by a scale, so that focal lengths relate to the longer side; else photos were trimmed."""
    bent: bool = False
    """True if cameras without distortion get some."""
    own_radial: bool = False
    """True if photos share the focal length alone, and each has a radial distortion of its own."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Error of a candidate on held-out keypoints."""

    name: str
    median: float
    """Median distance of held-out keypoints, px."""
    gain: float
    """Decrease of the mean robust error against the model's own cameras."""
    error: float
    """Standard error of `gain` over images."""

    def better(self) -> bool:
        """Return whether the gain exceeds `SURE` standard errors."""
        return self.gain > SURE * self.error

    def worse(self) -> bool:
        """Return whether the loss exceeds `SURE` standard errors."""
        return -self.gain > SURE * self.error


# -- candidates --------------------------------------------------------------------------------------------------------


def candidates(source: Any, proposed: Mapping[int, Hashable], kind: str) -> list[Candidate]:
    """Return candidates for the cameras of a pycolmap.Reconstruction, the model's own first."""
    own = Candidate(name="as they are", labels={image.image_id: image.camera_id for image in registered(source)})
    if kind == "two":
        return [own, Candidate(name="a camera for each lens", labels=proposed)]
    one = Candidate(name="shared", labels=proposed)
    found = [own, one]
    longest = {(label, max(sides(source.image(at).camera))) for at, label in proposed.items()}
    if len(longest) > len({label for label, _ in longest}):
        found.append(replace(one, name="shared by size", scaled=True))
    if any(camera.model_name in BENT for camera in source.cameras.values()):
        found.append(replace(one, name="shared with distortion", bent=True))
    return [*found, replace(one, name="shared focal length, own radial distortion", own_radial=True)]


def sides(camera: Any) -> tuple[int, int]:
    """Return (width, height) of a pycolmap camera."""
    return camera.width, camera.height


# -- adjustment --------------------------------------------------------------------------------------------------------


def adjusted(source: Any, candidate: Candidate, folder: Path, left_out: frozenset[Point] = frozenset()) -> Any:
    """Return the model of a candidate on its common raster, adjusted without some observations; InputError: failure."""
    work = arranged(source, replace(candidate, own_radial=False), left_out)
    adjust(work, folder, tolerance=TOLERANCE)
    if candidate.own_radial:
        work = with_own_radial(source, work, candidate, left_out)
        adjust(work, folder, focal=False, tolerance=TOLERANCE)
    return work


def arranged(source: Any, candidate: Candidate, left_out: frozenset[Point]) -> Any:
    """Return a copy with the candidate's cameras: principal points at 0, keypoints relative to them and scaled."""
    labels = list(dict.fromkeys(candidate.labels.values()))
    scales = scales_of(source, candidate)
    cameras = {}
    for number, label in enumerate(labels, 1):
        members = [at for at in candidate.labels if candidate.labels[at] == label]
        cameras[label] = common_camera(number, source, members, scales, candidate.bent)
    images = {at: cameras[label] for at, label in candidate.labels.items()}
    keypoints = {at: (pixels_of(source.image(at)) - centre_of(source.image(at).camera)) * scales[at] for at in images}
    return rebuilt(source, images, keypoints, left_out)


def scales_of(source: Any, candidate: Candidate) -> dict[int, float]:
    """Return the factor from each image's pixels to those of its common raster."""
    longer = {at: max(sides(source.image(at).camera)) for at in candidate.labels}
    if not candidate.scaled:
        return dict.fromkeys(longer, 1.0)
    largest: dict[Hashable, int] = {}
    for at, label in candidate.labels.items():
        largest[label] = max(longer[at], largest.get(label, 0))
    return {at: largest[label] / longer[at] for at, label in candidate.labels.items()}


def common_camera(number: int, source: Any, members: Sequence[int], scales: Mapping[int, float], bent: bool) -> Any:
    """Return the pycolmap camera with the median parameters of some images' cameras."""
    cameras = [source.image(at).camera for at in members]
    camera = copy.copy(cameras[0])
    params = np.median([scaled(one, scales[at]) for one, at in zip(cameras, members, strict=True)], axis=0)
    params[camera.principal_point_idxs()] = 0
    camera.camera_id, camera.params = number, params
    return widened(camera, BENT) if bent else camera


def scaled(camera: Any, by: float) -> Float[np.ndarray, "P"]:
    """Return the parameters of a pycolmap camera with focal lengths multiplied."""
    params = np.array(camera.params)
    params[camera.focal_length_idxs()] *= by
    return params


def with_own_radial(source: Any, shared: Any, candidate: Candidate, left_out: frozenset[Point]) -> Any:
    """Return an adjusted model with a camera for each of the source's, of the shared focal length, with distortion."""
    images, numbers = {}, dict[tuple[Hashable, int], int]()
    for at, label in candidate.labels.items():
        number = numbers.setdefault((label, source.image(at).camera_id), len(numbers) + 1)
        camera = copy.copy(shared.image(at).camera)
        camera.camera_id = number
        images[at] = widened(camera, RADIAL)
    keypoints = {at: pixels_of(shared.image(at)) for at in images}
    return with_state(rebuilt(source, images, keypoints, left_out), shared)


def restored(source: Any, work: Any, candidate: Candidate) -> Any:
    """Return an adjusted model on the source's rasters; cameras of the source that are split get new numbers."""
    scales = scales_of(source, candidate)
    kept, images = dict[tuple[int, int], int](), {}
    fresh = max(source.cameras) + 1
    for at in candidate.labels:
        own, camera = source.image(at).camera, copy.copy(work.image(at).camera)
        key = (own.camera_id, camera.camera_id)
        if key not in kept:
            kept[key] = own.camera_id if own.camera_id not in kept.values() else fresh
            fresh += kept[key] == fresh
        params = scaled(camera, 1 / scales[at])
        params[camera.principal_point_idxs()] = centre_of(own)
        camera.camera_id, camera.width, camera.height, camera.params = kept[key], own.width, own.height, params
        images[at] = camera
    return with_state(rebuilt(source, images, {at: pixels_of(source.image(at)) for at in images}), work)


def rebuilt(
    source: Any,
    cameras: Mapping[int, Any],
    keypoints: Mapping[int, Float[np.ndarray, "K 2"]],
    left_out: frozenset[Point] = frozenset(),
) -> Any:
    """Return a pycolmap.Reconstruction of the source's images and points with other cameras and keypoints, by image."""
    import pycolmap

    out = pycolmap.Reconstruction()
    for camera in {camera.camera_id: camera for camera in cameras.values()}.values():
        out.add_camera_with_trivial_rig(camera)
    for at in sorted(cameras):
        image = pycolmap.Image(
            name=source.image(at).name, keypoints=keypoints[at], camera_id=cameras[at].camera_id, image_id=at
        )
        out.add_image_with_trivial_frame(image, source.image(at).cam_from_world())
    for number in sorted(source.point3D_ids()):
        point = source.point3D(number)
        elements = [(e.image_id, e.point2D_idx) for e in point.track.elements]
        track = pycolmap.Track()
        for image_id, index in elements:
            if image_id in cameras and (image_id, index) not in left_out:
                track.add_element(image_id, index)
        if track.length():
            fresh = pycolmap.Point3D()
            fresh.xyz, fresh.color, fresh.error, fresh.track = point.xyz, point.color, point.error, track
            out.add_point3D_with_id(number, fresh)
    return out


def with_state(model: Any, of: Any) -> Any:
    """Copy poses and points of a model with the same images to another, and return that."""
    for image in registered(model):
        image.frame.set_cam_from_world(image.camera_id, of.image(image.image_id).cam_from_world())
    for number in model.point3D_ids():
        if of.exists_point3D(number):
            model.point3D(number).xyz = of.point3D(number).xyz
    return model


def pixels_of(image: Any) -> Float[np.ndarray, "K 2"]:
    """Return all keypoints of a pycolmap image."""
    return np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)


# -- comparison --------------------------------------------------------------------------------------------------------


def compare(source: Any, listed: Sequence[Candidate], folder: Path) -> tuple[list[Result], int]:
    """Return the errors of candidates on held-out keypoints, and the number of these; no errors: too few are held out.

    The first candidate is the baseline. InputError: a bundle adjustment fails.
    """
    generator = np.random.default_rng(SEED)
    part = drawn(source, generator)
    parts = [one for one in folds(part, generator) if one][: max(1, LARGEST // observations(part))]
    images = np.array([image for held in parts for image, _ in held])
    if len(images) < LEAST:
        return [], len(images)
    errors = [candidate_errors(part, candidate, folder, parts) for candidate in listed]
    return [result(one.name, errors[0], own, images) for one, own in zip(listed, errors, strict=True)], len(images)


def candidate_errors(
    source: Any, candidate: Candidate, folder: Path, parts: Sequence[Mapping[Point, int]]
) -> Float[np.ndarray, "H"]:
    """Return distances of the held-out keypoints of all parts, px, after an adjustment without each part in turn."""
    errors, scales = [], scales_of(source, candidate)
    for held in parts:
        logger.info("bundle adjustment of cameras %s, %d keypoints held out", candidate.name, len(held))
        work = adjusted(source, candidate, folder, frozenset(held))
        errors.append(held_errors(work, held) / np.array([scales[at] for at, _ in held]))
    return np.concatenate(errors)


def observations(model: Any) -> int:
    """Return the number of observations of a pycolmap.Reconstruction."""
    return sum(model.point3D(number).track.length() for number in model.point3D_ids())


def drawn(source: Any, generator: np.random.Generator) -> Any:
    """Return the model with points drawn at random that have about `LARGEST` observations; itself if it has no more."""
    share = LARGEST / max(1, observations(source))
    if share >= 1:
        return source
    part = copy.deepcopy(source)
    numbers = sorted(part.point3D_ids())
    for number, draw in zip(numbers, generator.random(len(numbers)), strict=True):
        if draw > share:
            part.delete_point3D(number)
    return part


def folds(model: Any, generator: np.random.Generator) -> list[dict[Point, int]]:
    """Divide observations at random into `FOLDS` parts, with their points; each part leaves a point at least two.

    Points that fewer than three images observe are in none.
    """
    parts: list[dict[Point, int]] = [{} for _ in range(FOLDS)]
    for number in sorted(model.point3D_ids()):
        elements = [(element.image_id, element.point2D_idx) for element in model.point3D(number).track.elements]
        order, first = generator.permutation(len(elements)), int(generator.integers(FOLDS))
        if len(elements) >= 3:
            for at, index in enumerate(order):
                parts[(first + at) % FOLDS][elements[index]] = number
    return parts


def held_errors(work: Any, held: Mapping[Point, int]) -> Float[np.ndarray, "H"]:
    """Return distances of held-out keypoints from their points, px of the common raster; inf behind the camera."""
    errors = []
    for (at, index), number in held.items():
        image = work.image(at)
        point = image.cam_from_world() * work.point3D(number).xyz
        pixel = image.camera.img_from_cam(point) if point[2] > 0 else None
        errors.append(math.inf if pixel is None else float(np.linalg.norm(pixel - image.point2D(index).xy)))
    return np.array(errors)


def result(
    name: str, baseline: Float[np.ndarray, "H"], errors: Float[np.ndarray, "H"], images: Float[np.ndarray, "H"]
) -> Result:
    """Compare a candidate's errors with the baseline's: means of log(1 + (error / median)^2), paired, by image."""
    scale = max(float(np.median(baseline)), FINEST)
    gains = robust(baseline / scale) - robust(errors / scale)
    sums = np.array([(gains[images == at] - gains.mean()).sum() for at in np.unique(images)])
    error = math.sqrt(float(np.square(sums).sum())) / len(gains)
    return Result(name=name, median=float(np.median(errors)), gain=float(gains.mean()), error=error)


def robust(errors: Float[np.ndarray, "H"]) -> Float[np.ndarray, "H"]:
    """Return log(1 + errors^2); errors above 100 count as that."""
    return np.log1p(np.square(np.minimum(errors, 100.0)))
