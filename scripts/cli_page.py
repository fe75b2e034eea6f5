"""Write the page reference/cli.md of the site from the help of gsx and of each verb."""

import contextlib
import io
import os
from collections.abc import Sequence

from gsx.cli.dispatch import VERBS, main

BEGINNING = """# Command line

Look up every verb of `gsx` and its options. A page of the site, made from the program's help by `scripts/cli_page.py`.

    gsx --help
    gsx export --help

Settings are words of the form `KEY=VALUE`: [configuration](configuration.md) lists all keys, `gsx explain KEY`
describes one. The exit code is 0 after success, 2 after an error with a remedy, 130 after Ctrl-C, and 141 where the
reader of a pipe stopped.
"""


def cli_page() -> str:
    """Return the page in Markdown."""
    parts = [BEGINNING, "## gsx\n", help_of(["--help"])]
    for verb in VERBS:
        parts += [f"## gsx {verb}\n", help_of([verb, "--help"])]
    return "\n".join(parts)


def help_of(words: Sequence[str]) -> str:
    """Return what gsx prints for these words, as a block of text of 100 columns."""
    before, out = os.environ.get("COLUMNS"), io.StringIO()
    os.environ["COLUMNS"] = "100"
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            main(words)
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before
    return f"```text\n{out.getvalue().rstrip()}\n```\n"
