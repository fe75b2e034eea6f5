"""What is in this folder? Answers `gsx scenes PATH`, also for folders that cannot be trained from."""

import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsx.core.data.scene import Scene
from gsx.core.errors import GsxError, InputError
from gsx.core.plugins import load_plugins
from gsx.experiments.runs.compose import compose_raw, hydra_session
from gsx.experiments.runs.settings import typed
from gsx.scenes import blender, bungee, colmap, photos, transforms
from gsx.scenes.colmap_model import Model, find_model, model_folders, read_model
from gsx.scenes.posed import find_photo, named, read_frames

IMAGES = "images"  # where photos are looked for first

MEANINGS = {
    "bungee": "BungeeNeRF city (poses_enu.json)",
    "blender": "NeRF-synthetic scene (transforms_train.json)",
    "colmap": "COLMAP model with photos",
    "transforms": "poses in one transforms.json (nerfstudio, instant-ngp)",
    "photos": "photos without poses, which are reconstructed first",
}


@dataclass
class Findings:
    """What is found out about a folder, by questions of which any may fail."""

    lines: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    command: str = ""
    """Trains the scene."""

    def ask(self, question: Callable[[], Iterable[str]]) -> None:
        """Take the lines that `question` yields; its error becomes a problem."""
        try:
            for line in question():
                self.lines.append(line)
        except GsxError as problem:
            self.problems.append(str(problem))
        except Exception as problem:  # whatever a folder holds, it is to be described
            self.problems.append(f"{type(problem).__name__}: {problem}")


def describe(path: str | Path) -> list[str]:
    """Lines about a folder: format, cameras, images, points, problems and the command to train it. Never raises."""
    path = Path(path).expanduser()
    found = Findings()
    found.ask(lambda: _describe_format(path))
    if found.lines:
        kind = detect(path)[0]
        found.command = _command(kind, path)
        found.ask(lambda: DESCRIBERS[kind](path, found))
    problems = [f"problem   {problem}" for problem in found.problems]
    label = "then" if problems else "train"
    return [*found.lines, *problems, *([f"{label:10}{found.command}"] if found.command else [])]


def detect(path: Path) -> list[str]:
    """The formats that a folder can be read as, the most telling first."""
    signs = {
        "bungee": (path / bungee.POSES_FILE).is_file(),
        "blender": (path / "transforms_train.json").is_file(),
        "colmap": path.is_dir() and bool(model_folders(path)),
        "transforms": (path / transforms.FILE).is_file() or (path.suffix == ".json" and path.is_file()),
        "photos": path.is_dir() and bool(photos.photos_in(path, "*") or photos.photos_in(path / IMAGES, "**/*")),
    }
    return [kind for kind, present in signs.items() if present]


def _describe_format(path: Path) -> Iterator[str]:
    kinds = detect(path)
    if not kinds:
        raise _unknown(path)
    yield f"format    {kinds[0]}: {MEANINGS[kinds[0]]}"
    if kinds[1:]:
        yield f"also      readable as scene={' or scene='.join(kinds[1:])}"


def _unknown(path: Path) -> InputError:
    if not path.is_dir():
        return InputError(f"'{path}' is no folder: check the name.")
    inner = {folder.name: detect(folder) for folder in sorted(path.iterdir()) if folder.is_dir()}
    scenes = [f"{name} ({kinds[0]})" for name, kinds in inner.items() if kinds]
    below = f" There are scenes below it: {', '.join(scenes)}." if scenes else ""
    return InputError(
        f"'{path}' is no scene: it has neither a COLMAP model (sparse/), nor a transforms.json or "
        f"transforms_train.json, nor {bungee.POSES_FILE}, nor photos ({', '.join(photos.PHOTO_SUFFIXES)}).{below}"
    )


def _command(kind: str, path: Path, *overrides: str) -> str:
    return shlex.join(["gsx", f"scene={kind}", f"scene.path={path}", *overrides])


def _options(kind: str, schema: type, path: Path, **changes: str) -> Any:
    """The options that `gsx scene=<kind> scene.path=<path>` means."""
    with hydra_session(load_plugins([], [])):
        defaults = compose_raw([f"scene={kind}"]).scene
    return typed(schema, {**defaults, "path": str(path), **changes}, "scene")


def _describe_colmap(path: Path, found: Findings) -> Iterator[str]:
    folder, notes = find_model(path)
    model = read_model(folder)
    yield f"model     {folder}: {len(model.images)} images, mean reprojection error {model.mean_error:.2f} px"
    yield from _describe_lenses(model)
    images = image_folder(path, model)
    present = [image.name for image in model.images if (path / images / image.name).is_file()]
    absent = sorted({image.name for image in model.images} - set(present))
    yield f"images    {len(present)} of {len(model.images)} in {images}" + (
        f", absent: {named(absent)}" if absent else ""
    )
    overrides = {"images": images} if images != IMAGES else {}
    found.command = _command("colmap", path, *(f"scene.{key}={value}" for key, value in overrides.items()))
    options = _options("colmap", colmap.ColmapOptions, path, **overrides)
    yield from _describe_scene(colmap.build(model, path / images, options, notes))


def _describe_lenses(model: Model) -> Iterator[str]:
    cameras = [model.cameras[image.camera_id] for image in model.images]
    kinds = Counter((camera.model_name, camera.width, camera.height) for camera in cameras)
    for (name, width, height), count in sorted(kinds.items()):
        yield f"camera    {name} {width}x{height}, {count} images"


def image_folder(path: Path, model: Model) -> str:
    """The folder below `path` with most of the model's images; `images` unless another has more."""
    others = sorted(folder.name for folder in path.iterdir() if folder.is_dir() and folder.name != IMAGES)
    return max(
        (IMAGES, *others, "."), key=lambda folder: sum((path / folder / image.name).is_file() for image in model.images)
    )


def _describe_blender(path: Path, found: Findings) -> Iterator[str]:
    for file in sorted(path.glob("transforms_*.json")):
        yield _describe_frames(file)
    yield from _describe_scene(blender.load(_options("blender", blender.BlenderOptions, path)))


def _describe_transforms(path: Path, found: Findings) -> Iterator[str]:
    yield _describe_frames(path if path.is_file() else path / transforms.FILE)
    yield from _describe_scene(transforms.load(_options("transforms", transforms.TransformsOptions, path)))


def _describe_frames(file: Path) -> str:
    names = [frame["file_path"] for frame in read_frames(file)[1]]
    absent = [name for name in names if find_photo(file.parent, name) is None]
    return f"images    {len(names) - len(absent)} of {len(names)} of {file.name}" + (
        f", absent: {named(absent)}" if absent else ""
    )


def _describe_bungee(path: Path, found: Findings) -> Iterator[str]:
    yield from _describe_scene(bungee.load(_options("bungee", bungee.BungeeOptions, path)))


def _describe_photos(path: Path, found: Findings) -> Iterator[str]:
    folder, names = photos.find_photos(path)
    sizes, notes = photos.readable_sizes(folder, names)
    for (width, height), count in sorted(Counter(sizes.values()).items()):
        yield f"images    {count} of {width}x{height} in {folder}"
    yield from (f"note      {note}" for note in notes)


def _describe_scene(scene: Scene) -> Iterator[str]:
    """What the loader made of it."""
    views = [*scene.train, *scene.test]
    for (width, height), count in sorted(Counter(view.camera.size for view in views).items()):
        yield f"views     {count} of {width}x{height}"
    yield f"split     {len(scene.train)} to train on, {len(scene.test)} to test on"
    yield f"points    {len(scene.points)}"
    yield f"extent    {scene.extent:.4g} scene units (1.1 x the farthest camera from their mean)"
    yield from (f"note      {note}" for note in scene.notes)


DESCRIBERS: dict[str, Callable[[Path, Findings], Iterator[str]]] = {
    "bungee": _describe_bungee,
    "blender": _describe_blender,
    "colmap": _describe_colmap,
    "transforms": _describe_transforms,
    "photos": _describe_photos,
}
