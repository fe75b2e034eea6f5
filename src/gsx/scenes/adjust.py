"""Bundle adjustment of a COLMAP model by its own observations, where these contradict it.

A wrong pose, focal length or lens shifts the keypoints of a picture together; noise shifts each on its own. To separate
them, a movement is fitted to every other keypoint of an image and has to predict those in between. COLMAP's bundle
adjustment then moves cameras and points to where they explain the observations best.

Training on the photographs cannot do this: it absorbs a wrong lens by points at wrong depths.
"""

import copy
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.shapes import Float
from gsx.engine.cache import cache_folder, content_key, file_stamp
from gsx.formats.origin import Origin, chosen_origin
from gsx.scenes.cached_models import cached_model
from gsx.scenes.colmap_folders import model_files
from gsx.scenes.colmap_model import Model, ModelImage, read_model, reconstruction_of
from gsx.scenes.observations import known, straight_keypoints, unmeasured
from gsx.scenes.sfm import quiet
from gsx.scenes.undistort import pinhole_of

logger = logging.getLogger(__name__)

WHEN = ("never", "auto", "always")
METHOD = "adjusted/2"  # part of the cache key: raise the number when the adjustment changes
LEAST = 32  # observations of an image from which its movement is estimated
SHIFT = 0.25  # px of the model's cameras, root mean square: larger movements of whole pictures mean wrong cameras
FLAT = 1e3  # a point farther to the side than so many times its depth lies in the plane of the camera's centre
BENT = {"PINHOLE": "OPENCV", "SIMPLE_PINHOLE": "SIMPLE_RADIAL"}  # cameras with distortion, by those without


def adjust_model(model: Model, when: str) -> tuple[Model, list[str]]:
    """Return the model, adjusted if `scene.adjust` says so, and a note; InputError: it cannot be solved."""
    import pycolmap

    if when == "never":
        return model, []
    before = shift_of(model)
    if when == "auto" and not (before is not None and before > SHIFT):
        return model, [f"Nothing is adjusted: {fit_words(before)}{unmeasured(model)} (scene.adjust=auto)."]
    stamps = [file_stamp(file) for file in model_files(model.folder).values()]
    key = content_key(METHOD, str(pycolmap.__version__), str(model.folder.resolve()), stamps)
    after = read_model(cached_model(cache_folder("adjusted", key), lambda work: bundle_adjusted(model.folder)))
    return after, [
        *(note for note in model.notes if note not in after.notes),
        f"Bundle adjustment of poses, intrinsics and points (scene.adjust={when}): before it {fit_words(before)}, then "
        f"{fit_words(shift_of(after))}{unmeasured(after)}{lens_words(model, after)}.",
    ]


def fit_words(shift: float | None) -> str:
    """Describe how cameras fit their observations."""
    return "too few observations" if shift is None else f"pictures are {shift:.2f} px off the cameras' observations"


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
    pairs = [(camera, after.cameras[number]) for number, camera in before.cameras.items()]
    ratios = [new.mean_focal_length() / old.mean_focal_length() for old, new in pairs]
    low, high = min(ratios), max(ratios)
    bent = sum(new.model_name != old.model_name for old, new in pairs)
    words = f"; focal lengths times {low:.4f}" + (f" to {high:.4f}" if high - low > 1e-4 else "")
    return words + (f", {bent} cameras got distortion" if bent else "")


# -- fit of cameras to their observations ------------------------------------------------------------------------------


def shift_of(model: Model) -> float | None:
    """Return the root mean square shift of pictures against their observations, model's px; None: too few."""
    squares = [explained(image, model.cameras[image.camera_id]) for image in model.images]
    finite = [square for square in squares if square is not None and math.isfinite(square)]
    return math.sqrt(max(0.0, sum(finite) / len(finite))) if finite else None


def explained(image: ModelImage, intrinsics: Any) -> float | None:
    """Return the mean square movement, px^2, that half an image's keypoints predict for the other; None: too few."""
    pinhole, observed = pinhole_of(intrinsics), straight_keypoints(image, intrinsics)
    points = image.observed @ image.rotation.T + image.translation
    usable = (points[:, 2] > 0) & (points[:, :2].abs() <= FLAT * points[:, 2:]).all(1) & known(observed)
    x, y, z = points[usable].T
    if len(z) < LEAST:
        return None
    focal = observed.new_tensor([pinhole.focal_length_x, pinhole.focal_length_y])
    centre = observed.new_tensor([pinhole.principal_point_x, pinhole.principal_point_y])
    off = (observed[usable] - centre) / focal - torch.stack([x / z, y / z], 1)
    columns = movements(x / z, y / z, z)
    products = [predicted(columns, off, slice(start, None, 2), slice(1 - start, None, 2)) for start in range(2)]
    return float(focal.square().mean()) * sum(products) / len(products)


def movements(x: Float[Tensor, "K"], y: Float[Tensor, "K"], z: Float[Tensor, "K"]) -> Float[Tensor, "K 2 8"]:
    """Return derivatives of directions by turns about each axis, steps along each, focal length, radial distortion."""
    none, one, squared = torch.zeros_like(x), torch.ones_like(x), x * x + y * y
    across = [-x * y, 1 + x * x, -y, one / z, none, -x / z, x, x * squared]
    down = [-1 - y * y, x * y, x, none, one / z, -y / z, y, y * squared]
    return torch.stack([torch.stack(across, -1), torch.stack(down, -1)], 1)


def predicted(columns: Float[Tensor, "K 2 8"], off: Float[Tensor, "K 2"], fitted: slice, other: slice) -> float:
    """Fit a movement to some offsets; returns the mean product of the other offsets with its prediction."""
    squares = off.square().sum(1)
    weights = 1 / (1 + squares / squares.median().clamp_min(1e-18))
    weighted = (columns[fitted] * weights[fitted, None, None]).flatten(0, 1).T
    system, right = weighted @ columns[fitted].flatten(0, 1), weighted @ off[fitted].flatten()
    scale = system.diagonal().sqrt().clamp_min(1e-12)
    held = system / scale / scale[:, None] + 1e-6 * torch.eye(len(scale), dtype=scale.dtype)
    movement = torch.linalg.solve(held, right / scale) / scale
    products = ((columns[other] @ movement) * off[other]).sum(1)
    return float((weights[other] * products).sum() / weights[other].sum())


# -- bundle adjustment -------------------------------------------------------------------------------------------------


def bundle_adjusted(folder: Path) -> Any:
    """Adjust the pycolmap.Reconstruction of a folder; InputError: nothing could be solved.

    Cameras without distortion get some if that moves their observations by more than `SHIFT`.
    """
    model, *_ = reconstruction_of(folder)
    if not model.num_points3D():
        raise InputError(f"{folder} keeps no observations to adjust cameras by: set scene.adjust=never.")
    for image in model.images.values():  # a bundle adjustment refuses observations of removed points
        for index in image.get_observation_point2D_idxs():
            if not model.exists_point3D(image.point2D(index).point3D_id):
                image.reset_point3D_for_point2D(index)
    logger.info("bundle adjustment of %d images and %d points", model.num_reg_images(), model.num_points3D())
    centres = torch.from_numpy(np.array([image.projection_center() for image in registered(model)]))
    middle = centres.median(0).values  # far from the origin, a small turn of a camera moves all its points
    x, y, z = origin = chosen_origin(middle, float((centres - middle).norm(dim=1).mean()))
    move(model, (-x, -y, -z))
    if any(origin):
        place_cameras(model)
    adjust(model, folder)
    straight = [number for number, camera in model.cameras.items() if camera.model_name in BENT]
    if straight:
        bent = with_distortion(model, straight)
        adjust(bent, folder)
        model = bent if bend_of(bent, straight) > SHIFT else model
    return move(model, origin)


def registered(model: Any) -> list[Any]:
    """Return the images of a pycolmap.Reconstruction that have a pose."""
    return [model.image(number) for number in model.reg_image_ids()]


def observed_pixels(image: Any) -> Float[np.ndarray, "K 2"]:
    """Return the keypoints of a pycolmap image that observe points."""
    return np.array([image.point2D(index).xy for index in image.get_observation_point2D_idxs()]).reshape(-1, 2)


def move(model: Any, by: Origin) -> Any:
    """Move cameras and points of a model in place, and return it."""
    import pycolmap

    if any(by):
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(by)))
    return model


def place_cameras(model: Any) -> None:
    """Move each camera to where its observations place it, with its rotation.

    A model far from (0, 0, 0) states its cameras by rotation and translation: a rotation rounded to six digits moves a
    camera of UTM coordinates by metres.
    """
    for image in registered(model):
        rays = image.camera.cam_from_img(observed_pixels(image))
        ids = [image.point2D(index).point3D_id for index in image.get_observation_point2D_idxs()]
        points = np.array([model.point3D(number).xyz for number in ids]).reshape(-1, 3)
        measured = np.isfinite(rays).all(1)
        pose = image.cam_from_world()
        translation = translation_from(rays[measured], points[measured] @ pose.rotation.matrix().T)
        if translation is not None:
            pose.translation = translation
            image.frame.set_cam_from_world(image.camera_id, pose)


def translation_from(rays: Float[np.ndarray, "K 2"], turned: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "3"] | None:
    """Return the translation that brings turned points closest to their rays; None: too few rays."""
    if len(rays) < LEAST:
        return None
    rows = np.zeros((len(rays), 2, 3))
    rows[:, 0, 0], rows[:, 1, 1], rows[:, :, 2] = 1, 1, -rays
    right = rays * turned[:, 2:] - turned[:, :2]
    translation: np.ndarray = np.linalg.lstsq(rows.reshape(-1, 3), right.ravel(), rcond=None)[0]
    return translation


def adjust(model: Any, folder: Path) -> None:
    """Adjust poses, focal lengths, distortion and points, on one thread for equal bits; InputError: it fails."""
    import pycolmap

    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY  # some observations are wrong
    options.ceres.solver_options.num_threads = 1
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    remedy = "set scene.adjust=never, or reconstruct the photos with scene=photos"
    try:
        with quiet():
            summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    except (ValueError, RuntimeError) as problem:
        raise InputError(
            f"COLMAP refuses a bundle adjustment of {folder} ({str(problem).strip()}): {remedy}."
        ) from None
    if not summary.is_solution_usable():
        raise InputError(f"The bundle adjustment of {folder} failed ({summary.brief_report()}): {remedy}.")


def with_distortion(model: Any, straight: Sequence[int]) -> Any:
    """Return a copy in which cameras of these numbers have distortion parameters, which are 0."""
    import pycolmap

    out = copy.deepcopy(model)
    for camera in (out.cameras[number] for number in straight):
        wider = pycolmap.Camera.create_from_model_name(
            camera.camera_id, BENT[camera.model_name], 1.0, camera.width, camera.height
        )
        params = [*camera.params, *[0.0] * (len(wider.params) - len(camera.params))]
        camera.model, camera.params = wider.model, params
    return out


def bend_of(model: Any, cameras: Sequence[int]) -> float:
    """Return by how many px distortion moves the observations of these cameras, root mean square."""
    squares = [np.zeros(0)]
    for image in registered(model):
        if image.camera_id in cameras:
            camera, pixels = model.cameras[image.camera_id], observed_pixels(image)
            focal = np.array([camera.focal_length_x, camera.focal_length_y])
            straight = camera.cam_from_img(pixels) * focal + [camera.principal_point_x, camera.principal_point_y]
            squares.append(np.square(straight - pixels).sum(1))
    moved = np.concatenate(squares)
    moved = moved[np.isfinite(moved)]  # a lens may have no ray for a keypoint
    return float(np.sqrt(moved.mean())) if len(moved) else 0.0
