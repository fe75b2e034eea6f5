"""Hooks of mkdocs: the index is README.md, the page of the configuration is made from conf/."""

import os
import re
from functools import partial
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from gsx.builtin import plugins
from gsx.experiments.runs.explain import reference

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie elsewhere or nowhere."""
    files.append(File.generated(config, "index.md", content=index()))
    files.append(File.generated(config, "reference/configuration.md", content="\n".join(reference(plugins()))))
    return files


def index() -> str:
    """README.md with its links as seen from docs/."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.sub(r"\]\((?!https?:|#)(?:docs/)?", "](", re.sub(r"\]\((?!docs/|https?:|#)", "](../", text))


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Name files outside of docs/, which the site does not hold: [text](../../file) becomes text (`file`)."""
    folder = (ROOT / "docs" / page.file.src_uri).parent
    return re.sub(r"!?\[([^\]]*)\]\(((?:\.\./)+[^)]+)\)", partial(in_words, folder), markdown)


def in_words(folder: Path, link: re.Match[str]) -> str:
    """Replace a link to a file of the repository outside of docs/ by words; keep others.

    Raises:
        ValueError: there is no such file.
    """
    text, target = link.groups()
    file = Path(os.path.normpath(folder / target.partition("#")[0]))
    if file.is_relative_to(ROOT / "docs"):
        return link[0]
    if not file.exists():
        raise ValueError(f"'{target}' is no file of the repository")
    name = str(file.relative_to(ROOT))
    return f"`{name}`" if text.strip("`") in name else f"{text} (`{name}`)"
