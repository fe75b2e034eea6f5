"""Pages, messages and docstrings stay plain: dialect words only become fewer (CONTRIBUTING.md)."""

import ast
import json

import pytest
from plain_words import COUNTS, DIALECT, FRAGMENT, counts, docstrings, messages, names, prose


def test_dialect_only_becomes_less() -> None:
    """Run `python tests/plain_words.py` for the lines, and with --write after lowering a count."""
    allowed = json.loads(COUNTS.read_text())
    assert {kind: count for kind, count in counts().items() if count > allowed[kind]} == {}


@pytest.mark.parametrize("text", ["is told", "Given that", "beside each figure", "Whoever looks", "judges it"])
def test_dialect_is_noticed(text: str) -> None:
    assert DIALECT.search(text)


@pytest.mark.parametrize("text", ["Whether it is", "What there is", "Of a view", "Those that are"])
def test_fragments_are_noticed(text: str) -> None:
    assert FRAGMENT.match(text)


def test_words_are_read_where_they_stand() -> None:
    tree = ast.parse('"""Page."""\nshown = 1\ndef f(told):\n    """What."""\n    raise ValueError("is given")\n')
    assert [node.value for node in docstrings(tree)] == ["Page.", "What."]
    assert [node.value for node in messages(tree)] == ["is given"]
    assert sorted(name for _, name in names(tree)) == ["f", "shown", "told"]
    assert prose("told\n```\nshown\n```\n`seen` [asked](given.md)") == "told\n\n\n\n`` [asked]"
