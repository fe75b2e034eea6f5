"""Words of the command line, `KEY=VALUE` by Hydra's grammar: written, read, and refused where Hydra would say less."""

import os
import re
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, distribution
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
"""Package and extra of each launcher beside Hydra's own."""
SLURM = ("slurm", "submitit_slurm")
"""Launchers that submit jobs by Slurm's own programs."""
SPECIAL = re.compile(r"[^\w./+~ -]", re.ASCII)
"""A character of a value that means something to Hydra."""


def is_override(word: str) -> bool:
    """Returns whether a word is a flag or changes the configuration; a path (`./a=b`, or an existing `a=b`) is not."""
    if word.startswith((".", "/", "~/")):
        return False
    return word.startswith(("-", "+", "~")) or ("=" in word and not os.path.exists(word))


def key_of(word: str) -> str:
    """Returns the key of an override, without what is below it."""
    return word.lstrip("+~").partition("=")[0].split(".")[0].split("/")[0].split("@")[0]


def quoted(text: str) -> str:
    """Returns a text as the value of an override, whatever characters it has.

    A backslash stands for itself, unless it is before a quote or an interpolation, where each must be doubled (Hydra's
    override grammar, OmegaConf's escapes).
    """
    escaped = re.sub(r"(\\*)('|\$\{)", lambda found: f"{found[1] * 2}\\{found[2]}", text)
    return "'" + re.sub(r"(\\+)\Z", r"\1\1", escaped) + "'"


def word_of(key: str, text: str) -> str:
    """Returns an override with a text for its value, quoted unless it would be read as that text anyway."""
    plain = re.fullmatch(r"[A-Za-z/][\w./:-]*( [\w./:-]+)*", text, re.ASCII)
    bare = plain and text.lower() not in ("null", "true", "false", "nan", "inf")
    return f"{key}={text if bare else quoted(text)}"


def with_quoted_paths(overrides: Sequence[str]) -> list[str]:
    """Returns overrides in which a path that exists stands for itself, also one such as `a=b` or `a (1)`."""
    pairs = [word.partition("=") for word in overrides]
    return [
        word_of(key, value) if SPECIAL.search(value) and os.path.exists(expand_home(value)) else f"{key}{equals}{value}"
        for key, equals, value in pairs
    ]


def parse_overrides(overrides: Sequence[str]) -> list[Any]:
    """Returns Hydra's Override objects.

    Raises:
        ConfigError: one cannot be read.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        remedy = "odd characters want quotes within those for the shell, 'KEY=\"VALUE\"'"
        raise ConfigError(f"override cannot be read: {first_line(error)}: {remedy}") from error


def refuse_sweep(override: Any, group: bool) -> NoReturn:
    """Raises ConfigError for several values where there is to be one; `group`: choices of a group."""
    key, _, values = str(override.input_line).partition("=")
    others = f"; '{key}=\"{values}\"' is one text, '{key}=[{values}]' a list"
    remedy = others if override.is_choice_sweep() and not group and not re.search(r"[()'\"]", values) else ""
    raise ConfigError(f"{key}={values} is several values: gsx -m runs one after the other{remedy}")


def refuse_absent_launcher(name: str) -> None:
    """Raises ConfigError if a launcher's package is not installed."""
    package, extra = LAUNCHERS.get(name, ("", ""))
    try:
        if package:
            distribution(package)
    except PackageNotFoundError as error:
        raise ConfigError(f"hydra/launcher={name} needs the package {package}: pip install 'gsx[{extra}]'") from error


def refuse_absent_slurm(overrides: Sequence[str]) -> None:
    """Raises ConfigError if jobs go to Slurm and this machine has no program of it."""
    chosen = [str(one.value()) for one in parse_overrides(overrides) if one.key_or_group == "hydra/launcher"]
    if chosen and chosen[-1] in SLURM and which("srun") is None:
        raise ConfigError(
            f"hydra/launcher={chosen[-1]}: this machine has no Slurm, no srun is on the PATH. Submit from a machine of "
            "the cluster, or run here with hydra/launcher=processes"
        )
