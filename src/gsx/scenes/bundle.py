"""COLMAP's bundle adjustment of a model: poses, focal lengths, distortion and points, on one thread."""

import copy
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsx.core.errors import InputError
from gsx.core.shapes import Float
from gsx.formats.origin import Origin, chosen_origin
from gsx.scenes.colmap_model import reconstruction_of
from gsx.scenes.keypoint_fit import LEAST
from gsx.scenes.sfm import quiet

logger = logging.getLogger(__name__)

BENT = {"PINHOLE": "OPENCV", "SIMPLE_PINHOLE": "SIMPLE_RADIAL"}  # cameras with distortion, by those without
SHIFT = 0.25  # px of the model's cameras, root mean square: larger movements of whole pictures mean wrong cameras


def bundle_adjusted(folder: Path) -> Any:
    """Adjust the pycolmap.Reconstruction of a folder; InputError: nothing could be solved.

    Cameras without distortion get some if that moves their observations by more than `SHIFT`.
    """
    model, origin = prepared(folder)
    logger.info("bundle adjustment of %d images and %d points", model.num_reg_images(), model.num_points3D())
    adjust(model, folder)
    straight = [number for number, camera in model.cameras.items() if camera.model_name in BENT]
    if straight:
        bent = with_distortion(model, straight)
        adjust(bent, folder)
        model = bent if bend_of(bent, straight) > SHIFT else model
    return move(model, origin)


def prepared(folder: Path) -> tuple[Any, Origin]:
    """Read the pycolmap.Reconstruction of a folder, moved to (0, 0, 0); returns it and its old origin.

    InputError: it keeps no observations.
    """
    model, *_ = reconstruction_of(folder)
    if not model.num_points3D():
        raise InputError(f"{folder} keeps no observations to adjust cameras by: set scene.adjust=never.")
    for image in model.images.values():  # a bundle adjustment refuses observations of removed points
        for index in image.get_observation_point2D_idxs():
            if not model.exists_point3D(image.point2D(index).point3D_id):
                image.reset_point3D_for_point2D(index)
    centres = torch.from_numpy(np.array([image.projection_center() for image in registered(model)]))
    middle = centres.median(0).values  # far from the origin, a small turn of a camera moves all its points
    x, y, z = origin = chosen_origin(middle, float((centres - middle).norm(dim=1).mean()))
    move(model, (-x, -y, -z))
    if any(origin):
        place_cameras(model)
    return model, origin


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


def adjust(model: Any, folder: Path, *, focal: bool = True, tolerance: float = 0.0) -> None:
    """Adjust poses, focal lengths, distortion and points, on one thread for equal bits; InputError: it fails.

    Without `focal`, focal lengths stay. It ends when a step lowers the cost by less than the share `tolerance`.
    """
    import pycolmap

    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY  # some observations are wrong
    options.refine_focal_length = focal
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = tolerance
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
    out = copy.deepcopy(model)
    for camera in (out.cameras[number] for number in straight):
        wider = widened(camera, BENT)
        camera.model, camera.params = wider.model, wider.params
    return out


def widened(camera: Any, models: Mapping[str, str]) -> Any:
    """Return a pycolmap camera of a model with more distortion, which is 0; itself if `models` does not name one."""
    import pycolmap

    if camera.model_name not in models:
        return camera
    focal = camera.mean_focal_length()
    wider = pycolmap.Camera.create_from_model_name(
        camera.camera_id, models[camera.model_name], focal, camera.width, camera.height
    )
    params: Any = np.array(wider.params)
    params[wider.principal_point_idxs()] = centre_of(camera)
    if len(wider.focal_length_idxs()) == len(camera.focal_length_idxs()):
        params[wider.focal_length_idxs()] = camera.params[camera.focal_length_idxs()]
    wider.params = params
    return wider


def centre_of(camera: Any) -> Float[np.ndarray, "2"]:
    """Return the principal point of a pycolmap camera."""
    return np.array([camera.principal_point_x, camera.principal_point_y])


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
