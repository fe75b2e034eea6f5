"""Parser of `gsx prepare`."""

import argparse
from pathlib import Path

from gsx.cli.arguments import Parser
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import expand_home
from gsx.experiments.runs.overrides import is_override, key_of

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
