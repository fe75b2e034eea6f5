"""Errors that a user can act on. The message names value, place and remedy; the command line exits with status 2."""

import difflib
import shlex
from collections.abc import Iterable


class GsxError(Exception):
    """Base class; the message is printed without a traceback."""


class ConfigError(GsxError):
    """Wrong key, value or group in the configuration."""


class InputError(GsxError):
    """Unusable file, folder or argument."""


class CompilerError(GsxError):
    """Failure of a compilation that worked before, as by a full disk or a killed compiler."""


class TooManyPairs(InputError):
    """More splat-tile pairs in a picture than `rasterizer.max_pairs`; smaller windows of it may work."""


class CheckpointError(GsxError):
    """Missing, truncated or altered checkpoint."""


class TrainingError(GsxError):
    """End of a training that cannot continue, as after three non-finite steps in a row."""


class Stopped(GsxError):
    """End of a step before it changed anything, because the run is stopping."""


class LostModel(TrainingError):
    """Loss of so many primitives that the model must not be saved."""


class Disagreement(LostModel):
    """Different models in the processes of one run."""


CLOSE = 0.65
"""Least similarity (difflib's ratio) of a suggestion: 'fog' for 'fig' has 0.67, 'scene' for 'nonsense' 0.62."""


def nearest(word: str, options: Iterable[str]) -> str:
    """Returns ` Did you mean 'x'?` with the closest option; empty: none is close."""
    close = difflib.get_close_matches(word, list(options), n=1, cutoff=CLOSE)
    return f" Did you mean '{close[0]}'?" if close else ""


def command(*words: object) -> str:
    """Returns the `gsx` command with these words, quoted for a shell."""
    return shlex.join(["gsx", *map(str, words)])


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's message."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
