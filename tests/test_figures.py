"""Figures in README and docs: each is in a committed file of results, and none looks measured without saying where."""

import ast
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from pages import NAMES, PAGES, ROOT

NUMBER = r"(?<![\w.])(?:(?<!\d)[-+])?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?(?!\w|\.\d)"
UNIT = r"dB|ms|s|seconds?|min|minutes?|hours?|MB|GB|GB/s|renders/s|steps/s|it/s|%"
FACTOR = r"times\s+(?:as\s+(?:fast|long|slow)|faster|slower)"
MEASURED = re.compile(rf"{NUMBER}\s?(?:{UNIT}|{FACTOR})(?!\w)|±\s?\d|(?<![\w.,])\d\d\.\d\d(?![\d.])")
"""A number with a unit, a spread, a PSNR."""
COLUMN = re.compile(r"PSNR|SSIM|\bdB\b|\bM?B\b|(?<!')\bm?s\b|seconds|memory|renders|\bx[1248]\b|\bcost\b|\btimes?\b")
"""In the heading of a column of measurements."""
SOURCE = re.compile(r"<!-- figures: (\S+) ([^>]*\S) -->\n")
GENERATED = re.compile(r"<!-- \w+: written by (\S+) -->\n")

NO_MEASUREMENTS: list[tuple[str, str, str]] = [
    # page, words, why they are no measurement
    ("docs/reference/augmenters.md", "from 55 % of the run on", "conf/augmenter/upscale_paper.yaml: the paper's start"),
    ("docs/reference/augmenters.md", "from 50 % of the run on", "conf/augmenter/bootstrap.yaml: the paper's start"),
    (
        "docs/reference/augmenters.md",
        "from 20 % on",
        "conf/augmenter/bootstrap_original.yaml: the start of Bootstrap-GS",
    ),
    ("docs/reference/augmenters.md", "reconstructs to some 23 dB", "published for kl-f8: 23.4 +- 3.8 dB on ImageNet"),
    ("docs/how-to/sweeps-and-clusters.md", "30 seconds later", "torchrun's own patience"),
    ("docs/how-to/compare-programs.md", "95 % interval", "the level of an interval"),
    ("docs/benchmarks/extremes.md", "at most 1 % of", "a bound of tests/extremes"),
    ("docs/reference/regenerators.md", "2.3 GB | 3 GB", "estimates from numbers of parameters, as the page says"),
    ("docs/reference/regenerators.md", "3.5 GB | 5 GB", "the same"),
    ("docs/reference/regenerators.md", "5.8 GB | 8 GB", "the same"),
    ("docs/reference/regenerators.md", "6.9 GB | 12 to 16 GB", "the same"),
    ("docs/reference/regenerators.md", "6.9 GB | 9 GB", "the same"),
    ("docs/reference/regenerators.md", "files (a) | memory (a)", "the same"),
    ("docs/reference/regenerators.md", "further than 25 dB from", "an example of an option"),
    ("docs/how-to/capture-photos.md", "60 to 80 %", "advice for structure from motion, as in src/gsx/scenes/photos.py"),
    ("docs/reference/metrics.md", "2 % of the side", "src/gsx/experiments/evaluation/detail.py: BORDER_SHARE"),
    ("docs/reference/metrics.md", "by 1 % or more", "src/gsx/experiments/evaluation/warp.py: the limit of the depth"),
    ("docs/reference/regenerators.md", "0.8 MB each", "sizes of the packages' files"),
    ("docs/reference/regenerators.md", "33 MB | BSD", "the same"),
    ("docs/how-to/install.md", "270 MB in all", "the same"),
    ("docs/how-to/install.md", "66 MB | [perceptual", "the same"),
    ("docs/how-to/reproduce-tables.md", "28.48 dB against 28.39 dB", "the paper's: conf/published"),
    ("docs/how-to/reproduce-tables.md", "weights of some 10 GB", "the sum of files in docs/reference/regenerators.md"),
]
"""Constants of methods, limits in code, sizes of other people's files."""


@dataclass(frozen=True)
class Block:
    """A paragraph, list or table, without code and comments."""

    line: int
    text: str
    file: str
    """Of the results that it is from; empty if it does not say so."""
    sections: tuple[str, ...]

    @property
    def is_table(self) -> bool:
        """It has a heading and a rule."""
        return bool(re.match(r".*\n\|[-:| ]+\n", self.text))


def blocks(page: str) -> Iterator[Block]:
    """What stands between blank lines, outside of code and of tables that a command writes."""
    page = re.sub(r"^```.*?^```$", lambda code: "\n" * code[0].count("\n"), page, flags=re.M | re.S)
    for found in re.finditer(r"(?:^.*\S.*\n?)+", page, flags=re.M):
        written, source = GENERATED.match(found[0]), SOURCE.match(found[0])
        if written:
            assert (ROOT / written[1]).is_file(), written[1]
            continue
        file, names = (source[1], tuple(source[2].split())) if source else ("", ())
        text = found[0][source.end() if source else 0 :]
        yield Block(page[: found.start()].count("\n") + 1, prose(text), file, names)


def prose(text: str) -> str:
    """Without indented code, code in backticks and targets of links."""
    text = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("    "))
    return re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "``", text))


def looks_measured(block: Block) -> str:
    """What in a block is no mere constant; empty if nothing is."""
    found = MEASURED.search(block.text)
    if found:
        return found[0]
    column = COLUMN.search(block.text.splitlines()[0]) if block.is_table else None
    cells = "".join(block.text.splitlines()[2:])
    return f"column '{column[0]}'" if column and re.search(NUMBER, cells) else ""


def pieces(block: Block) -> list[str]:
    """What must be in one place: a line of a table, without its rule; or the whole text."""
    lines = block.text.splitlines()
    return [lines[0], *lines[2:]] if block.is_table else [block.text]


def places(name: str, section: dict[str, Any]) -> list[str]:
    """Texts that each hold what may stand in one line: a row of the section, with what is said of them all."""
    about = f"{name.replace('_', ' ')} {json.dumps({key: value for key, value in section.items() if key != 'rows'})}"
    return [f"{json.dumps(row, ensure_ascii=False)} {about}" for row in section["rows"]]


def holds(place: str, piece: str) -> bool:
    """Whether every number of the piece, and every difference with its spread, is in the place."""
    spreads = re.findall(rf"{NUMBER} ± {NUMBER}", piece)
    there = values(place)
    return all(stands_in(number, there) for number in re.findall(NUMBER, piece)) and all(s in place for s in spreads)


def values(text: str) -> list[float]:
    """The numbers of a text."""
    return [float(number.replace(",", "")) for number in re.findall(NUMBER, text)]


def stands_in(number: str, there: list[float]) -> bool:
    """Whether one of the values is this number, rounded to its digits."""
    half = 0.5 * 10.0 ** -len(number.partition(".")[2])
    return any(abs(value - float(number.replace(",", ""))) <= half * (1 + 1e-9) for value in there)


def wrong_figures(block: Block, sections: dict[str, Any]) -> list[str]:
    """Pieces with figures that are not in the sections named."""
    rows = [place for name in block.sections for place in places(name, sections[name])]
    allowed = rows if block.is_table else [" ".join(rows)]
    return [piece for piece in pieces(block) if not any(holds(place, piece) for place in allowed)]


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_figures_are_in_the_results_they_name(page: Path) -> None:
    for block in blocks(page.read_text()):
        if block.file:
            sections = json.loads((ROOT / block.file).read_text())["sections"]
            assert not wrong_figures(block, sections), f"{page.name}:{block.line}, {block.file} {block.sections}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_what_looks_measured_names_its_results(page: Path) -> None:
    text = page.read_text()
    for name, words, _ in NO_MEASUREMENTS:
        if name == str(page.relative_to(ROOT)):
            assert words in text, f"'{words}' is no longer in {name}: take it off the list"
            text = text.replace(words, "")
    suspects = {block.line: looks_measured(block) for block in blocks(text) if not block.file}
    assert not {line: words for line, words in suspects.items() if words}


SECTIONS = {
    "fox_1000": {
        "title": "Pseudo details on fox",
        "rows": [
            {"added": "control", "x1": "29.19", "x4": "25.80", "primitives": 90650, "seconds": 111.6},
            {"added": "upscale", "x1": "29.33", "gain1": "+0.13 ± 0.07", "gain2": "-0.07 ± 0.02"},
        ],
        "notes": ["1000 iterations, some 40 s each"],
        "date": "2026-11-21 22:42",
    }
}
TABLE = "<!-- figures: r.json fox_1000 -->\n| 1,000 iterations | x1 | x4 |\n|---|--:|---|\n"
TEXT = "<!-- figures: r.json fox_1000 -->\n"


@pytest.mark.parametrize(
    "text",
    [
        TABLE + "| `gs3d iterations=7`, control | 29.19 | 25.8 |\n| with 90,650 splats | 112 s | |\n",
        TABLE + "| upscale | +0.13 ± 0.07 | |\n",
        TEXT + "It has 29.2 dB and\n[26](page_7.md) on 2026-11-21, at x4 -0.07 ± 0.02, of 3D-GS, torch 2.13.0.\n",
    ],
)
def test_figures_of_a_section_are_found(text: str) -> None:
    [block] = blocks(text)
    assert (block.file, block.sections) == ("r.json", ("fox_1000",))
    assert not wrong_figures(block, SECTIONS)


@pytest.mark.parametrize(
    "text",
    [
        TABLE + "| control | 29.20 | 25.80 |\n",  # another digit
        TABLE + "| control | 29.19 | 25.9 |\n",  # not as rounded
        TABLE + "| upscale | 29.33 | 25.80 |\n",  # of two rows
        TABLE + "| upscale | 0.13 ± 0.02 | |\n",  # of two differences
        TABLE + "| upscale | -0.13 | |\n",  # the other way
        TABLE.replace("1,000", "2,000") + "| control | 29.19 | |\n",
        TEXT + "In 41 s.\n",
        TEXT + "It has 90,651 splats.\n",
    ],
)
def test_figures_that_are_not_in_the_section_are_noticed(text: str) -> None:
    [block] = blocks(text)
    assert wrong_figures(block, SECTIONS)


@pytest.mark.parametrize(
    ("text", "measured"),
    [
        ("It takes 43 s on two cores.", True),
        ("It takes some 40\nseconds.", True),
        ("x4 has 28.27 (29.45)", True),
        ("gains of 0.7 ± 0.1", True),
        ("1.6 times as fast", True),
        ("28 renders/s", True),
        ("| a | x1 | x4 |\n|---|---|---|\n| b | 30 | 28 |\n", True),
        ("| a | training s |\n|---|---|\n| b | 398 |\n", True),
        ("```sh\nsleep 43 s\n```\n", False),
        ("    of 43 s\n", False),
        ("weights of 0.15, `lambda=28.27`, x2, 3D-GS, 648x420 px, 0.3 px², 1e-4, 30,000 steps", False),
        ("| the paper's | x1 |\n|---|---|\n| `a` | |\n", False),
        ("On 2026-11-21 by torch 2.13.0, [a page](a_28.27.md).", False),
        ("<!-- extremes: written by benchmarks/extremes.py -->\n| x1 |\n|---|\n| 28.27 |\n", False),
    ],
)
def test_what_looks_measured_is_told_from_constants(text: str, measured: bool) -> None:
    assert any(looks_measured(block) for block in blocks(text)) == measured


def test_bounds_of_the_precision_knobs_are_those_of_their_test() -> None:
    source = (ROOT / "tests/core/rasterizer/test_precision.py").read_text()
    bounds = ast.literal_eval(re.search(r"^BOUNDS = (\[.*?^\])", source, flags=re.M | re.S)[1])
    page = (ROOT / "docs" / "explanation" / "numerics.md").read_text()
    rows = re.findall(r"^\| `(\w+)=(\w+)`(.*)\| (.* / .*) \|$", page, flags=re.M)
    assert {(knob, value) for knob, value, _, _ in rows} == {("evaluation", "float32"), ("accumulation", "float32")}
    for *_, cell in rows:
        assert [float(number) for number in cell.split("/")] == list(bounds[0][3:])
