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


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("scene.downscale=4", "was prepared with scene.downscale=2: leave out scene.downscale=4"),
        ("scene.max_width=9", "was prepared without scene.max_width: leave out scene.max_width=9"),
        ("scene.path=nowhere", "was prepared from 'nowhere', which is not there: say where its photos are"),
    ],
)
def test_a_prepared_scene_stays_as_it_is(
    word: str, sentence: str, manifest: dict[str, Any], pictures: Path, tmp_path: Path, capsys
) -> None:
    (tmp_path / "prepared.json").write_text(json.dumps(manifest))
    words = ["judge", f"a={pictures}", str(tmp_path), *QUICK, "--to", str(tmp_path / "out")]
    assert main([*words, word]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_photos_of_a_prepared_scene_may_move(
    manifest: dict[str, Any], subject: Subject, pictures: Path, tmp_path: Path
) -> None:
    (tmp_path / "photos").symlink_to(subject.folder)
    gone = [word.replace(str(subject.folder), "gone") for word in manifest["overrides"]]
    (tmp_path / "prepared.json").write_text(json.dumps(manifest | {"overrides": gone}))
    words = [f"a={pictures}", str(tmp_path), *QUICK, f"scene.path={tmp_path / 'photos'}", "scene.downscale=2"]
    assert main(["judge", *words, "--to", str(tmp_path / "out")]) == 0
