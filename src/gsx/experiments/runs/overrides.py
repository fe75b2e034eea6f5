"""Words of the command line, `KEY=VALUE` by Hydra's grammar: written, read, and refused with clearer errors."""

import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from shutil import which
from typing import Any, NoReturn

from gsx.core.errors import ConfigError, first_line
from gsx.core.files import expand_home

LAUNCHERS = {
    "processes": ("hydra-joblib-launcher", "sweep"),
    "joblib": ("hydra-joblib-launcher", "sweep"),
    "slurm": ("hydra-submitit-launcher", "slurm"),
    "submitit_slurm": ("hydra-submitit-launcher", "slurm"),
    "submitit_local": ("hydra-submitit-launcher", "slurm"),
}
"""Package and extra of each launcher that Hydra does not bring."""
SLURM = ("slurm", "submitit_slurm")
"""Launchers that submit jobs by Slurm's own programs."""
SPECIAL = re.compile(r"[^\w./+~ -]", re.ASCII)
"""A character of a value that is special in Hydra's grammar."""


def is_override(word: str) -> bool:
    """Return True for a flag or a change of the configuration, False for a path (`./a=b`, or an existing `a=b`)."""
    if word.startswith((".", "/", "~/")):
        return False
    return word.startswith(("-", "+", "~")) or ("=" in word and not os.path.exists(word))


def key_of(word: str) -> str:
    """Return the first part of an override's key."""
    return re.split(r"[=./@]", word.lstrip("+~"), maxsplit=1)[0]


def quoted(text: str) -> str:
    """Return a text, whatever its characters, as the value of an override.

    A backslash stands for itself, unless it is before a quote or an interpolation, where each must be doubled (Hydra's
    override grammar, OmegaConf's escapes).
    """
    escaped = re.sub(r"(\\*)('|\$\{)", lambda found: f"{found[1] * 2}\\{found[2]}", text)
    return "'" + re.sub(r"(\\+)\Z", r"\1\1", escaped) + "'"


def word_of(key: str, text: str) -> str:
    """Return an override with a text as its value, quoted if Hydra would read it as something else."""
    plain = re.fullmatch(r"[A-Za-z/][\w./:-]*( [\w./:-]+)*", text, re.ASCII)
    bare = plain and text.lower() not in ("null", "true", "false", "nan", "inf")
    return f"{key}={text if bare else quoted(text)}"


def words_of(values: Mapping[str, Any], below: str = "") -> list[str]:
    """Return values by name, nested ones too, as words of the command line."""
    words = []
    for name, value in values.items():
        if isinstance(value, Mapping):
            words += words_of(value, f"{below}{name}.")
        else:
            words.append(f"{below}{name}={text_of(plain(name, value))}")
    return words


def text_of(value: Any) -> str:
    """Return a plain value in the syntax of the command line."""
    if isinstance(value, list):
        return f"[{','.join(map(text_of, value))}]"
    return quoted(value) if isinstance(value, str) else json.dumps(value)


def plain(name: str, value: Any) -> Any:
    """Return a value of JSON: convert numbers of numpy and torch, and paths; raise ConfigError for other types."""
    if isinstance(value, list | tuple):
        return [plain(name, inner) for inner in value]
    if isinstance(value, Path):
        return str(value)
    value = value.tolist() if hasattr(value, "tolist") else value
    if not (value is None or isinstance(value, bool | int | float | str | list)):
        raise ConfigError(f"{name} is a {type(value).__name__}; give a number, a text, a list of them, or null")
    return value


def with_quoted_paths(overrides: Sequence[str]) -> list[str]:
    """Return overrides with paths such as `~/a`, or existing ones such as `a=b` or `a (1)`, quoted.

    Hydra does not read these; shells leave `~` within a word to programs.
    """

    def special(value: str) -> bool:
        return os.path.exists(expand_home(value)) if SPECIAL.search(value) else value.startswith("~")

    pairs = [word.partition("=") for word in overrides]
    return [word_of(key, value) if special(value) else f"{key}{equals}{value}" for key, equals, value in pairs]


def parse_overrides(overrides: Sequence[str]) -> list[Any]:
    """Return Hydra's Override objects; raise ConfigError if one cannot be read."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        remedy = "put special characters in quotes within those of the shell, 'KEY=\"VALUE\"'"
        raise ConfigError(f"override cannot be read: {first_line(error)}: {remedy}") from error


def refuse_sweep(override: Any, group: bool) -> NoReturn:
    """Raise ConfigError for several values of one key; `group`: of choices of a group."""
    key, _, values = str(override.input_line).partition("=")
    others = f"; '{key}=\"{values}\"' is one text, '{key}=[{values}]' a list"
    remedy = others if override.is_choice_sweep() and not group and not re.search(r"[()'\"]", values) else ""
    raise ConfigError(f"{key}={values} has several values: gsx -m trains once for each{remedy}")


def refuse_absent_launcher(name: str) -> None:
    """Raise ConfigError if a launcher's package is not installed."""
    package, extra = LAUNCHERS.get(name, ("", ""))
    try:
        if package:
            distribution(package)
    except PackageNotFoundError as error:
        raise ConfigError(f"hydra/launcher={name} needs the package {package}: pip install 'gsx[{extra}]'") from error


def refuse_absent_slurm(overrides: Sequence[str]) -> None:
    """Raise ConfigError if jobs are for Slurm and this machine has no program of it."""
    chosen = [str(one.value()) for one in parse_overrides(overrides) if one.key_or_group == "hydra/launcher"]
    if chosen and chosen[-1] in SLURM and which("srun") is None:
        raise ConfigError(
            f"hydra/launcher={chosen[-1]}: this machine has no Slurm (srun is not on the PATH). Submit from a machine "
            "of the cluster, or run here with hydra/launcher=processes"
        )
