"""gsx merge: splats of each block's cell in one file, measured on the whole scene; wrong sets of runs."""

import shutil
from pathlib import Path

import pytest
import torch
from tiny import words

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.experiments.blocks.merge import Trained, ordered, refuse_different, settings_of
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from gsx.formats.splat_files import read_splats
from gsx.scenes.blocks import scene_cells

SCENE = ("scene.train_views=16", "scene.points=60", "training.test_points=0", "scene.test_views=4", "iterations=2")


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs on two blocks."""
    folder = tmp_path_factory.mktemp("blocks")
    for number in (1, 2):
        assert main(words(folder / f"{number}", *SCENE, f"scene.block={number}/2")) == 0
    return folder


def test_a_file_has_the_splats_of_each_cell(blocks: Path, tmp_path: Path, capsys) -> None:
    file = tmp_path / "whole.ply"
    assert main(["merge", str(blocks), "--to", str(file)]) == 0
    cells = scene_cells(load_scene(compose(words(tmp_path, *SCENE), plugins())), 2)
    parts = [read_splats(blocks / f"{number}" / "point_cloud.ply").gaussians.means for number in (1, 2)]
    expected = torch.cat([part[cell.holds(part)] for part, cell in zip(parts, cells, strict=True)])
    assert all(0 < len(part[cell.holds(part)]) < len(part) for part, cell in zip(parts, cells, strict=True))
    torch.testing.assert_close(read_splats(file).gaussians.means, expected, rtol=0, atol=0)
    report = Path(capsys.readouterr().out.split()[-1])
    assert report.is_file()
    assert "4 test views" in (report.parent / "log.txt").read_text()
    shutil.rmtree(report.parent)


def test_a_run_older_than_a_setting_is_merged(blocks: Path, tmp_path: Path) -> None:
    older = Path(shutil.copytree(blocks / "1", tmp_path / "older"))
    config = older / "config.yaml"
    lines = [line for line in config.read_text().splitlines() if not line.strip().startswith("stereo:")]
    config.write_text("\n".join(lines))
    runs = [Trained(folder=folder, settings=settings_of(folder, plugins())) for folder in (older, blocks / "2")]
    refuse_different(ordered(runs))


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a command says that ends with code 2."""
    assert main(["merge", *arguments]) == 2
    return capsys.readouterr().err


def test_runs_that_do_not_belong_together_are_refused(blocks: Path, tmp_path: Path, capsys) -> None:
    one, two, to = str(blocks / "1"), str(blocks / "2"), ("--to", str(tmp_path / "whole.ply"))
    assert "there is no run on block 2/2: train it with scene.block=2/2" in refusal(capsys, one, *to)
    again, other, whole = (Path(shutil.copytree(one, tmp_path / name)) for name in ("again", "other", "whole"))
    assert "are both on block 1/2" in refusal(capsys, one, str(again), *to)
    config = other / "config.yaml"
    config.write_text(config.read_text().replace("points: 60", "points: 61"))
    assert "has scene.points=61" in refusal(capsys, str(other), two, *to)
    config = whole / "config.yaml"
    config.write_text(config.read_text().replace("block: 1/2", "block: ''"))
    assert "was trained on a whole scene: give runs with scene.block" in refusal(capsys, str(whole), two, *to)
    assert "spx" in refusal(capsys, one, two, "--to", str(tmp_path / "whole.spx"))
    assert not (tmp_path / "whole.ply").exists()
