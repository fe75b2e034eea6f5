"""Parsers of `gsx prepare` and `gsx judge`."""

import argparse
from pathlib import Path

from gsx.cli.arguments import Parser
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import expand_home
from gsx.experiments.runs.overrides import is_override, key_of

SETTINGS = (
    *("scene", "dataset", "data_root", "protocol", "eval", "metrics", "device", "seed", "axes"),
    *("rasterizer", "regenerator"),
)
"""Settings of scene and figures; other words NAME=PATH are methods."""
SCENE = ("scene=", "dataset=")
"""Settings that choose a scene."""


def parse_methods(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx judge METHOD=PATH ... FOLDER|PREPARED ... [KEY=VALUE ...] [options]`."""
    description = (
        "Measure pictures or splats of any program on the test views of a scene, next to each other. PATH is a folder "
        "of rendered pictures, a splat file, or a run folder. For example: gsx judge ours=renders theirs=model.ply "
        "FOLDER scene.downscale=4. In PATH, {scene} stands for the name of each prepared scene; a METHOD that is named "
        "again is another repetition of it, such as another seed."
    )
    parser = Parser("judge", description, "METHOD=PATH ... FOLDER|PREPARED ... [KEY=VALUE ...] [options]")
    parser.settings = True
    words = "methods, the folder of the scene or folders of gsx prepare, and settings"
    parser.add_argument("words", nargs="*", default=[], metavar="METHOD=PATH|FOLDER|KEY=VALUE", help=words)
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="new folder for the page (outputs/comparisons/TIME)")
    against = "method that the others are compared with (the first)"
    parser.add_argument("--against", default="", metavar="METHOD", help=against)
    protocols = "measure by each of these protocols of conf/protocol; sizes and test views stay those of the scene"
    parser.add_argument("--protocols", type=names, default=[], metavar="A,B", help=protocols)
    order = "list of the views that numbered pictures show, one a line, or a camera file"
    parser.add_argument("--order", type=Path, metavar="FILE", help=order)
    depth = "run or splat file by whose depth the consistency of pictures is measured"
    parser.add_argument("--depth", type=Path, metavar="RUN|FILE", help=depth)
    partial = "measure the test views that all methods have, if some lack pictures"
    parser.add_argument("--partial", action="store_true", help=partial)
    options = parser.parse_intermixed_args(arguments)
    options.line = arguments
    options.methods, options.folders, options.overrides = sorted_words(options.words)
    for flag in ("order", "depth"):
        if (path := getattr(options, flag)) is not None and not path.exists():
            raise InputError(f"gsx judge: --{flag} {path} does not exist: check its name")
    return options


def names(word: str) -> list[str]:
    """Split names at commas; a name that is repeated counts once. ConfigError: there is none."""
    found = list(dict.fromkeys(name.strip() for name in word.split(",") if name.strip()))
    if not found:
        raise ConfigError(
            f"gsx judge: --protocols '{word}' names no protocol: leave it out, or name those of conf/protocol"
        )
    return found


def sorted_words(words: list[str]) -> tuple[list[tuple[str, Path]], list[Path], list[str]]:
    """Return methods with their paths, folders, and settings.

    Raises:
        ConfigError, InputError: a word is none of these, or a path does not exist.
    """
    methods, folders, overrides = list[tuple[str, Path]](), list[Path](), list[str]()
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            folders.append(existing_folder(word))
        elif is_override(word) and key_of(word) in SETTINGS:
            overrides.append(word)
        else:
            methods.append((name, existing_path(name, value)))
    if not methods:
        raise ConfigError(
            "gsx judge needs at least one method: give NAME=PATH, for example ours=renders. Names "
            f"of settings ({', '.join(SETTINGS[:5])} ...) cannot be names of methods"
        )
    return methods, folders, overrides


def existing_folder(word: str) -> Path:
    """Return the folder of a scene; raise InputError if there is none."""
    folder = expand_home(word)
    if not folder.is_dir():
        raise InputError(f"gsx judge: '{word}' is neither NAME=PATH, nor KEY=VALUE, nor a folder: check its name")
    return folder


def existing_path(name: str, word: str) -> Path:
    """Return the path of a method; raise if it does not exist: with {scene} it is checked for each scene."""
    path = expand_home(word)
    if not name or not word:
        raise ConfigError(f"gsx judge: '{name}={word}' names no method and path: write NAME=PATH")
    if "{" in word and "{scene}" not in word and not path.exists():
        raise InputError(f"gsx judge: '{name}={word}' does not exist, and in braces only {{scene}} has a meaning")
    if "{scene}" not in word and not path.exists():
        raise InputError(
            f"gsx judge: '{name}={word}': there is no such file or folder, and gsx judge has no setting '{name}'"
        )
    return path


KEYS = ("scene", "dataset", "data_root", "protocol", "eval", "metrics", "seed")
"""Settings that decide photos, cameras and figures."""


def parse_prepare(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx prepare [FOLDER] --to OUT [KEY=VALUE ...] [--with-test] [--with-truth]`."""
    description = (
        "Write a scene for other programs: the training photos as gsx trains on them, a COLMAP model, transforms.json, "
        "and cameras of the test views at each zoom. For example: gsx prepare FOLDER --to OUT scene.downscale=4 "
        "'eval.zoom=[1,2,4]', or gsx prepare --to OUT scene=demo."
    )
    parser = Parser("prepare", description, "[FOLDER] --to OUT [KEY=VALUE ...] [options]")
    parser.settings = True
    words = "folder of a scene, then settings of scene and evaluation, as for training"
    parser.add_argument("words", nargs="*", default=[], metavar="FOLDER|KEY=VALUE", help=words)
    parser.add_argument("--to", type=Path, required=True, metavar="OUT", help="folder to write; it must not exist")
    test = "put test photos into images/ as well, for programs that split by themselves"
    parser.add_argument("--with-test", action="store_true", help=test)
    truth = "also write test photos at each zoom to truth/xK/"
    parser.add_argument("--with-truth", action="store_true", help=truth)
    options = parser.parse_intermixed_args(arguments)
    options.folder = folder_among(options.words)
    options.to = expand_home(options.to)
    return options


def folder_among(words: list[str]) -> Path | None:
    """Return the folder if it is the first word; raise for words that belong to no scene."""
    folder = expand_home(words[0]) if words and not is_override(words[0]) else None
    overrides = words if folder is None else words[1:]
    if folder is not None and not folder.exists():
        raise InputError(f"gsx prepare: '{folder}' does not exist: give the folder of a scene, or scene=demo")
    for word in overrides:
        refuse_other(word, folder)
    if folder is None and not any(word.startswith(("scene=", "dataset=")) for word in overrides):
        raise ConfigError("gsx prepare needs a scene: give FOLDER, or scene=demo, or scene=colmap scene.path=FOLDER")
    return folder


def refuse_other(word: str, folder: Path | None) -> None:
    """Raise ConfigError for a word that changes nothing in a prepared folder, or names another scene."""
    if not is_override(word):
        raise ConfigError(f"gsx prepare: '{word}' is no setting (KEY=VALUE): the folder comes first")
    if key_of(word) not in KEYS:
        raise ConfigError(f"gsx prepare does not take '{word}': it writes a scene and trains nothing, leave it out")
    if folder is not None and word.startswith(("scene=", "scene.path=", "dataset=")):
        raise ConfigError(f"gsx prepare {folder}: '{word}' does not go with the folder of a scene: leave it out")
