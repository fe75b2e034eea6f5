"""Errors a user can act on: one sentence that names value, place and remedy. The command line exits with 2 on them."""

import difflib
import shlex
from collections.abc import Iterable


class GsxError(Exception):
    """Base of every error that is the user's to mend; its message is shown without a traceback."""


class ConfigError(GsxError):
    """A key, value or group of the configuration is wrong."""


class InputError(GsxError):
    """A file or folder given to gsx cannot be used."""


class CompilerError(GsxError):
    """What was compiled on this machine before cannot be now: a full disk, or a compiler that was killed."""


class TooManyPairs(InputError):
    """A picture needs more splat-tile pairs than `rasterizer.max_pairs`; smaller pieces of it may not."""


class CheckpointError(GsxError):
    """A checkpoint is missing, truncated or altered."""


class TrainingError(GsxError):
    """Training cannot go on, for example after three non-finite steps in a row."""


class Stopped(GsxError):
    """A step was given up because its run was asked to stop; the run stands where the step began."""


class LostModel(TrainingError):
    """What is left of a model is another one, which may not become a checkpoint."""


class Disagreement(LostModel):
    """The processes of one run hold different models."""


def nearest(word: str, options: Iterable[str]) -> str:
    """` Did you mean 'x'?` for the closest option, or an empty string when nothing is close."""
    close = difflib.get_close_matches(word, list(options), n=1, cutoff=0.5)
    return f" Did you mean '{close[0]}'?" if close else ""


def command(*words: object) -> str:
    """`gsx` with these words, as a shell takes it: for what is to be copied."""
    return shlex.join(["gsx", *map(str, words)])


def first_line(error: BaseException) -> str:
    """First line of an error's message."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
