"""NeRF-synthetic scenes: RGBA renderings with poses in transforms_{train,val,test}.json (3D-GS)."""

import math
import reprlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from gsx.core.data.camera import pinhole
from gsx.core.data.images import image_size
from gsx.core.data.photo_source import PhotoSource
from gsx.core.data.reduction import Reduction
from gsx.core.data.scene import PointCloud, Scene, View, extent_of
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import at_home
from gsx.core.ranges import Length, Points, Range, Seed
from gsx.core.shapes import UInt8
from gsx.scenes.duplicates import refuse_shared
from gsx.scenes.masked import mask_notes
from gsx.scenes.options import SceneOptions
from gsx.scenes.points import random_points, read_points
from gsx.scenes.posed import (
    Shot,
    finite_number,
    frames_line,
    plain_name,
    pose_from_opengl,
    present_frames,
    provenance,
    read_frames,
    reduction_of,
    refuse_too_few,
    views_of,
)
from gsx.scenes.splits import short

POINTS_FILE = "points3d.ply"  # where 3D-GS caches its random cloud, and conversions put a real one


@dataclass(frozen=True, kw_only=True)
class BlenderOptions(SceneOptions):
    """What `conf/scene/blender.yaml` sets; the files themselves say which images are held out (split=json)."""

    points: str
    """auto: points3d.ply if the folder has one, else random | random | a PLY file, relative to `path`."""
    random_points: Points
    points_bound: Length
    """Random points are uniform in the cube [-points_bound, points_bound]^3, scene units."""
    seed: Seed
    """Of the random points."""
    scales: Annotated[list[int], Range(1, 64)] = field(default_factory=lambda: [1])
    """Factors by which training images are reduced, each a set of views; a factor given twice is trained on twice."""
    test_scales: Annotated[list[int], Range(1, 64)] = field(default_factory=lambda: [1])
    """The same of test images."""

    def __post_init__(self) -> None:
        for name in ("scales", "test_scales"):
            if not getattr(self, name):
                raise ValueError(f"scene.{name} is empty; give whole factors of reduction, 1 or more")
        if len(set(self.test_scales)) < len(self.test_scales):
            raise ValueError(f"scene.test_scales is {list(self.test_scales)}; give each factor once")


def load(options: BlenderOptions) -> Scene:
    """Loads a NeRF-synthetic scene; views keep the order of the files.

    Raises:
        ConfigError: `split` is not `json`, or images are reduced by both `downscale` or `max_width` and `scales`.
        InputError: a file is missing or damaged, there are fewer than two training images, or a scale divides no image.
    """
    if options.split != "json":
        raise ConfigError(f"scene.split is '{short(options.split)}', but transforms_*.json hold the split: use json.")
    folder = at_home(options.path)
    train_file, test_file = folder / "transforms_train.json", _test_file(folder)
    train_shots, train_notes = read_shots(train_file, options.missing)
    test_shots, test_notes = read_shots(test_file, options.missing)
    views = views_of([*train_shots, *test_shots], options)  # together, so that they share one cache
    train, test = views[: len(train_shots)], views[len(train_shots) :]
    refuse_too_few(train, train_file)
    refuse_shared(train, test, test_file)
    grouped = list(options.test_scales) != [1]
    train = [reduced(view, factor) for factor in options.scales for view in train]
    test = [reduced(view, factor, grouped) for factor in options.test_scales for view in test]
    points, points_note = _points(options, folder)
    return Scene(
        name=folder.resolve().name,
        train=train,
        test=test,
        points=points,
        background=torch.tensor(list(options.background), dtype=torch.float32),
        reduction=Reduction() if list(options.scales) != [1] else reduction_of(options),
        extent=extent_of([view.camera for view in train]),
        notes=[*train_notes, *test_notes, *_test_note(test_file), *mask_notes(views, options), points_note],
        provenance=provenance(
            options, views, test_file=test_file.name, points=options.points, **_scales_named(options)
        ),
    )


def reduced(view: View, factor: int, grouped: bool = False) -> View:
    """The view of an image `factor` times smaller, box-averaged before it is composited (Mip-Splatting).

    Raises:
        ConfigError: the view is reduced already.
        InputError: `factor` does not divide the image.
    """
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
    """`box_averaged` as what is done to a decoded file; equal factors are one reduction, whose pictures are shared."""

    factor: int

    def __call__(self, image: UInt8[Tensor, "C H W"]) -> UInt8[Tensor, "C height width"]:
        return box_averaged(image, self.factor)


def box_averaged(image: UInt8[Tensor, "C H W"], factor: int) -> UInt8[Tensor, "C height width"]:
    """Means of factor x factor pixels of each channel, straight alpha among them, truncated to 8 bits (Mip-Splatting).

    Three 2 x 2 averages of floats in a row are one over 8 x 8; here it is exact.
    """
    channels, height, width = image.shape
    blocks = image.reshape(channels, height // factor, factor, width // factor, factor)
    return (blocks.sum((2, 4)) // factor**2).to(torch.uint8)


def _scales_named(options: BlenderOptions) -> dict[str, Any]:
    """For the provenance; nothing for whole images alone, so that their protocol keeps its hash."""
    scales = {"scales": list(options.scales), "test_scales": list(options.test_scales)}
    return {} if scales == {"scales": [1], "test_scales": [1]} else scales


BENDING = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Keys of nerfstudio's transforms for what a lens does to straight lines."""


def left_out(node: Mapping[str, Any], angle: float) -> Iterator[str]:
    """Keys of nerfstudio's transforms that make another camera than an angle of view does."""
    width, height = (finite_number(node.get(key)) or 0.0 for key in ("w", "h"))
    focal = width / (2 * math.tan(angle / 2))
    for key, own in {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}.items():
        value = finite_number(node.get(key))
        if value is not None and abs(value - own) > 0.01 * own:
            yield key
    yield from (key for key in BENDING if node.get(key))


def read_shots(file: Path, missing: float) -> tuple[list[Shot], list[str]]:
    """The shots of one transforms file, in its order, and a note where photos are missing.

    Raises:
        InputError: the file is missing or damaged, or too few of its photos are there.
    """
    content, frames = read_frames(file)
    angle = finite_number(content.get("camera_angle_x"))
    if angle is None or not 0 < angle / 2 < math.pi / 2:  # its half is what the tangent is taken of
        raise InputError(
            f"'{file}' has camera_angle_x {reprlib.repr(content.get('camera_angle_x'))}, which is no angle below pi: "
            "with fl_x use scene=transforms."
        )
    present, notes = present_frames(file.parent, frames, file, missing)
    if stated := sorted({key for node in (content, *frames) for key in left_out(content | node, angle)}):
        notes.append(
            f"{file.name} states {', '.join(stated)}, which the format's published readers leave out, and so does "
            "scene=blender: pictures are taken for those of camera_angle_x, with nothing bent. With one "
            "transforms.json, scene=transforms reads them."
        )
    return [_shot(frame, photo, angle, file) for frame, photo in present], notes


def _shot(frame: dict[str, Any], photo: Path, fov_x: float, file: Path) -> Shot:
    name = plain_name(frame["file_path"])
    rotation, translation = pose_from_opengl(frame.get("transform_matrix"), f"Frame '{name}' of '{file}'")
    width, height = image_size(photo)
    focal = width / (2 * math.tan(fov_x / 2))
    whole = pinhole(rotation, translation, focal, width, height)
    return Shot(name=name, photo=photo, whole=whole, expected_size=(width, height))


def _test_file(folder: Path) -> Path:
    files = [folder / f"transforms_{split}.json" for split in ("test", "val")]
    present = next((file for file in files if file.is_file()), None)
    if present is None:
        raise InputError(
            f"'{folder}' has neither transforms_test.json nor transforms_val.json: set scene.path to a NeRF-synthetic"
            " folder, or use scene=transforms for a single transforms.json."
        )
    return present


def _test_note(file: Path) -> list[str]:
    return [] if file.stem.endswith("test") else [f"Test views are those of {file.name}: there is no test file."]


def _points(options: BlenderOptions, folder: Path) -> tuple[PointCloud, str]:
    """Points and a note on where they come from."""
    stored = folder / (POINTS_FILE if options.points == "auto" else options.points)
    if options.points == "random" or (options.points == "auto" and not stored.is_file()):
        corner = torch.full((3,), options.points_bound, dtype=torch.float64)
        generator = torch.Generator().manual_seed(options.seed)
        cloud = random_points(options.random_points, -corner, corner, generator)
        return cloud, f"Starts from {len(cloud)} random points in [-{options.points_bound}, {options.points_bound}]^3."
    cloud = read_points(stored)
    return cloud, f"Starts from the {len(cloud)} points of {stored.name}."


def facts(path: Path) -> Iterator[str]:
    """Images of every split."""
    return (frames_line(file) for file in sorted(path.glob("transforms_*.json")))


FORMAT = SceneFormat(
    meaning="NeRF-synthetic scene (transforms_train.json)",
    sign="transforms_train.json",
    recognise=lambda path: (path / "transforms_train.json").is_file(),
    facts=facts,
)
