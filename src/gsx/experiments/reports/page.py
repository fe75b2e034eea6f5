"""Shared parts of the HTML pages: templates of this package, and numbers as words."""

import os
from functools import cache
from importlib.resources import files
from typing import Any
from urllib.parse import quote

import jinja2

from gsx.experiments.run_folder.shapes import is_number

NONE = "n/a"


def fixed(value: Any, digits: int = 2) -> str:
    """Formats a number with so many decimals, or n/a."""
    return f"{value:,.{digits}f}" if is_number(value) else NONE


def signed(value: Any, digits: int = 2) -> str:
    """Formats a difference with its sign, or n/a."""
    return f"{value:+.{digits}f}".replace("-", "\N{MINUS SIGN}") if is_number(value) else NONE


def counted(number: int, noun: str) -> str:
    """Returns a number with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def share(value: Any) -> str:
    """Formats a share of 1 in per cent, or n/a."""
    return f"{100 * value:.0f} %" if is_number(value) else NONE


def duration(seconds: Any) -> str:
    """Formats a time: 42 s, 5 min 05 s, 42 min, 3 h 20 min, or n/a."""
    if not is_number(seconds):
        return NONE
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    if whole < 600:
        return f"{whole // 60} min {whole % 60:02d} s"
    if whole < 3600:
        return f"{whole // 60} min"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def compact(value: float) -> str:
    """Formats a short number: 1200000 is 1.2M, 30000 is 30k."""
    for least, size, letter in ((1e9, 1e9, "G"), (1e6, 1e6, "M"), (1e4, 1e3, "k")):
        if abs(value) >= least:
            return f"{value / size:.3g}{letter}"
    return f"{value:.4g}"


def plain(value: Any) -> str:
    """Formats a value of the schedule."""
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def time_unit(seconds: float) -> tuple[str, int]:
    """Chooses a unit in which the time is a handy number; returns its name and its seconds."""
    return ("hours", 3600) if seconds > 7200 else ("minutes", 60) if seconds > 180 else ("seconds", 1)


def address(path: str) -> str:
    """Quotes a path as the address of a link, whatever its bytes."""
    return quote(os.fsencode(path))


@cache
def template(name: str) -> jinja2.Template:
    """Loads a template below `experiments`, which escapes what is not marked as safe."""
    source = files("gsx.experiments")
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda file: source.joinpath(file).read_text(encoding="utf-8")),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (address, fixed, signed, share, duration, compact, plain)
    environment.filters |= {function.__name__: function for function in filters}
    environment.tests["figure"] = is_number
    return environment.get_template(name)
