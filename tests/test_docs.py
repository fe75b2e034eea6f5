"""Documentation that can be wrong is tested: hooks, files named, commands of the README."""

import inspect
import re
from functools import cache
from pathlib import Path

import pytest

from gsx.core.plugins import Hooks

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_every_hook_is_documented_with_its_arguments() -> None:
    text = (ROOT / "docs" / "writing-plugins.md").read_text()
    for name, hook in inspect.getmembers(Hooks, inspect.isfunction):
        arguments = ", ".join(list(inspect.signature(hook).parameters)[1:])
        assert f"`{name}({arguments})`" in text, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_source_files_named_in_backticks_exist(page: Path) -> None:
    for name in re.findall(r"`((?:src|conf|tests|examples|docs)/[\w./-]+)`", page.read_text()):
        assert (ROOT / name).exists(), name


@cache
def composed(words: tuple[str, ...]) -> None:
    """Compose a command that several pages may have, once."""
    from gsx.builtin import plugins
    from gsx.experiments.runs.compose import compose

    compose(words, plugins())


@pytest.mark.parametrize("page", [page for page in PAGES if "```sh" in page.read_text()], ids=lambda page: page.name)
def test_commands_of_pages_are_accepted(page: Path) -> None:
    from gsx.cli.dispatch import VERBS

    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.S)
    commands = [line.split("#")[0].strip() for block in blocks for line in block.splitlines() if line.startswith("gsx")]
    for command in commands:
        words = [word.strip("'") for word in command.split()[1:]]
        if words and words[0] in (*VERBS, "FOLDER"):  # what stands for a path is told when it is given
            continue
        if not any(word.startswith("-") for word in words):
            composed(tuple(word for word in words if word != "init=FILE"))


def test_the_commands_of_the_readme_are_found() -> None:
    assert (ROOT / "README.md").read_text().count("\ngsx ") > 10


def test_keys_named_for_those_who_come_from_elsewhere_exist() -> None:
    """In docs/coming-from.md: `a.b.c` is a key of some composition, words after it are its neighbours."""
    from gsx.builtin import plugins
    from gsx.experiments.runs.compose import Compositions, listed

    text = (ROOT / "docs" / "coming-from.md").read_text()
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
