"""A run folder as gsx wrote it at revision 2d17ca8, before its modules moved: it opens, is evaluated and goes on.

octree_gs3d and upscale_paper on the built-in scene, 24 x 18 px, 12 steps.
"""

import json
import shutil
from pathlib import Path

import pytest
import yaml
from tiny import leave_results

from gsx.builtin import plugins
from gsx.core.training.parameter_table import table_tensors
from gsx.core.training.trainer import train
from gsx.experiments.run_folder.files import read_run
from gsx.experiments.run_folder.run_key import composition_key, evaluation_settings, finished
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.evaluate import evaluate
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.saved_settings import read_config, write_config

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


def test_keys_of_an_old_run_have_their_new_names_wherever_it_is_read(folder: Path) -> None:
    config, (_, settings) = read_run(folder).config, open_run(folder, plugins())
    for found in (config, settings.resolved):
        assert found["warm_start_at"] == []
        assert "disk_cache_gb" not in found  # what was a budget of states is not that of the whole cache
        assert found["backbone"]["rates"]["sh_dc"] == {"first": 0.0025, "last": 0.0025}
        assert found["backbone"]["clone_split"]["rates"]["sh_dc"] == 0.0025
        assert not {"trunk_at", "trunk_gb", "sh_constant"} & found.keys()
    assert settings.general.disk_cache_gb == 20


def test_an_old_run_without_a_form_of_densification_is_one_on_anchors(folder: Path) -> None:
    path = folder / "config.yaml"
    config = yaml.safe_load(path.read_text())
    del config["backbone"]["densification"]
    path.write_text(yaml.safe_dump(config))
    run, _ = open_run(folder, plugins())
    assert len(run.backbone.table) == 31
    assert run.backbone.options.densification == "anchors"


def test_a_configuration_that_was_read_back_is_the_same_composition(tmp_path: Path) -> None:
    loaded = plugins()
    made = compose(["backbone=mip_splatting", "augmenter=[upscale]", f"folder={tmp_path / 'run'}"], loaded)
    write_config(tmp_path / "config.yaml", made.resolved)
    again = read_config(tmp_path / "config.yaml", loaded)
    write_config(tmp_path / "config.yaml", again.resolved)  # as resuming does
    once_more = read_config(tmp_path / "config.yaml", loaded)
    assert "zoomed" not in once_more.resolved["rasterizer"]
    assert len({composition_key(one.resolved, "", one.idle) for one in (made, again, once_more)}) == 1


def test_figures_by_another_filter_are_not_those_of_the_composition(tmp_path: Path) -> None:
    made = compose(["backbone=gs3d", "iterations=1"], plugins())
    write_config(tmp_path / "config.yaml", made.resolved)
    (tmp_path / "status.json").write_text('{"state": "ok", "step": 1}')
    (tmp_path / "environment.json").write_text('{"scene": {"stamp": ""}}')
    leave_results(tmp_path)
    own = evaluation_settings(made.resolved)
    cases = [
        ({"settings": own}, True),
        ({"settings": own | {"eval": own["eval"] | {"colours": "fitted"}}}, False),
        ({"settings": own | {"filter": "resampled"}}, False),
        ({"settings": {"eval": None, "metrics": None}}, False),
        ({}, False),
    ]
    for saved, expected in cases:
        (tmp_path / "evaluation.json").write_text(json.dumps({"step": 1, "psnr": 20.0, **saved}))
        assert finished(read_run(tmp_path), made.resolved, "", made.idle) is expected, saved
