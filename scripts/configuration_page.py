"""Write the page reference/configuration.md of the site from the files of conf/ and their comments."""

import re
from collections.abc import Sequence

from gsx.core.errors import ConfigError
from gsx.core.plugins import Plugins
from gsx.experiments.runs.compose import Compositions, known_groups, listed
from gsx.experiments.runs.explain import comment_on, head_of, kind_of, parsed, value_at, written
from gsx.experiments.runs.typed import dotted

SEVERAL = {"augmenter": "augmenter", "tracker": "tracker", "module": "training"}
"""Keys of the options of groups of which several are chosen."""
LISTED = ("scene", "backbone", *SEVERAL, "regenerator/upscale", "regenerator/restore", "rasterizer")
"""Groups whose options have keys of their own; presets and variants set those of others."""


def reference(plugins: Plugins) -> list[str]:
    """Return a page over all keys in Markdown: of a run, then of each option of each group."""
    lines = [
        "# Configuration",
        "",
        "Every key with its value, its type and range, and its comment. On the command line:",
        "`gsx KEY=VALUE`, `gsx GROUP=OPTION`, `gsx explain KEY`.",
    ]
    with Compositions(plugins) as compositions:
        groups = [group for group in known_groups() if listed(group)]
        lines += ["", "## Of a run", "", *keys_table("", [], compositions, groups)]
        for group in filter(LISTED.__contains__, groups):
            for option in listed(group):
                word = f"{group}=[{option}]" if group in SEVERAL else f"{group}={option}"
                lines += ["", f"## {word}", "", head_of(compositions.file(f"{group}/{option}")) + ".", ""]
                prefix = f"{SEVERAL[group]}.{option}" if group in SEVERAL else group.replace("/", ".")
                lines += keys_table(prefix, [word], compositions, groups)
    return [*lines, ""]


def keys_table(prefix: str, words: Sequence[str], compositions: Compositions, groups: Sequence[str]) -> list[str]:
    """Return a row for each key below a prefix; without one, for those of a run that are in no group."""
    values = compositions.values(words)
    try:
        settings = compositions.settings(words)
    except ConfigError:  # an option that needs more, for example a model
        settings = None
    files = parsed(compositions.sources(words))
    of_groups = tuple(f"{group.partition('/')[0]}." for group in groups)
    rows = ["| key | value | type | |", "|---|---|---|---|"]
    for key in dotted(values):
        node = value_at(key, values)
        belongs = key.startswith(f"{prefix}.") if prefix else not key.startswith(of_groups)
        if belongs and not isinstance(node, dict):
            kind = kind_of(key, settings) if settings else ""
            cells = (f"`{key}`", f"`{written(node)}`", kind, comment_on(key, files))
            rows.append("| " + " | ".join(map(in_cell, cells)) + " |")
    return rows


def in_cell(text: str) -> str:
    """Return a text for a cell of a table, with its marks escaped."""
    return re.sub(r"([|*])", r"\\\1", text) if "`" in text else re.sub(r"([|*_<>])", r"\\\1", text)
