"""gsx prepare."""

import sys
from argparse import Namespace

from gsx.builtin import plugins
from gsx.cli.train import scene_words
from gsx.experiments.prepare.prepare import prepare


def prepare_scene(options: Namespace) -> int:
    """Write a scene for other programs and print its folder."""
    loaded = plugins()
    words = options.words
    if options.folder is not None:
        words = [*scene_words(options.folder, words[1:], loaded), *words[1:]]
    sys.stdout.write(f"{prepare(words, options.to, loaded, options.with_test, options.with_truth)}\n")
    return 0
