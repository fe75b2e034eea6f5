"""gsx FOLDER: detects the input, prints the equivalent command, trains."""

import logging
from collections.abc import Sequence
from pathlib import Path

from gsx.builtin import plugins
from gsx.cli.train import verb_train
from gsx.core.errors import ConfigError, command
from gsx.core.files import expand_home
from gsx.core.plugins import Plugins
from gsx.engine.collector import loading

logger = logging.getLogger("gsx.cli")


def is_given(word: str) -> bool:
    """Returns whether a word of the command line is a folder or file."""
    return expand_home(word).exists()


def train_from(arguments: list[str]) -> int:
    """gsx FOLDER|VIDEO [KEY=VALUE ...]: trains from it, as whatever it is."""
    path, overrides = expand_home(arguments[0]), arguments[1:]
    odd = next((word for word in overrides if "=" not in word or word.startswith(("scene=", "scene.path="))), "")
    if odd:
        raise ConfigError(f"gsx {arguments[0]}: '{odd}' does not go with it: it says itself what scene it is")
    with loading():
        loaded = plugins()
    words = scene_words(path, overrides, loaded)
    scene = words[0].partition("=")[2]
    kind = "a video" if path.is_file() and scene == "photos" else f"read as scene={scene}"
    logger.info("%s is %s", path, kind)
    logger.info("%s", command(*words, *overrides))
    return verb_train([*words, *overrides])


def scene_words(path: Path, overrides: Sequence[str], loaded: Plugins) -> list[str]:
    """Returns words of the command line for the scene that a folder or a video is.

    Raises:
        InputError: it is none; of a splat file the message says what can be done with it.
    """
    from gsx.experiments.runs.inspect import scene_loaders
    from gsx.experiments.runs.overrides import word_of
    from gsx.experiments.runs.video import is_video, photos_of

    if is_video(path):
        output = next((word.partition("=")[2] for word in overrides if word.startswith("output=")), "outputs")
        return ["scene=photos", word_of("scene.path", str(photos_of(path, Path(output))))]
    loader, its = scene_loaders(path, loaded)[0]
    more = [word_of(f"scene.{key}", value) for key, value in its.overrides(path).items()]
    return [f"scene={loader.name}", word_of("scene.path", str(path)), *more]
