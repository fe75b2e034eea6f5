"""Commands for other programs: `gsx prepare` writes them a scene, `gsx judge` compares what they make of it."""

import sys
from argparse import Namespace

from gsx.builtin import plugins
from gsx.cli.program_arguments import SCENE
from gsx.cli.train import scene_words
from gsx.core.errors import ConfigError
from gsx.experiments.judge.comparison import compare_methods, subjects_of
from gsx.experiments.judge.methods import Entry
from gsx.experiments.judge.scene_figures import Choices
from gsx.experiments.prepare.prepare import prepare
from gsx.experiments.prepare.whole_folder import MANIFEST


def compare(options: Namespace) -> int:
    """Compare methods; print the table and the page."""
    loaded = plugins()
    prepared = [folder for folder in options.folders if (folder / MANIFEST).is_file()]
    others = [folder for folder in options.folders if folder not in prepared]
    chosen = [word for word in options.overrides if word.startswith(SCENE)]
    overrides = [word for word in options.overrides if word not in chosen]
    if len(others) > 1 or (others and chosen):
        raise ConfigError(f"gsx judge: {others[-1]} is a second scene: give one, or give folders of `gsx prepare`")
    if others:
        chosen = scene_words(others[0], options.overrides, loaded)
    subjects = subjects_of(prepared, chosen, overrides)
    entries = [Entry(name=name, path=path) for name, path in options.methods]
    choices = Choices(order=options.order, depth=options.depth, partial=options.partial)
    page, lines = compare_methods(
        entries, subjects, choices, options.protocols, options.against, options.to, loaded, options.line
    )
    sys.stdout.write("\n".join([*lines, "", f"{page}", ""]))
    return 0


def prepare_scene(options: Namespace) -> int:
    """Write a scene for other programs and print its folder."""
    loaded = plugins()
    words = options.words
    if options.folder is not None:
        words = [*scene_words(options.folder, words[1:], loaded), *words[1:]]
    sys.stdout.write(f"{prepare(words, options.to, loaded, options.with_test, options.with_truth)}\n")
    return 0
