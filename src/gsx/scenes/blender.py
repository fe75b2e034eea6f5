"""NeRF-synthetic scenes: RGBA renderings with poses in transforms_{train,val,test}.json (3D-GS)."""

import math
import reprlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, pinhole
from gsx.core.data.images import image_size
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import expand_home
from gsx.core.ranges import Length, Points, Range, Seed
from gsx.core.shapes import UInt8
from gsx.formats.origin import in_words
from gsx.scenes.frame_files import TEST_FILES, TRAIN_FILE, is_empty, needs_lens, test_file
from gsx.scenes.lenses import angle_of, beyond_angle, states_lens
from gsx.scenes.masked import mask_notes
from gsx.scenes.options import SceneOptions
from gsx.scenes.origin import focus_of, origin_of_cameras
from gsx.scenes.photo_source import PhotoSource
from gsx.scenes.points import random_points, stored_points
from gsx.scenes.pose_files import frames_line, plain_name, pose_from_opengl, present_frames, read_frames
from gsx.scenes.posed import Shot, check_sides, scene_of, views_of
from gsx.scenes.splits import photos_of, short, split_names

POINTS_FILE = "points3d.ply"  # where 3D-GS caches its random cloud, and conversions put a real one


@dataclass(frozen=True, kw_only=True)
class BlenderOptions(SceneOptions):
    """Options of `conf/scene/blender.yaml`; with split=json the files are the split.

    `split` can be `none` as well, which trains on the images of both files, and any rule where there is only one file.
    """

    points: str
    """auto: points3d.ply if the folder has one, else random | random | a PLY file, relative to `path`."""
    random_points: Points
    points_bound: Length
    """Random points are uniform in [-points_bound, points_bound]^3, scene units."""
    seed: Seed
    """Seed of the random points."""
    scales: Annotated[list[int], Range(1, 64)] = field(default_factory=lambda: [1])
    """Factors of reduction of training images, each a set of views; a repeated factor is trained on repeatedly."""
    test_scales: Annotated[list[int], Range(1, 64)] = field(default_factory=lambda: [1])
    """Factors of reduction of test images."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("scales", "test_scales"):
            if not getattr(self, name):
                raise ValueError(f"scene.{name} is empty; give whole factors of reduction, 1 or more")
        if len(set(self.test_scales)) < len(self.test_scales):
            raise ValueError(f"scene.test_scales is {list(self.test_scales)}; give each factor once")


def load(options: BlenderOptions) -> Scene:
    """Load a NeRF-synthetic scene; views keep the order of the files.

    Raises:
        ConfigError: `split` contradicts the files, or `downscale` or `max_width` reduce images as well as `scales`.
        InputError: a file is missing or damaged, there are fewer than two training images, or a scale divides no image.
    """
    folder = expand_home(options.path)
    train_file, held_out = folder / TRAIN_FILE, _test_file(folder, options.split)
    train_shots, notes = read_shots(train_file, options.missing)
    test_shots, test_notes = read_shots(held_out, options.missing) if held_out else ([], [])
    views = views_of([*train_shots, *test_shots], options)  # together, so that they share one cache
    sides = _split(views, len(train_shots), options.split, folder)
    check_sides(sides, held_out or train_file)
    points, points_note = _points(options, folder, [view.camera for view in views])
    if held_out is not None and not held_out.stem.endswith("test") and options.split == "json":
        test_notes = [*test_notes, f"Test views are those of {held_out.name}: there is no test file."]
    notes = [*notes, *test_notes, *mask_notes(views, options), points_note]
    details = {"test_file": held_out.name if held_out else None, "points": options.points}
    return at_scales(scene_of(options, folder, views, sides, points, notes, details), options)


def at_scales(scene: Scene, options: BlenderOptions) -> Scene:
    """Return the scene with each view at each scale; for whole images alone, the protocol keeps its hash."""
    scales, test_scales = list(options.scales), list(options.test_scales)
    if scales == test_scales == [1]:
        return scene
    grouped = test_scales != [1]
    train = [reduced(view, factor) for factor in scales for view in scene.train]
    return replace(
        scene,
        train=train,
        test=[reduced(view, factor, grouped) for factor in test_scales for view in scene.test],
        extent=extent_of([view.camera for view in train]),
        reduction=Reduction() if scales != [1] else scene.reduction,
        provenance=scene.provenance | {"scales": scales, "test_scales": test_scales},
    )


def reduced(view: View, factor: int, grouped: bool = False) -> View:
    """Reduce an image by box averages before compositing (Mip-Splatting); ConfigError, InputError: it cannot be."""
    name, source = "x1" if factor == 1 else f"x1/{factor}", view.source
    group = name if grouped else ""
    if factor == 1:
        return replace(view, group=group)
    assert isinstance(source, PhotoSource)
    width, height = source.whole.size
    if view.camera.size != source.whole.size:
        raise ConfigError("scene.scales and test_scales reduce whole images: use scene.downscale=1 scene.max_width=0")
    if width % factor or height % factor:
        raise InputError(
            f"Image '{source.path}' of {width} x {height} does not divide by {factor}: leave that scale out."
        )
    size = width // factor, height // factor
    smaller = replace(source, whole=source.whole.resize(*size), remap=BoxAverage(factor))
    return View(f"{view.name} {name}", view.camera.resize(*size), smaller, group)


@dataclass(frozen=True)
class BoxAverage:
    """Means of factor x factor pixels of each channel, straight alpha included, truncated to 8 bits (Mip-Splatting).

    Three 2 x 2 averages of floats in a row equal one over 8 x 8, which is exact here. Equal factors share pictures.
    """

    factor: int

    def __call__(self, image: UInt8[Tensor, "C H W"]) -> UInt8[Tensor, "C height width"]:
        channels, height, width = image.shape
        blocks = image.reshape(channels, height // self.factor, self.factor, width // self.factor, self.factor)
        return (blocks.sum((2, 4)) // self.factor**2).to(torch.uint8)


def read_shots(file: Path, missing: float) -> tuple[list[Shot], list[str]]:
    """Read the shots of a transforms file in order, and notes; InputError: it, or too many photos, are missing."""
    content, frames = read_frames(file)
    angle = angle_of(content)
    if angle is None:
        known = any(map(states_lens, (content, *frames)))
        remedy = "with fl_x use scene=transforms" if known else "add the horizontal angle of view in radians"
        stated = reprlib.repr(content.get("camera_angle_x"))
        raise InputError(f"'{file}' has camera_angle_x {stated}, which is no angle below pi: {remedy}.")
    present, notes = present_frames(file.parent, frames, file, missing)
    if keys := sorted({key for frame in ({}, *frames) for key in beyond_angle(content, frame)}):
        notes.append(
            f"{file.name} states {', '.join(keys)}, which the format's published readers and scene=blender leave "
            "out: they use camera_angle_x alone, without distortion. scene=transforms reads them."
        )
    return [_shot(frame, photo, angle, file) for frame, photo in present], notes


def _shot(frame: dict[str, Any], photo: Path, fov_x: float, file: Path) -> Shot:
    name = plain_name(frame["file_path"])
    rotation, translation = pose_from_opengl(frame.get("transform_matrix"), f"Frame '{name}' of '{file}'")
    width, height = image_size(photo)
    whole = pinhole(rotation, translation, width / (2 * math.tan(fov_x / 2)), width, height)
    return Shot(name=name, photo=photo, whole=whole, expected_size=(width, height))


def _test_file(folder: Path, rule: str) -> Path | None:
    """Return the file of the test images, if any; ConfigError, InputError: `rule` contradicts the files."""
    file = test_file(folder)
    if file is None and rule == "json":
        raise InputError(
            f"'{folder}' has neither {' nor '.join(TEST_FILES)} with frames: hold out training "
            "images with scene.split=every:8, or none with scene.split=none."
        )
    if file is not None and rule not in ("json", "none"):
        raise ConfigError(
            f"scene.split is '{short(rule)}', but transforms_*.json hold the split: use json, or none to train on all."
        )
    return file


def _split(views: Sequence[View], count: int, rule: str, folder: Path) -> tuple[list[View], list[View]]:
    """Return training and test views: by the files, of which the first has `count` images, or by a rule."""
    if rule == "json":
        return list(views[:count]), list(views[count:])
    train, test = split_names([view.name for view in views], rule, folder, photos_of(views))
    return [views[i] for i in train], [views[i] for i in test]


def _points(options: BlenderOptions, folder: Path, cameras: Sequence[Camera]) -> tuple[PointCloud, str]:
    """Return points and a note; random ones lie around (0, 0, 0), or around the focus of far cameras."""
    auto = options.points == "auto"
    name = POINTS_FILE if auto else options.points
    if name != "random" and not (auto and not (folder / name).is_file()):
        return stored_points(folder, name)
    corner = torch.full((3,), options.points_bound, dtype=torch.float64)
    generator = torch.Generator().manual_seed(options.seed)
    far = any(origin_of_cameras(cameras, options.points_bound))
    middle = focus_of(cameras) if far else torch.zeros_like(corner)
    cloud = random_points(options.random_points, middle - corner, middle + corner, generator)
    about = f" around {in_words(middle.round(decimals=3).tolist())}, the focus of the cameras" if far else ""
    cube = f"[-{options.points_bound}, {options.points_bound}]^3{about}"
    return cloud, f"Starts from {len(cloud)} random points in {cube}."


def facts(path: Path) -> Iterator[str]:
    """Yield a line on the images of each transforms file."""
    return (frames_line(file) for file in sorted(path.glob("transforms_*.json")) if not is_empty(file))


def recognise(path: Path) -> bool:
    """Recognise a folder with transforms_train.json whose cameras have nothing but an angle of view."""
    return (path / TRAIN_FILE).is_file() and not needs_lens(path / TRAIN_FILE)


def overrides(path: Path) -> dict[str, str]:
    """Return a split for a folder without a test file."""
    return {} if test_file(path) else {"split": "every:8"}


FORMAT = SceneFormat(
    meaning="NeRF-synthetic scene (transforms_train.json)",
    sign=TRAIN_FILE,
    recognise=recognise,
    facts=facts,
    overrides=overrides,
)
