"""Hooks of mkdocs: the index is README.md; pages of reference and of results are generated."""

import os
import re
from functools import partial
from pathlib import Path
from typing import Any

from api_page import api_page
from cli_page import cli_page
from configuration_page import reference
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from gsx.builtin import plugins

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
"""Tables and plots that benchmarks write; the site has them in its folder `benchmarks`."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie elsewhere or nowhere."""
    pages = {
        "index.md": index(),
        "reference/configuration.md": "\n".join(reference(plugins())),
        "reference/cli.md": cli_page(),
        "reference/api.md": api_page(),
    }
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    for file in sorted(RESULTS.rglob("*")):
        if file.suffix in (".md", ".svg"):
            files.append(File.generated(config, result_page(file), content=file.read_text(encoding="utf-8")))
    return files


def result_page(file: Path) -> str:
    """Return where the site has a file of benchmarks/results."""
    return f"benchmarks/{file.relative_to(RESULTS).as_posix()}"


def index() -> str:
    """Return README.md with its links as they are from docs/."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.sub(r"\]\((?!https?:|#)(?:docs/)?", "](", re.sub(r"\]\((?!docs/|https?:|#)", "](../", text))


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Rewrite links that lead out of docs/: to pages of results, or to the name of the file in backticks."""
    folder = (ROOT / "docs" / page.file.src_uri).parent
    return re.sub(r"!?\[([^\]]*)\]\(((?:\.\./)+[^)]+)\)", partial(rewritten, folder), markdown)


def rewritten(folder: Path, link: re.Match[str]) -> str:
    """Return a link as the site needs it: pages of docs/ as they are, results by their page, other files in words.

    Raises:
        ValueError: there is no such file.
    """
    text, target = link.groups()
    name, mark, anchor = target.partition("#")
    file = Path(os.path.normpath(folder / name))
    if file.is_relative_to(ROOT / "docs"):
        return link[0]
    if not file.exists():
        raise ValueError(f"'{target}' is no file of the repository")
    if file.is_relative_to(RESULTS) and file.suffix in (".md", ".svg"):
        page = os.path.relpath(ROOT / "docs" / result_page(file), folder)
        return link[0].replace(f"({target})", f"({page}{mark}{anchor})")
    path = str(file.relative_to(ROOT))
    return f"`{path}`" if text.strip("`") in path else f"{text} (`{path}`)"
