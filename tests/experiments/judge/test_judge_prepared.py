"""Manifests of prepared scenes that gsx judge refuses."""

import json
from pathlib import Path
from typing import Any

import pytest
from judging import QUICK, Subject, made_subject, write_method

from gsx.cli.dispatch import main
from gsx.core.files import read_json


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return made_subject(tmp_path_factory.mktemp("prepared") / "scene")


@pytest.fixture(scope="module")
def pictures(subject: Subject, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_method(subject, tmp_path_factory.mktemp("pictures") / "noisy")


@pytest.fixture(scope="module")
def manifest(subject: Subject, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    to = tmp_path_factory.mktemp("prepared") / "out"
    words = [word for word in subject.words if not word.startswith("eval.competitor")]
    assert main(["prepare", *words, "--to", str(to), "eval.zoom=[1,2]"]) == 0
    content: dict[str, Any] = read_json(to / "prepared.json")
    return content


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"format": 99}, "has format 99"),
        ({"zooms": [0]}, "has the zoom 0"),
        ({"zooms": []}, "lacks 'zooms'"),
        ({"test": [{"name": "zz"}]}, "without name and file"),
        ({"test": [{"name": "zz", "file": "zz.png"}]}, "was prepared with other test views"),
        ({"overrides": None}, "lacks 'overrides'"),
    ],
)
def test_unusable_manifests_are_refused_in_a_sentence(
    change: dict[str, Any], sentence: str, manifest: dict[str, Any], pictures: Path, tmp_path: Path, capsys
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "prepared.json").write_text(json.dumps(manifest | change))
    assert main(["judge", f"a={pictures}", str(folder), *QUICK, "--to", str(tmp_path / "out")]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
