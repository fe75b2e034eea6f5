"""gsx FOLDER: detects the input, prints the equivalent command, trains."""

import logging
from collections.abc import Sequence
from pathlib import Path

from gsx.builtin import plugins
from gsx.cli.train import train
from gsx.core.errors import command
from gsx.core.files import at_home
from gsx.core.plugins import Plugins
from gsx.experiments.runs.inspect import scene_loaders
from gsx.experiments.runs.overrides import word_of
from gsx.experiments.runs.video import is_video, photos_of

logger = logging.getLogger("gsx.cli")


def train_folder(arguments: list[str]) -> int:
    """Train from a folder or a video (first word) with the overrides after it."""
    path, overrides = at_home(arguments[0]), arguments[1:]
    words = scene_words(path, overrides, plugins())
    scene = words[0].partition("=")[2]
    kind = "a video" if path.is_file() and scene == "photos" else f"read as scene={scene}"
    logger.info("%s is %s", path, kind)
    logger.info("%s", command(*words, *overrides))
    return train([*words, *overrides])


def scene_words(path: Path, overrides: Sequence[str], loaded: Plugins) -> list[str]:
    """Return the overrides that choose the scene of a folder or a video.

    Raises:
        InputError: it is neither; for a splat file the message lists the commands that take it.
    """
    if is_video(path):
        output = next((word.partition("=")[2] for word in overrides if word.startswith("output=")), "outputs")
        return ["scene=photos", word_of("scene.path", str(photos_of(path, Path(output))))]
    loader, its = scene_loaders(path, loaded)[0]
    more = [word_of(f"scene.{key}", value) for key, value in its.overrides(path).items()]
    return [f"scene={loader.name}", word_of("scene.path", str(path)), *more]
