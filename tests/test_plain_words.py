"""Pages, messages and docstrings stay plain: dialect words only become fewer (CONTRIBUTING.md)."""

import ast
import json
import statistics

import pytest
from pages import PAGES
from plain_words import COUNTS, DIALECT, FRAGMENT, counts, docstrings, messages, names, prose
from readability import length, reading_ease, sentences, syllables


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


def test_sentences_of_pages_are_short() -> None:
    """The median has at most 18 words, the longest 40; tables, code and headings do not count."""
    lengths = {page.name: [length(sentence) for sentence in sentences(page.read_text())] for page in PAGES}
    assert {name: max(each) for name, each in lengths.items() if max(each, default=0) > 40} == {}
    assert statistics.median(number for each in lengths.values() for number in each) <= 18


def test_sentences_are_counted_as_a_reader_does() -> None:
    page = "# A heading\n\nOne two three. Four five,\nsix seven!\n\n* eight nine ten\n\n| a | table |\n"
    assert sentences(page) == ["One two three.", "Four five, six seven!", "eight nine ten"]
    assert [syllables(word) for word in ("scale", "table", "render", "the")] == [1, 2, 2, 1]
    assert reading_ease("One two three four.") == pytest.approx(206.835 - 1.015 * 4 - 84.6)
