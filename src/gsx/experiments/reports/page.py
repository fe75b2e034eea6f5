"""What the HTML pages share: templates of this package, and numbers as words."""

import os
from functools import cache
from importlib.resources import files
from typing import Any
from urllib.parse import quote

import jinja2

from gsx.experiments.reports.charts import compact
from gsx.experiments.run_folder.shapes import is_number

NONE = "n/a"


def fixed(value: Any, digits: int = 2) -> str:
    """A number with so many decimals, or n/a."""
    return f"{value:,.{digits}f}" if is_number(value) else NONE


def signed(value: Any, digits: int = 2) -> str:
    """A difference with its sign, or n/a."""
    return f"{value:+.{digits}f}".replace("-", "\N{MINUS SIGN}") if is_number(value) else NONE


def duration(seconds: Any) -> str:
    """42 s, 5 min 05 s, 42 min, 3 h 20 min, or n/a."""
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


def time_unit(seconds: float) -> tuple[str, int]:
    """A unit in which the time is a handy number, and its seconds."""
    return ("hours", 3600) if seconds > 7200 else ("minutes", 60) if seconds > 180 else ("seconds", 1)


def address(path: str) -> str:
    """A path as the address of a link, whatever its bytes."""
    return quote(os.fsencode(path))


@cache
def template(name: str) -> jinja2.Template:
    """A template below `experiments`: what is not marked as safe is escaped, missing figures show as n/a."""
    source = files("gsx.experiments")
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda file: source.joinpath(file).read_text(encoding="utf-8")),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "address": address,
        "fixed": fixed,
        "signed": signed,
        "duration": duration,
        "compact": compact,
    }
    return environment.get_template(name)
