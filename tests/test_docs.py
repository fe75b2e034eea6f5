"""Documentation that can be wrong is tested: hooks, files named, commands of the README."""

import inspect
import re
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


def test_commands_of_the_readme_are_accepted() -> None:
    from gsx.builtin import plugins
    from gsx.cli.dispatch import VERBS
    from gsx.experiments.runs.compose import compose

    text = (ROOT / "README.md").read_text()
    blocks = re.findall(r"```sh\n(.*?)```", text, re.S)
    commands = [line.split("#")[0].strip() for block in blocks for line in block.splitlines() if line.startswith("gsx")]
    assert commands
    for command in commands:
        words = [word.strip("'") for word in command.split()[1:]]
        if words and words[0] in (*VERBS, "FOLDER"):  # what stands for a path is told when it is given
            continue
        if not any(word.startswith("-") for word in words):
            compose(words, plugins())
