"""A run folder as gsx wrote it at revision 2d17ca8, before its modules moved: it opens, is evaluated and goes on.

octree_gs3d and upscale_paper on the built-in scene, 24 x 18 px, 12 steps.
"""

import json
import shutil
from pathlib import Path

import pytest

from gsx.builtin import plugins
from gsx.core.training.parameter_table import table_tensors
from gsx.core.training.trainer import train
from gsx.experiments.runs.evaluate import evaluate
from gsx.experiments.runs.open import open_run

OLD = Path(__file__).parents[2] / "old_run"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(OLD, tmp_path / "run")
    return tmp_path / "run"


def test_an_old_run_has_the_figures_that_it_had(folder: Path) -> None:
    run, settings = open_run(folder, plugins())
    before, now = json.loads((OLD / "evaluation.json").read_text()), evaluate(run, settings)
    assert now["primitives"] == before["primitives"] == 31
    for zoom in ("1", "2"):
        for key in ("psnr", "enlarged_psnr"):
            assert now["zoom"][zoom][key] == pytest.approx(before["zoom"][zoom][key], abs=0.01), (zoom, key)


def test_an_old_run_goes_on(folder: Path) -> None:
    loaded = plugins()
    run, _ = open_run(folder, loaded, ["iterations=14"], training=True)
    assert run.step == 12
    before = {name: value.clone() for name, value in table_tensors(run.backbone.table).items()}
    train(run, loaded)
    assert run.complete
    assert before["adam.offsets.step"] == 11  # one event cost its step
    assert table_tensors(run.backbone.table)["adam.offsets.step"] == 13
