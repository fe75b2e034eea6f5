"""BungeeNeRF cities from the street to the sky, with a label of scale for each view.

Cameras come from a COLMAP model (as the Scaffold-GS and Octree-GS authors distribute these scenes) or, without one,
from `poses_enu.json` of the original data (scaffold and octree spec, section 6). Scale-1 is the closest and scale-4
the farthest: by the published tables, 522 k Gaussians are drawn at scale-1 and 5,821 k at scale-4.

Train and test views keep the order of the sorted file names, so the first n training cameras that the published
augmentation uses are `scene.train[:n]`.
"""

import reprlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, pinhole
from gsx.core.data.images import image_size, refuse_other_size
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import expand_home
from gsx.core.ranges import Points, Seed
from gsx.core.shapes import Float
from gsx.scenes import colmap
from gsx.scenes.colmap_folders import model_folders
from gsx.scenes.masked import mask_notes
from gsx.scenes.origin import origin_of_cameras, relative_camera
from gsx.scenes.points import grey_points, stored_points
from gsx.scenes.pose_files import finite_number, pose_from_opengl, read_json
from gsx.scenes.posed import Shot, check_sides, scene_of, views_of
from gsx.scenes.splits import Split, photos_of, positive, short, split_names

POSES_FILE = "poses_enu.json"
POSE_VALUES = 17  # 3 x 5 [R | t | height, width, focal], near, far
SUFFIXES = (".jpg", ".jpeg", ".png")
SCALES = 4
FEW_HELD_OUT = 50  # Scaffold-GS: with lod below this the first images are test, from it on they are train
BUILDING_HEIGHT = 250.0  # metres; nothing is higher, as BungeeNeRF's bounds along rays assume
RAYS_PER_POINT = 4  # some end in the sky


@dataclass(frozen=True, kw_only=True)
class BungeeOptions(colmap.ColmapOptions):
    """Options of `conf/scene/bungee.yaml`.

    `split` can be `lod:N` as well (Scaffold-GS): the sorted images up to number N are test and the rest train, from
    N = 50 on the reverse.
    """

    points: str
    """Initial points without a COLMAP model. random: in view of the cameras, up to 250 m high | a PLY file."""
    random_points: Points
    seed: Seed
    """Seed of the random points."""


def load(options: BungeeOptions) -> Scene:
    """Load a BungeeNeRF scene; ConfigError: the split cannot be read; InputError: a file is missing or damaged."""
    folder = expand_home(options.path)
    if model_folders(folder):
        scene = colmap.load(replace(options, split="none"))
        centre = scene.points.positions.median(dim=0).values
    else:
        scene = load_enu(options, folder)
        x, y, _ = origin_of_cameras([view.camera for view in scene.train])
        centre = torch.tensor([x, y, 0.0], dtype=torch.float64)
    groups, basis = _scales(scene.train, centre, folder, options.images)
    views = [replace(view, group=f"scale-{scale}") for view, scale in zip(scene.train, groups, strict=True)]
    split = split_views([view.name for view in views], options.split, folder, photos_of(views))
    train, test = ([views[i] for i in side] for side in split)
    check_sides((train, test), folder)
    listed = ", ".join(f"{group}: {count}" for group, count in sorted(Counter(view.group for view in views).items()))
    return replace(
        scene,
        train=train,
        test=test,
        extent=extent_of([view.camera for view in train]),
        notes=[*scene.notes, f"Views of each scale, 1 closest (by {basis}): {listed}."],
        provenance={**scene.provenance, "format": options.name, "split": options.split, "scales": basis},
    )


def split_views(names: Sequence[str], rule: str, folder: Path, photographs: Sequence[Path] = ()) -> Split:
    """Return positions of training and test names by `lod:N`, or any rule of `split_names`, with its errors."""
    kind, _, number = rule.partition(":")
    if kind != "lod":
        return split_names(list(names), rule, folder, photographs)
    last = positive(number)
    if last is None:
        raise ConfigError(f"scene.split is '{short(rule)}', give a whole number above 0 after lod, as in lod:30.")
    order, _ = split_names(list(names), "none")
    first, rest = order[: last + 1], order[last + 1 :]  # up to and including N, as published
    if not rest:
        raise InputError(f"scene.split '{rule}' leaves none of {len(names)} images over, choose a smaller number.")
    return (rest, first) if last < FEW_HELD_OUT else (first, rest)


def load_enu(options: BungeeOptions, folder: Path) -> Scene:
    """Return the scene of `poses_enu.json`, all views in `train`; InputError: a file is missing or damaged.

    Poses are OpenGL camera-to-world in scaled east-north-up coordinates with the ground at height 0.
    """
    file = folder / POSES_FILE
    if not folder.is_dir():
        raise InputError(f"'{folder}' is not a folder: check scene.path or data_root; `gsx datasets` lists the layout.")
    if not file.is_file():
        raise InputError(
            f"'{folder}' has neither a COLMAP model nor {POSES_FILE}, set scene.path to a folder with one."
        )
    content = read_json(file)
    poses, photos = _poses(content, file), image_files(folder / options.images)
    if len(photos) != len(poses):
        images = f"'{folder / options.images}' {len(photos)} images"
        raise InputError(f"'{file}' has {len(poses)} poses and {images}: restore the missing ones.")
    views = views_of([_shot(pose, photo, file) for pose, photo in zip(poses, photos, strict=True)], options)
    points, note = _points(views, content, options, file)
    notes = [f"Cameras come from {POSES_FILE}.", *mask_notes(views, options), note]
    return scene_of(options, folder, views, (views, []), points, notes, {"points": options.points})


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder by name, which in the original data is from near to far."""
    files = folder.iterdir() if folder.is_dir() else []
    return sorted(file for file in files if file.suffix.lower() in SUFFIXES)


def _poses(content: dict[str, Any], file: Path) -> Float[Tensor, "N 17"]:
    """Return the rows of a poses file, float64; InputError: they are no such numbers."""
    try:
        poses = torch.tensor(content.get("poses"), dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"'{file}' has poses that are no table of numbers, copy it anew.") from None
    if poses.ndim != 2 or poses.shape[1] != POSE_VALUES or not poses.isfinite().all():
        raise InputError(f"'{file}' has poses that are not rows of {POSE_VALUES} finite numbers, copy it anew.")
    return poses


def _shot(pose: Float[Tensor, "17"], photo: Path, file: Path) -> Shot:
    matrix = pose[:15].reshape(3, 5)
    place = f"The pose of '{photo.name}' in '{file}'"
    rotation, translation = pose_from_opengl(matrix[:, :4].tolist(), place)
    height, width, focal = matrix[:, 4].tolist()
    if min(height, width, focal) < 1:
        raise InputError(f"{place} has size {width:g} x {height:g} and focal length {focal:g}, copy the file anew.")
    expected = round(width), round(height)
    camera = replace(pinhole(rotation, translation, focal, *expected), cx=width / 2, cy=height / 2)
    refuse_other_size(photo, size := image_size(photo), expected)
    return Shot(name=photo.name, photo=photo, whole=camera.resize(*size), expected_size=expected)


def _points(
    views: Sequence[View], content: dict[str, Any], options: BungeeOptions, file: Path
) -> tuple[PointCloud, str]:
    """Return points and a note on their source."""
    if options.points != "random":
        return stored_points(file.parent, options.points)
    scale = finite_number(content.get("scene_scale"))
    if scale is None or scale <= 0:
        stated = reprlib.repr(content.get("scene_scale"))
        raise InputError(f"'{file}' has scene_scale {stated}, give a number above 0 or set scene.points to a PLY file.")
    generator = torch.Generator().manual_seed(options.seed)
    cameras = [view.camera for view in views]
    x, y, _ = origin_of_cameras(cameras)
    below = (x, y, 0.0)  # heights count from the ground
    local = [relative_camera(camera, below) for camera in cameras]
    cloud = city_points(local, options.random_points, BUILDING_HEIGHT * scale, generator)
    if any(below):
        cloud = grey_points(cloud.positions + torch.tensor(below, dtype=torch.float64))
    return cloud, f"Starts from {len(cloud)} random points on rays of the cameras, up to {BUILDING_HEIGHT:g} m high."


def city_points(cameras: Sequence[Camera], count: int, height: float, generator: torch.Generator) -> PointCloud:
    """Return grey points where rays through random pixels of random cameras reach a random level in [0, `height`].

    Their density follows the views, at all scales; none is farther from the origin than every camera. InputError: no
    ray reaches the ground.
    """
    rays = count * RAYS_PER_POINT
    chosen = torch.randint(len(cameras), (rays,), generator=generator)
    eyes = torch.stack([camera.centre for camera in cameras])
    directions = torch.stack([camera.rotation.T @ _pixel_to_ray(camera) for camera in cameras])
    pixels = torch.rand(rays, 3, 1, generator=generator, dtype=torch.float64)
    pixels[:, 2] = 1
    way = (directions[chosen] @ pixels)[..., 0]
    level = torch.rand(rays, generator=generator, dtype=torch.float64) * height
    depth = (level - eyes[chosen, 2]) / way[:, 2]
    positions = eyes[chosen] + depth[:, None] * way
    usable = (depth > 0) & (positions.norm(dim=1) <= eyes.norm(dim=1).max())
    if not usable.any():
        raise InputError("No camera of the scene points down at a city, set scene.points to a PLY file.")
    return grey_points(positions[usable][:count])


def _pixel_to_ray(camera: Camera) -> Float[Tensor, "3 3"]:
    """Return the matrix from (x / width, y / height, 1) to the ray of that pixel in camera coordinates, at depth 1."""
    across = [camera.width / camera.fx, 0, -camera.cx / camera.fx]
    down = [0, camera.height / camera.fy, -camera.cy / camera.fy]
    return torch.tensor([across, down, [0, 0, 1]], dtype=torch.float64)


def _scales(views: Sequence[View], centre: Float[Tensor, "3"], folder: Path, images: str) -> tuple[list[int], str]:
    """Return the scale of each view, from 1, and its basis in words."""
    file = folder / POSES_FILE
    content = read_json(file) if file.is_file() else {}
    names = [photo.name for photo in image_files(folder / images)]
    if "scale_split" in content and len(names) == len(_poses(content, file)):
        starts = content["scale_split"]  # numbers of the first image of each scale, farthest first
        whole = isinstance(starts, list) and all(isinstance(start, int) for start in starts)
        if not whole or starts != sorted(set(starts), reverse=True) or starts[-1:] != [0]:
            raise InputError(f"'{file}' has scale_split {starts}, which must be whole numbers falling to 0.")
        return [scale_of_number(names.index(Path(view.name).name), starts) for view in views], f"{POSES_FILE}"
    distances = torch.stack([(view.camera.centre - centre).norm() for view in views])
    return scales_of_distances(distances), "four bins of equal width in log distance from the scene centre"


def scale_of_number(number: int, starts: Sequence[int]) -> int:
    """Return the scale of an image by its number among the sorted ones: they run from near (1) to far."""
    return sum(number >= start for start in starts)


def scales_of_distances(distances: Float[Tensor, "N"]) -> list[int]:
    """Return scales 1 (near) to 4: bins of equal width between the smallest and the largest log distance."""
    logs = distances.double().clamp(min=torch.finfo(torch.float64).tiny).log()
    low, high = logs.min(), logs.max()
    if low == high:
        return [1] * len(logs)
    bins = (SCALES * (logs - low) / (high - low)).long().clamp(max=SCALES - 1)
    return (bins + 1).tolist()


FORMAT = SceneFormat(
    meaning=f"BungeeNeRF city ({POSES_FILE})", sign=POSES_FILE, recognise=lambda path: (path / POSES_FILE).is_file()
)
