"""Sentence lengths and Flesch Reading Ease of pages: `python tests/readability.py [PAGE ...]`.

Reading ease = 206.835 - 1.015 words per sentence - 84.6 syllables per word (Flesch 1948); syllables are groups of
vowels, less a silent e at the end (but not that of table).
"""

import re
import statistics
import sys
from pathlib import Path

from pages import PAGES, ROOT
from plain_words import prose

WORD = re.compile(r"[A-Za-z][A-Za-z'-]*")
SKIPPED = re.compile(r"^(#|\||!\[|\[\^|\s{4,}\S)")
"""Lines without sentences: headings, tables, pictures, indented code."""


def paragraphs(page: str) -> list[str]:
    """Return paragraphs and list items of a page, each on one line."""
    pieces, open_ = [], False
    for line in prose(page).splitlines():
        if not line.strip() or SKIPPED.match(line):
            open_ = False
        elif not open_ or re.match(r"\s*([-*>]|\d+\.) ", line):
            pieces.append(re.sub(r"^\s*([-*>]|\d+\.) ", "", line).strip())
            open_ = True
        else:
            pieces[-1] += " " + line.strip()
    return pieces


def sentences(page: str) -> list[str]:
    """Return the sentences of a page that have at least three words."""
    split = [part for piece in paragraphs(page) for part in re.split(r"(?<=[.!?])\s+(?=[\w\"'(`*\[])", piece)]
    return [part for part in split if len(WORD.findall(part)) >= 3]


def syllables(word: str) -> int:
    """Return the number of vowel groups, at least one; a final silent e does not count."""
    groups = len(re.findall(r"[aeiouy]+", word.lower()))
    return max(1, groups - bool(re.search(r"(?<![^aeiouy]l)(?<![aeiouy])e$", word.lower())))


def length(sentence: str) -> int:
    """Return the number of words."""
    return len(WORD.findall(sentence))


def reading_ease(page: str) -> float:
    """Return the Flesch Reading Ease of a page: 60 to 70 is plain English, below 30 very hard."""
    words = [word for sentence in sentences(page) for word in WORD.findall(sentence)]
    per_word = sum(map(syllables, words)) / max(len(words), 1)
    return 206.835 - 1.015 * len(words) / max(len(sentences(page)), 1) - 84.6 * per_word


def line_of(page: Path) -> str:
    """Return a page's row: sentences, median and longest length, reading ease."""
    text = page.read_text()
    lengths = [length(sentence) for sentence in sentences(text)] or [0]
    name = str(page.resolve().relative_to(ROOT)) if page.resolve().is_relative_to(ROOT) else str(page)
    return f"{name:45}{len(lengths):6}{statistics.median(lengths):8.1f}{max(lengths):6}{reading_ease(text):8.1f}"


if __name__ == "__main__":
    print(f"{'page':45}{'sent.':>6}{'median':>8}{'max':>6}{'ease':>8}")
    chosen = [Path(word) for word in sys.argv[1:]] or PAGES
    for page in chosen:
        print(line_of(page))
    lengths = [length(sentence) for page in chosen for sentence in sentences(page.read_text())]
    print(
        f"all: {len(lengths)} sentences, median {statistics.median(lengths)}, {sum(n > 40 for n in lengths)} above 40"
    )
