"""Checks what pages say: links, anchors, files they name, hooks, commands; and that no page is left out."""

import inspect
import os
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from pages import DOCS, LINK, NAMES, PAGES, RESULTS, ROOT, anchors

from gsx.core.plugins import Hooks

SKIPPED = {".venv", ".git", "build", "dist", "outputs", "multirun", "node_modules"}
SOURCES = ("src", "conf", "benchmarks", "tests", "scripts", "examples")


GENERATED = {DOCS / "reference" / name for name in ("cli.md", "configuration.md", "api.md")}
"""Pages that scripts/site.py makes."""


def files_below(folder: Path, *suffixes: str) -> Iterator[Path]:
    """Yield files with these suffixes, without those of tools and runs."""
    for path, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name not in SKIPPED and not name.startswith(".")]
        yield from (Path(path) / name for name in names if name.endswith(suffixes))


def test_no_page_is_left_out() -> None:
    """A page that no test reads could say anything."""
    known = {*PAGES, *RESULTS.rglob("*.md")}
    assert not {str(page.relative_to(ROOT)) for page in files_below(ROOT, ".md") if page not in known}


def test_every_page_is_in_the_navigation() -> None:
    named = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2]))
    assert {str(page.relative_to(DOCS)) for page in PAGES if page.is_relative_to(DOCS)} <= named


def test_pages_that_code_names_exist() -> None:
    """Docstrings, messages, settings and tests name pages below docs, some with an anchor."""
    missing, references = [], 0
    for file in [
        *(f for folder in SOURCES for f in files_below(ROOT / folder, ".py", ".yaml", ".sh")),
        ROOT / "Makefile",
    ]:
        for name, anchor in re.findall(r"\b(docs/[\w/-]+\.md)(?:#([\w-]+))?", file.read_text(errors="ignore")):
            references += 1
            page = ROOT / name
            if not page.is_file() or (anchor and anchor not in anchors(page)):
                missing.append(f"{file.relative_to(ROOT)}: {name}{'#' + anchor if anchor else ''}")
    assert not [line for line in missing if "viewer_page.py" not in line]  # a page of the viewer's own project
    assert references > 50


def test_every_hook_is_documented_with_its_arguments() -> None:
    text = (ROOT / "docs" / "how-to" / "write-a-plugin.md").read_text()
    for name, hook in inspect.getmembers(Hooks, inspect.isfunction):
        arguments = ", ".join(list(inspect.signature(hook).parameters)[1:])
        assert f"`{name}({arguments})`" in text, name


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    """Pages that are generated for the site alone count as there."""
    for target, anchor in LINK.findall(page.read_text()):
        file = (page.parent / target).resolve() if target else page
        if file in GENERATED:
            continue
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), f"{target}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_source_files_named_in_backticks_exist(page: Path) -> None:
    for name in re.findall(r"`((?:src|conf|tests|examples|docs)/[\w./-]+)`", page.read_text()):
        assert (ROOT / name).exists(), name


WITH_COMMANDS = [page for page in PAGES if "```sh" in page.read_text()]


@cache
def composed(words: tuple[str, ...]) -> None:
    """Compose a command that several pages may have, once."""
    from gsx.builtin import plugins
    from gsx.experiments.runs.compose import compose

    compose(words, plugins())


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```sh" in page.read_text()], ids=lambda page: str(page.relative_to(ROOT))
)
def test_commands_of_pages_are_accepted(page: Path) -> None:
    from gsx.cli.dispatch import VERBS

    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.S)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    commands = [line.split("#")[0].strip() for line in lines if line.startswith("gsx")]
    for command in commands:
        words = shlex.split(command)[1:]
        if words and words[0] in (*VERBS, "FOLDER", "VIDEO"):  # placeholders of paths
            continue
        if not any(word.startswith("-") for word in words):
            composed(tuple(word for word in words if word != "init=FILE"))


def test_the_commands_of_the_readme_are_found() -> None:
    assert (ROOT / "README.md").read_text().count("\ngsx ") >= 6


def test_keys_named_for_those_who_come_from_elsewhere_exist() -> None:
    """In docs/how-to/migrate.md: `a.b.c` is a key of some composition, words after it are its neighbours."""
    from gsx.builtin import plugins
    from gsx.experiments.runs.compose import Compositions, listed

    text = (ROOT / "docs" / "how-to" / "migrate.md").read_text()
    with Compositions(plugins()) as compositions:
        words = [
            ["scene=blender"],
            *([f"backbone={name}", "scene=colmap"] for name in listed("backbone")),
        ]
        known = {key for one in words for key in compositions.keys(one)}
    rows = [row.split("|")[-2] for row in text.splitlines() if row.startswith(("| `", "| -"))]
    named = 0
    for row in rows:
        prefix = ""
        for word in re.findall(r"`([\w.]+)(?:=[^`]*)?`", row):
            if word.startswith(("backbone.", "training.", "scene.", "eval.", "rasterizer.")):
                prefix, key = word.rpartition(".")[0], word
            elif prefix and "." not in word and f"`{word}=" not in row:
                key = f"{prefix}.{word}"
            else:
                continue
            assert key in known, f"{key} ({row.strip()})"
            named += 1
    assert named > 30
