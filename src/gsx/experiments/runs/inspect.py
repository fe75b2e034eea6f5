"""Describes the content of a folder for `gsx scenes PATH`, also if it cannot be trained from."""

import logging
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from gsx.core.data.scene import Scene
from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import GsxError, InputError, command
from gsx.core.files import expand_home
from gsx.core.plugins import Component, Plugins
from gsx.experiments.run_folder.files import FIRST_FILES
from gsx.experiments.runs.capture import capture_lines
from gsx.experiments.runs.compose import compose_raw, hydra_session
from gsx.experiments.runs.load_scene import in_one_place, measured
from gsx.experiments.runs.overrides import word_of
from gsx.experiments.runs.typed import typed
from gsx.formats.suffixes import META, splat_file_at, suffix_of
from gsx.scenes.origin import around_origin, origin_of

logger = logging.getLogger(__name__)

SOG_PICTURE = "means_l.webp"
"""A picture of every unbundled SOG."""
Readable = list[tuple[Component, SceneFormat]]
"""Loaders that can read a folder, the most specific first."""


@dataclass
class Findings:
    """Lines about a folder, from steps of which any may fail."""

    lines: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    command: str = ""
    """Command that trains the scene."""

    def add(self, lines: Iterable[str]) -> None:
        """Add lines as they are yielded; an error becomes a problem."""
        try:
            for line in lines:
                self.lines.append(line)
        except GsxError as problem:
            self.problems.append(str(problem))
        except Exception as problem:  # the content of a folder may break any reader
            self.problems.append(f"{type(problem).__name__}: {problem}")


def describe(path: str | Path, plugins: Plugins, patient: bool = False) -> list[str]:
    """Return lines about a folder: format, cameras, images, points, capture, problems, and the command to train it.

    patient: also load what takes minutes. Never raises.
    """
    path, findings = expand_home(path), Findings()
    loaders: Readable = []

    def formats() -> Iterator[str]:
        loaders.extend(scene_loaders(path, plugins))
        (loader, its), *others = loaders
        yield f"format    {loader.name}: {its.meaning}"
        if others:
            yield f"also      readable as scene={' or scene='.join(other.name for other, _ in others)}"

    findings.add(formats())
    if loaders:
        findings.command = training_command(loaders[0][0], path, {})
        findings.add(scene_lines(*loaders[0], path, findings, plugins, patient))
    problems = [f"problem   {problem}" for problem in findings.problems]
    label = "then" if problems else "train"
    return [*findings.lines, *problems, *([f"{label:10}{findings.command}"] if findings.command else [])]


def scene_loaders(path: Path, plugins: Plugins) -> Readable:
    """Return the loaders that can read a folder; raise InputError if there is none, or for a run or a splat file."""
    refuse_run(path)
    refuse_splats(path)
    if loaders := readable(path, plugins):
        return loaders
    raise unknown(path, plugins)


def readable(path: Path, plugins: Plugins) -> Readable:
    """Return the loaders that can read a folder, the most specific first; log one that fails."""
    loaders: Readable = []
    for loader, its in plugins.registry.formats():
        try:
            if its.recognise(path):
                loaders.append((loader, its))
        except Exception as error:  # of a plugin; others may read it
            logger.warning("scene=%s failed on %s (%s: %s)", loader.name, path, type(error).__name__, error)
    return loaders


def refuse_run(path: Path) -> None:
    """Raise InputError for a run folder."""
    others = any((path / name).exists() for name in (*FIRST_FILES, "checkpoints"))
    if others and (path / "config.yaml").is_file():
        verbs = ", ".join(command(verb, path) for verb in ("view", "eval", "resume"))
        raise InputError(f"{path} is a run, not a scene. Use it with {verbs}")


def refuse_splats(path: Path) -> None:
    """Raise InputError for a splat file or the folder of a SOG, whose pictures are not photos."""
    file = splat_file_at(path)
    if file.is_file() and suffix_of(file):
        kind = "a splat file" if path.is_file() else f"an unbundled SOG, whose pictures hold splats ({file.name})"
        raise InputError(
            f"{path} is {kind}, not a scene. Use it with {command('view', path)}, {command('eval', path)} scene=... "
            f"scene.path=FOLDER, or train on with {shlex.quote(word_of('init', str(path)))} scene=... scene.path=FOLDER"
        )
    if (path / SOG_PICTURE).is_file():
        raise InputError(f"{path} holds pictures of a SOG ({SOG_PICTURE}) but no {META}: copy that file as well.")


def unknown(path: Path, plugins: Plugins) -> InputError:
    """Return the error for a folder that no loader reads, with the files that they look for."""
    if not path.is_dir():
        return InputError(f"'{path}' is not a folder: check the name.")
    inner = {folder.name: readable(folder, plugins) for folder in sorted(path.iterdir()) if folder.is_dir()}
    scenes = [f"{name} ({loaders[0][0].name})" for name, loaders in inner.items() if loaders]
    below = f" There are scenes below it: {', '.join(scenes)}." if scenes else ""
    signs = ", no ".join(its.sign for _, its in plugins.registry.formats())
    return InputError(f"'{path}' is not a scene: it has no {signs}.{below}")


def scene_lines(
    loader: Component, its: SceneFormat, path: Path, findings: Findings, plugins: Plugins, patient: bool
) -> Iterator[str]:
    """Yield the content of a folder and of the scene that the loader makes of it."""
    yield from its.facts(path)
    overrides = its.overrides(path)
    findings.command = training_command(loader, path, overrides)
    if its.quick or patient:
        loaded = loader.factory(options_for(loader, path, overrides, plugins))
        scene = measured(around_origin(loaded, origin_of(loaded)))
        yield from loaded_lines(scene)
        findings.add(capture_lines(scene))
    else:
        yield f"poses     unknown: {command('scenes', path, '--poses')} estimates them and checks coverage"


def training_command(loader: Component, path: Path, overrides: Mapping[str, str]) -> str:
    """Return the command that trains from a folder."""
    more = [word_of(f"scene.{key}", value) for key, value in overrides.items()]
    return command(f"scene={loader.name}", word_of("scene.path", str(path)), *more)


def options_for(loader: Component, path: Path, overrides: Mapping[str, str], plugins: Plugins) -> Any:
    """Return the scene options of that command."""
    with hydra_session(plugins):
        node = OmegaConf.merge(
            compose_raw([f"scene={loader.name}"], plugins.registry).scene, {"path": str(path)} | dict(overrides)
        )
    return typed(loader.options, OmegaConf.to_container(node, resolve=True), "scene")


def loaded_lines(scene: Scene) -> Iterator[str]:
    """Yield views, split, points, extent and notes of a scene."""
    views = [*scene.train, *scene.test]
    for (width, height), count in sorted(Counter(view.camera.size for view in views).items()):
        yield f"views     {count} of {width}x{height}"
    yield f"split     {len(scene.train)} to train on, {len(scene.test)} to test on"
    yield f"points    {len(scene.points)}"
    still = in_one_place([view.camera for view in scene.train], scene.points)
    source = "median distance of the points: cameras stand in one place" if still else "farthest camera from their mean"
    yield f"extent    {scene.extent:.4g} scene units (1.1 x the {source})"
    yield from (f"note      {note}" for note in scene.notes)
