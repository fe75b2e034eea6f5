"""The house stays one that a newcomer can walk through: sizes of its rooms, and no feature's name in the loop."""

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsx.builtin import plugins
from gsx.core.training.run import Run

SOURCE = Path(__file__).parents[1] / "src" / "gsx"
FILES = sorted(SOURCE.rglob("*.py"))
LOOP = ("core/training/trainer.py", "core/training/run.py", "experiments/run_folder/checkpoint.py",
        "experiments/evaluation/evaluator.py")  # fmt: skip


def lines_of(*files: Path) -> int:
    return sum(len(file.read_text().splitlines()) for file in files)


def classes() -> Iterator[tuple[str, int]]:
    """Name and lines of each class."""
    for file in FILES:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ClassDef):
                yield f"{file.relative_to(SOURCE)}: {node.name}", (node.end_lineno or 0) - node.lineno + 1


def functions() -> Iterator[tuple[str, int]]:
    """Name and lines of each function's body, without its docstring."""
    for file in FILES:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef):
                body = node.body[1:] if ast.get_docstring(node) and len(node.body) > 1 else node.body
                lines = (body[-1].end_lineno or 0) - body[0].lineno + 1
                yield f"{file.relative_to(SOURCE)}: {node.name}", lines


def test_core_is_read_in_an_evening() -> None:
    assert lines_of(*(file for file in FILES if file.is_relative_to(SOURCE / "core"))) <= 7000


@pytest.mark.parametrize(("file", "limit"), [("core/training/trainer.py", 200), ("core/training/run.py", 220)])
def test_the_loop_and_the_run_are_short(file: str, limit: int) -> None:
    assert lines_of(SOURCE / file) <= limit


def test_a_run_has_few_fields() -> None:
    assert len(dataclasses.fields(Run)) <= 14


def test_no_file_class_or_function_is_long() -> None:
    long = [str(file.relative_to(SOURCE)) for file in FILES if lines_of(file) > 400]
    long += [name for name, lines in classes() if lines > 200]
    long += [name for name, lines in functions() if lines > 50]
    assert not long


@pytest.mark.parametrize("file", LOOP)
def test_the_loop_names_no_feature(file: str) -> None:
    """Neither a registered component nor what it does."""
    kinds = ("module", "backbone", "augmenter", "regenerator", "tracker")
    registered = {name for kind, name in plugins().registry.components if kind in kinds} - {"callable"}
    stems = {"exposure", "poses", "blur", "distractor", "coarse", "supersampl", "bilateral", "cuda_graph"}
    pattern = re.compile("|".join(re.escape(name) for name in sorted(registered | stems)))
    found = [line for line in (SOURCE / file).read_text().splitlines() if pattern.search(line)]
    assert not found


def test_test_files_differ_in_name() -> None:
    """pytest imports two files of one name as one module, and collects neither; packages have names of their own."""
    files = [file for file in Path(__file__).parent.rglob("test_*.py") if not (file.parent / "__init__.py").exists()]
    assert len({file.name for file in files}) == len(files)
