"""Run folders, of an earlier revision too, without one key or with null: they open, or there is one sentence."""

import copy
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from faults.record import record, some
from faults.test_readers import example_run, problem_of
from gsx.builtin import plugins
from gsx.experiments.reports.report import report_on, write_report
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.runs.open import open_run

pytestmark = pytest.mark.faults

OLD = Path(__file__).parents[1] / "old_run"
FILES = ["config.yaml", "environment.json", "status.json", "evaluation.json", "renders/index.json"]


def paths(node: Any, prefix: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every key of nested mappings and lists, outer ones first."""
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in inner:
        yield (*prefix, key)
        yield from paths(value, (*prefix, key))


def without(content: Any, path: tuple[str | int, ...], null: bool) -> Any:
    """A copy that lacks what is at a path, or has null there."""
    content = copy.deepcopy(content)
    node = content
    for key in path[:-1]:
        node = node[key]
    if null:
        node[path[-1]] = None
    else:
        del node[path[-1]]
    return content


def look(folder: Path) -> None:
    """What can be done with a run folder."""
    assert state_of(read_run(folder))[0]
    write_report(folder)
    report_on([folder], folder.parent / "page")
    open_run(folder, plugins())


@pytest.mark.parametrize("which", ["today", "old"])
def test_every_key(tmp_path: Path, which: str) -> None:
    (tmp_path / "page").mkdir()
    folder, wrong = tmp_path / "run", []
    if which == "today":
        example_run(tmp_path)
    else:
        shutil.copytree(OLD, folder)
    sidecar = checkpoint.sidecars(folder / "checkpoints")[-1]
    with record(f"a key less, or null, in a run folder ({which})") as counts:
        for file in [*(folder / name for name in FILES if (folder / name).is_file()), sidecar]:
            text = file.read_text()
            read, write = (yaml.safe_load, yaml.safe_dump) if file.suffix == ".yaml" else (json.loads, json.dumps)
            content = read(text)
            for path in some(list(paths(content))):
                for null in (False, True):
                    file.write_text(write(without(content, path, null)))
                    if found := problem_of(look, folder):
                        wrong.append(f"{file.name} {path} {'null' if null else 'gone'}: {found}")
                    counts.cases += 1
            file.write_text(text)
        assert not wrong, "\n".join(wrong)
