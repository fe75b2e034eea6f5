"""Scenes of transforms.json as nerfstudio and instant-ngp write it, or of a file to train on and one to test on.

Poses are camera-to-world with OpenGL axes. Poses and points are used as stored: nerfstudio has already applied its
`applied_transform` and `applied_scale` to both. Photos with distortion are treated as in COLMAP scenes. Depth maps
(`depth_file_path`) are read where `training.depth` uses them.
"""

import reprlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import InputError, nearest
from gsx.core.files import expand_home, is_file
from gsx.core.ranges import Points, Seed
from gsx.scenes.frame_files import FILE, TEST_FILES, TRAIN_FILE, FrameFile, frame_files, is_empty, needs_lens, nodes
from gsx.scenes.lenses import complete_frame, lens_of
from gsx.scenes.masked import mask_notes
from gsx.scenes.options import SceneOptions
from gsx.scenes.orientation import RULES, TurnsOf
from gsx.scenes.points import random_points, stored_points
from gsx.scenes.pose_files import frames_line, plain_name, pose_from_opengl, present_frames
from gsx.scenes.posed import SAME_PLACE, Shot, check_sides, scene_of, shot_notes, shot_through, views_of
from gsx.scenes.splits import Split, photos_of, split_names
from gsx.scenes.undistort import METHOD

LISTS = ("train_filenames", "test_filenames", "val_filenames")
"""Keys of lists of names (nerfstudio): to train on, to test on, and to test on without such a list."""
FALLBACK_SPLIT = "every:8"  # with split=json, for files without lists of names
IGNORED = ("rolling_shutter", "transform_matrix_end", "white_transparent", "black_transparent", "sharpen")
"""Keys of instant-ngp that change its training pictures; others, such as aabb_scale, change only its display."""


@dataclass(frozen=True, kw_only=True)
class TransformsOptions(SceneOptions):
    """Options of `conf/scene/transforms.yaml`; `path` is the folder of transforms.json, or such a file itself.

    `split` can be `json` as well: the file's train_filenames and test_filenames, or its second file, else every:8.
    """

    points: str
    """auto: the file's ply_file_path if it has one, else random | random | a PLY file, relative to the folder."""
    random_points: Points
    """Number of random points, uniform in the smallest cube around the cameras."""
    seed: Seed
    """Seed of the random points."""


def load(options: TransformsOptions) -> Scene:
    """Load a scene of transforms.json, or of a training and a test file; InputError: a file or camera is unusable."""
    parts = frame_files(expand_home(options.path))
    shots, counts, notes, rule = list[Shot](), list[int](), list[str](), RULES[options.orientation]
    for part in parts:
        present, absent = present_frames(part.file.parent, part.frames, part.file, options.missing)
        frames = [(complete_frame(part.content, frame), photo) for frame, photo in present]
        shots += [_shot(frame, photo, part.file, rule, options.lens == "native") for frame, photo in frames]
        counts.append(len(present))
        notes += absent
    views = views_of(shots, options)
    sides, split_notes = _split(parts, counts[0], views, options.split)
    check_sides(sides, parts[0].file)
    points, points_note = _points(parts[0], views, options)
    notes += [*shot_notes(shots), *mask_notes(views, options), *split_notes, *_ignored(parts), points_note]
    other = {"test_file": parts[-1].file.name} if parts[-1].file != parts[0].file else {}
    undistortion = METHOD if any(shot.remap is not None for shot in shots) else None
    details = {"points": options.points, "undistortion": undistortion, **other}
    return scene_of(options, parts[0].file.parent, views, sides, points, notes, details)


def _shot(entry: Mapping[str, Any], photo: Path, file: Path, turns_of: TurnsOf, native: bool) -> Shot:
    """Return the shot of a frame that is completed by the file's common values."""
    name = plain_name(entry["file_path"])
    place = f"Frame '{name}' of '{file}'"
    rotation, translation = pose_from_opengl(entry.get("transform_matrix"), place)
    shot = shot_through(lens_of(entry, photo, place), name, photo, rotation, translation, turns_of, native)
    stated = (entry.get("mask_path"), entry.get("depth_file_path"))
    mask, depth = (None if path is None else file.parent / plain_name(str(path)) for path in stated)
    return replace(shot, mask=mask, depth=depth)


def _ignored(parts: Sequence[FrameFile]) -> list[str]:
    """Return a note on keys that change pictures in instant-ngp and nothing here."""
    values = ((key, node.get(key)) for part in parts for node in nodes(part) for key in IGNORED)
    stated = sorted({key for key, value in values if (any(value) if isinstance(value, list) else value)})
    return [f"{parts[0].file.name} states {', '.join(stated)}: left out, photos are used as stored."] * bool(stated)


def _split(
    parts: Sequence[FrameFile], count: int, views: Sequence[View], rule: str
) -> tuple[tuple[list[View], list[View]], list[str]]:
    """Return training and test views, and a note on the split; `count`: views of the first part."""
    names, file, content = [view.name for view in views], parts[0].file, parts[0].content
    notes = []
    if rule != "json":
        train, test = split_names(names, rule, file.parent, photos_of(views))
    elif len(parts) > 1:
        train, test = list(range(count)), list(range(count, len(views)))
        notes = [f"Test views are those of {parts[1].file.name}."]
    elif any(key in content for key in LISTS):
        train, test = _listed_split(content, names, file)
    else:
        train, test = split_names(names, FALLBACK_SPLIT)
        notes = [f"{file.name} lists no train_filenames: the split is {FALLBACK_SPLIT}."]
    return ([views[i] for i in train], [views[i] for i in test]), notes


def _listed_split(content: Mapping[str, Any], names: Sequence[str], file: Path) -> Split:
    """Return positions of the names in the file's lists; names of missing photos are skipped.

    Without train_filenames, all names outside the other list are trained on.
    """
    train_key, *others = LISTS
    test_key = next((key for key in others if key in content), others[0])
    known = {plain_name(frame["file_path"]) for frame in content["frames"]}
    test = _listed(content, test_key, known, file)
    train = _listed(content, train_key, known, file) if train_key in content else known - test
    if train & test:
        raise InputError(f"'{min(train & test)}' is in {train_key} and {test_key} of '{file}', remove it from one.")
    split = [i for i, name in enumerate(names) if name in train], [i for i, name in enumerate(names) if name in test]
    if not split[1]:
        remedy = "use another scene.split: every:8, or none to hold out no image"
        raise InputError(f"{test_key} of '{file}' names no image that is on disk, {remedy}.")
    return split


def _listed(content: Mapping[str, Any], key: str, known: set[str], file: Path) -> set[str]:
    """Return the names of a file's list; InputError: it is no list, or holds a name that no frame has."""
    names = content.get(key, [])
    if not isinstance(names, list):
        raise InputError(f"{key} of '{file}' is {reprlib.repr(names)}: give a list, or another scene.split.")
    listed = {plain_name(str(name)) for name in names}
    if unknown := sorted(listed - known):
        raise InputError(f"{key} of '{file}' names {unknown[0]!r}, which is no frame.{nearest(unknown[0], known)}")
    return listed


def _points(part: FrameFile, views: Sequence[View], options: TransformsOptions) -> tuple[PointCloud, str]:
    """Return points and a note on their source."""
    file = part.file
    name = _stored(part.content, file) if options.points == "auto" else options.points
    if name != "random":
        return stored_points(file.parent, name)
    centres = torch.stack([view.camera.centre for view in views])
    low, high = centres.amin(0), centres.amax(0)
    middle, half = (low + high) / 2, (high - low).max() / 2
    if not float(2 * half) * options.unit > SAME_PLACE:
        raise InputError(
            f"All {len(views)} cameras of '{file}' stand within {float(2 * half):.3g} units of each other, as on a "
            "tripod, so that random points would have no depth: set scene.points to a PLY file of the scene, or use "
            "photos from different places."
        )
    generator = torch.Generator().manual_seed(options.seed)
    cloud = random_points(options.random_points, middle - half, middle + half, generator)
    return cloud, f"Starts from {len(cloud)} random points in the cube around the cameras."


def _stored(content: Mapping[str, Any], file: Path) -> str:
    """Return a transforms file's PLY file, relative to its folder, or `random`; InputError: the file is missing."""
    name = content.get("ply_file_path")
    if name is None:
        return "random"
    if isinstance(name, str) and is_file(file.parent / plain_name(name)):
        return plain_name(name)
    raise InputError(
        f"ply_file_path {repr(name)[:200]} of '{file}' is no file there: restore it, or set scene.points=random."
    )


def recognise(path: Path) -> bool:
    """Recognise a transforms file, or the folder of one whose cameras have more than an angle of view."""
    single = (path / FILE).is_file() or (path.suffix == ".json" and path.is_file())
    return single or ((path / TRAIN_FILE).is_file() and needs_lens(path / TRAIN_FILE))


def facts(path: Path) -> Iterator[str]:
    """Yield a line on the images of each transforms file."""
    single = path if path.is_file() else path / FILE
    files = [single] if single.is_file() else [path / name for name in (TRAIN_FILE, *TEST_FILES)]
    return (frames_line(file) for file in files if file.is_file() and not is_empty(file))


FORMAT = SceneFormat(
    meaning="poses and lenses in transforms.json (nerfstudio, instant-ngp)",
    sign=FILE,
    recognise=recognise,
    facts=facts,
)
