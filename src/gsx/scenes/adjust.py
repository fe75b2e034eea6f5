"""Poses, intrinsics and points of a COLMAP model anew from its own observations, where these contradict it.

The cameras of a model that another program wrote, or that was put together by hand, may miss what they observed by the
same movement everywhere in a picture: a wrong pose, focal length or lens. That is told apart from what each keypoint is
off by on its own: a movement fitted to every other keypoint of an image has to explain those in between. COLMAP's
bundle adjustment then moves cameras and points to where they explain the observations best.

A model that learns from the photographs cannot do this: it takes a wrong lens in, by points at wrong depths, and no
photograph contradicts it.
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
from gsx.scenes.colmap_model import Model, ModelImage, present_files, read_model, reconstruction_of
from gsx.scenes.kept_models import kept_model
from gsx.scenes.observations import known, straight_keypoints, unmeasured
from gsx.scenes.sfm import quiet
from gsx.scenes.undistort import pinhole_of

logger = logging.getLogger(__name__)

WHEN = ("never", "auto", "always")
METHOD = "adjusted/2"
"""Part of the cache key: raise the number when the adjustment changes."""
LEAST = 32
"""Observations of an image that tell its movement."""
SHIFT = 0.25
"""Px of the model's cameras, root of the mean square, from which on movements of whole pictures are wrong cameras."""
FLAT = 1e3
"""A point farther to the side than so many times its depth lies in the plane of the camera's centre."""
BENT = {"PINHOLE": "OPENCV", "SIMPLE_PINHOLE": "SIMPLE_RADIAL"}
"""Cameras with distortion, by the same ones without."""


def adjusted(model: Model, when: str) -> tuple[Model, list[str]]:
    """(the model, adjusted where that is wanted, a note that says so).

    Raises:
        InputError: a file of it is missing, or nothing could be solved.
    """
    if when == "never":
        return model, []
    before = shift_of(model)
    if when == "auto" and not (before is not None and before > SHIFT):
        return model, [f"Nothing is adjusted: {fit_told(before)}{unmeasured(model)} (scene.adjust=auto)."]
    stamps = [file_stamp(file) for file in present_files(model.folder)]
    key = content_key(METHOD, installed(), str(model.folder.resolve()), stamps)
    after = read_model(kept_model(cache_folder("adjusted", key), lambda work: bundle_adjusted(model.folder)))
    return after, [
        *(note for note in model.notes if note not in after.notes),
        f"Bundle adjustment of poses, intrinsics and points (scene.adjust={when}): before it {fit_told(before)}, then "
        f"{fit_told(shift_of(after))}{unmeasured(after)}{lenses_told(model, after)}.",
    ]


def fit_told(shift: float | None) -> str:
    """How cameras fit what they observed, in words."""
    return "too few observations tell" if shift is None else f"pictures lie {shift:.2f} px beside what cameras observed"


def fit_line(model: Model) -> str:
    """The same of a model, with what to do about it."""
    try:
        shift, rest = shift_of(model), unmeasured(model)
    except InputError as problem:  # of a lens
        return str(problem)
    wrong = shift is not None and shift > SHIFT
    return fit_told(shift) + str(rest) + (": scene.adjust=auto finds poses and intrinsics anew" if wrong else "")


def installed() -> str:
    """The version of COLMAP."""
    import pycolmap

    return str(pycolmap.__version__)


def lenses_told(before: Model, after: Model) -> str:
    """By how much focal lengths have changed, and which distortion was found, in words."""
    ratios = [
        after.cameras[number].mean_focal_length() / camera.mean_focal_length()
        for number, camera in before.cameras.items()
    ]
    low, high = min(ratios), max(ratios)
    bent = sum(after.cameras[number].model_name != camera.model_name for number, camera in before.cameras.items())
    told = f"; focal lengths times {low:.4f}" + (f" to {high:.4f}" if high - low > 1e-4 else "")
    return told + (f", lenses of {bent} cameras were bent" if bent else "")


# -- do cameras fit what they observed? --------------------------------------------------------------------------------


def shift_of(model: Model) -> float | None:
    """Px of the model's cameras by which movements of whole pictures put points beside where they were observed: root
    of the mean square over images; None where none tells."""
    squares = [explained(image, model.cameras[image.camera_id]) for image in model.images]
    finite = [square for square in squares if square is not None and math.isfinite(square)]
    return math.sqrt(max(0.0, sum(finite) / len(finite))) if finite else None


def explained(image: ModelImage, intrinsics: Any) -> float | None:
    """Mean square of the movement that half the keypoints of an image tell of the other half, px; may be negative where
    they contradict each other. None: too few."""
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
    told = [told_of(columns, off, slice(start, None, 2), slice(1 - start, None, 2)) for start in range(2)]
    return float(focal.square().mean()) * sum(told) / len(told)


def movements(x: Float[Tensor, "K"], y: Float[Tensor, "K"], z: Float[Tensor, "K"]) -> Float[Tensor, "K 2 8"]:
    """How directions move with a turn about each axis, a step along each, the focal length, and radial distortion."""
    none, one, squared = torch.zeros_like(x), torch.ones_like(x), x * x + y * y
    across = [-x * y, 1 + x * x, -y, one / z, none, -x / z, x, x * squared]
    down = [-1 - y * y, x * y, x, none, one / z, -y / z, y, y * squared]
    return torch.stack([torch.stack(across, -1), torch.stack(down, -1)], 1)


def told_of(columns: Float[Tensor, "K 2 8"], off: Float[Tensor, "K 2"], own: slice, other: slice) -> float:
    """Mean product of what other observations are off by and what the movement of some says that they are."""
    squares = off.square().sum(1)
    weights = 1 / (1 + squares / squares.median().clamp_min(1e-18))
    weighted = (columns[own] * weights[own, None, None]).flatten(0, 1).T
    system, right = weighted @ columns[own].flatten(0, 1), weighted @ off[own].flatten()
    scale = system.diagonal().sqrt().clamp_min(1e-12)
    held = system / scale / scale[:, None] + 1e-6 * torch.eye(len(scale), dtype=scale.dtype)
    movement = torch.linalg.solve(held, right / scale) / scale
    products = ((columns[other] @ movement) * off[other]).sum(1)
    return float((weights[other] * products).sum() / weights[other].sum())


# -- bundle adjustment -------------------------------------------------------------------------------------------------


def bundle_adjusted(folder: Path) -> Any:
    """The pycolmap.Reconstruction of a folder with cameras and points moved; cameras without distortion get some where
    that moves what they observed.

    Raises:
        InputError: nothing could be solved.
    """
    found, *_ = reconstruction_of(folder)
    if not found.num_points3D():
        raise InputError(f"{folder} keeps no observations to adjust cameras by: set scene.adjust=never.")
    forget_removed_points(found)
    logger.info("bundle adjustment of %d images and %d points", found.num_reg_images(), found.num_points3D())
    x, y, z = origin = model_origin(found)
    local = shifted(found, (-x, -y, -z))
    if any(origin):
        place_cameras(local)
    return shifted(bent_where_needed(local, folder), origin)


def model_origin(reconstruction: Any) -> Origin:
    """Return the origin around which a model is adjusted: far from it, turning a camera moves everything it sees."""
    images = [reconstruction.image(number) for number in reconstruction.reg_image_ids()]
    centres = torch.from_numpy(np.array([image.projection_center() for image in images]))
    middle = centres.median(0).values
    return chosen_origin(middle, float((centres - middle).norm(dim=1).mean()))


def shifted(reconstruction: Any, by: Origin) -> Any:
    """Return a model whose cameras and points are moved in place."""
    import pycolmap

    if any(by):
        reconstruction.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(by)))
    return reconstruction


def place_cameras(reconstruction: Any) -> None:
    """Put each camera where its observations say, as it is turned.

    A model far from (0, 0, 0) states its cameras by rotation and translation: a rotation that text has rounded to six
    digits puts a camera of UTM coordinates metres away.
    """
    for number in reconstruction.reg_image_ids():
        image = reconstruction.image(number)
        observed = [image.point2D(index) for index in image.get_observation_point2D_idxs()]
        rays = image.camera.cam_from_img(np.array([point.xy for point in observed]).reshape(-1, 2))
        points = np.array([reconstruction.point3D(point.point3D_id).xyz for point in observed]).reshape(-1, 3)
        measured = np.isfinite(rays).all(1)
        pose = image.cam_from_world()
        translation = translation_from(rays[measured], points[measured] @ pose.rotation.matrix().T)
        if translation is not None:
            pose.translation = translation
            image.frame.set_cam_from_world(image.camera_id, pose)


def translation_from(rays: Float[np.ndarray, "K 2"], turned: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "3"] | None:
    """Return the translation by which turned points lie on their rays best; None: too few rays."""
    if len(rays) < LEAST:
        return None
    rows = np.zeros((len(rays), 2, 3))
    rows[:, 0, 0], rows[:, 1, 1], rows[:, :, 2] = 1, 1, -rays
    right = rays * turned[:, 2:] - turned[:, :2]
    found: np.ndarray = np.linalg.lstsq(rows.reshape(-1, 3), right.ravel(), rcond=None)[0]
    return found


def bent_where_needed(found: Any, folder: Path) -> Any:
    """Return an adjusted model, in which cameras without distortion have some where that moves what they observed."""
    adjust(found, folder)
    straight = [number for number, camera in found.cameras.items() if camera.model_name in BENT]
    if not straight:
        return found
    bent = with_distortion(found, straight)
    adjust(bent, folder)
    return bent if bend_of(bent, straight) > SHIFT else found


def forget_removed_points(reconstruction: Any) -> None:
    """Remove observations of points that the reconstruction lacks, which a bundle adjustment does not take."""
    for image in reconstruction.images.values():
        for index in image.get_observation_point2D_idxs():
            if not reconstruction.exists_point3D(image.point2D(index).point3D_id):
                image.reset_point3D_for_point2D(index)


def adjust(reconstruction: Any, folder: Path) -> None:
    """Move cameras, focal lengths, distortion and points; on one thread, so that the bits are the same each time.

    Raises:
        InputError: nothing could be solved.
    """
    import pycolmap

    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY  # some observations are of something else
    options.ceres.solver_options.num_threads = 1
    for number in reconstruction.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    try:
        with quiet():
            summary = pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    except (ValueError, RuntimeError) as problem:
        raise InputError(
            f"COLMAP refuses a bundle adjustment of {folder} ({str(problem).strip()}): set scene.adjust=never, or "
            "reconstruct the photos with scene=photos."
        ) from None
    if not summary.is_solution_usable():
        raise InputError(
            f"The bundle adjustment of {folder} came to nothing ({summary.brief_report()}): set scene.adjust=never, or "
            "reconstruct the photos with scene=photos."
        )


def with_distortion(reconstruction: Any, straight: Sequence[int]) -> Any:
    """A copy in which cameras of these numbers, which have no distortion, could have some."""
    import pycolmap

    out = copy.deepcopy(reconstruction)
    for camera in (out.cameras[number] for number in straight):
        wider = pycolmap.Camera.create_from_model_name(
            camera.camera_id, BENT[camera.model_name], 1.0, camera.width, camera.height
        )
        params = [*camera.params, *[0.0] * (len(wider.params) - len(camera.params))]
        camera.model, camera.params = wider.model, params
    return out


def bend_of(reconstruction: Any, cameras: Sequence[int]) -> float:
    """Px by which distortion moves what cameras of these numbers observed, root of the mean square."""
    squares = [np.zeros(0)]
    for image in (reconstruction.image(number) for number in reconstruction.reg_image_ids()):
        if image.camera_id not in cameras:
            continue
        camera = reconstruction.cameras[image.camera_id]
        seen = np.array([image.point2D(index).xy for index in image.get_observation_point2D_idxs()]).reshape(-1, 2)
        focal = np.array([camera.focal_length_x, camera.focal_length_y])
        straight = camera.cam_from_img(seen) * focal + [camera.principal_point_x, camera.principal_point_y]
        squares.append(np.square(straight - seen).sum(1))
    moved = np.concatenate(squares)
    moved = moved[np.isfinite(moved)]  # a lens may have no ray for a keypoint
    return float(np.sqrt(moved.mean())) if len(moved) else 0.0
