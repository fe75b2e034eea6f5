"""Parsers of verbs, whose mistakes are errors of ours."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gsx.core.errors import ConfigError, InputError
from gsx.core.ranges import Range

RESUME_FLAGS = ("--trust", "--changed")
"""Of gsx resume."""


PLACES = ("output", "folder", "reuse")
"""What says where a run is trained."""


def refuse_overrides(verb: str, overrides: Sequence[str], remedies: Mapping[str, str]) -> None:
    """Raises ConfigError for an override of what a verb's own flags say; `remedies` by key."""
    for word in overrides:
        if remedy := remedies.get(word.lstrip("+~").partition("=")[0]):
            raise ConfigError(f"{verb} does not take '{word}': {remedy}")


def run_arguments(verb: str, arguments: list[str], description: str, flags: str = "") -> tuple[Path, list[str]]:
    """Parses a run folder and the overrides after it; `flags`: others that the verb has, for its help."""
    parser = Parser(prog=f"gsx {verb}", usage=f"%(prog)s RUN [KEY=VALUE ...]{flags}", description=description)
    parser.add_argument("run", metavar="RUN", help="run folder")
    parser.add_overrides("values that take the place of the run's own")
    options = parser.parse_args(arguments)
    if "=" in options.run and not Path(options.run).exists():
        raise InputError(f"gsx {verb} needs a run folder: gsx {verb} RUN [KEY=VALUE ...]")
    return Path(options.run), options.overrides


class Parser(argparse.ArgumentParser):
    """Mistakes become errors of ours: one sentence, without the usage text."""

    def add_overrides(self, description: str) -> None:
        """Adds KEY=VALUE, as many as there are, as `overrides`."""
        # argparse calls required what has no default
        self.add_argument("overrides", nargs="*", default=[], metavar="KEY=VALUE", help=description)

    def error(self, message: str) -> NoReturn:
        """Raises ConfigError."""
        raise ConfigError(f"{self.prog}: {message}. See {self.prog} --help")


def positive(kind: type[int] | type[float]) -> Callable[[str], Any]:
    """Returns a reader of finite numbers above 0."""

    def read(word: str) -> int | float:
        try:
            number = kind(word)
        except ValueError:
            number = kind(0)
        if not 0 < number < float("inf"):
            what, example = ("whole number of 1 or more", "3") if kind is int else ("number above 0", "1e-3")
            raise argparse.ArgumentTypeError(f"'{word}' is no {what}: give one, for example {example}")
        return number

    return read


def whole(word: str) -> int:
    """Reads a whole number of 0 or more."""
    if not word.isdecimal():
        raise argparse.ArgumentTypeError(f"'{word}' is no whole number of 0 or more: give one, for example 4")
    return int(word)


def refuse_beyond(flag: str, value: float, bounds: Range) -> None:
    """Raises InputError for a number of the command line that is outside of its range."""
    if value not in bounds:
        raise InputError(f"{flag} is {value:,}: give a number {bounds}")


def new_folder(folder: Path) -> Path:
    """Makes a folder where it is missing, and returns it.

    Raises:
        InputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}): choose another with --to FOLDER") from error
    return folder
