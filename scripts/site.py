"""Hooks of mkdocs: the index is README.md, the page of the configuration is made from conf/."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from gsx.builtin import plugins
from gsx.experiments.runs.explain import reference

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie elsewhere or nowhere."""
    files.append(File.generated(config, "index.md", content=index()))
    files.append(File.generated(config, "configuration.md", content="\n".join(reference(plugins()))))
    return files


def index() -> str:
    """README.md with its links as seen from docs/."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.sub(r"\]\((?!https?:|#)(?:docs/)?", "](", re.sub(r"\]\((?!docs/|https?:|#)", "](../", text))


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Files outside of docs/ are named, since the site does not hold them: [text](../file) becomes text (`file`)."""
    return re.sub(r"!?\[([^\]]*)\]\(\.\./([^)]+)\)", outside, markdown)


def outside(link: re.Match[str]) -> str:
    """A link to a file of the repository, in words."""
    text, target = link.groups()
    if not (ROOT / target.partition("#")[0]).exists():
        raise ValueError(f"'{target}' is no file of the repository")
    return f"`{target}`" if text.strip("`") in target else f"{text} (`{target}`)"
