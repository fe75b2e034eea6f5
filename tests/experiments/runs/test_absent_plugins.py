"""Runs of plugins that are not installed any more: a finished one is opened, one to train names its plugin."""

import json
import shutil
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from tiny import LIGHT, tiny_run

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import ConfigError
from gsx.experiments.runs.open import open_run


@pytest.fixture(scope="module")
def orphan(tmp_path_factory) -> Path:
    """A finished run whose upscaler, augmenter and tracker no plugin provides."""
    folder = tmp_path_factory.mktemp("orphan") / "run"
    tiny_run(folder, [*LIGHT, "iterations=2", "augmenter=[upscale]"])
    config = (folder / "config.yaml").read_text()
    for name in ("upscale", "scene_sr", "scene_restorer"):
        config = config.replace(f"name: {name}\n", "name: doubled\n")
    (folder / "config.yaml").write_text(config)
    facts = json.loads((folder / "environment.json").read_text())
    facts |= {"plugins": {"sharp": "0.1"}, "distributions": {"sharp": "gsx-sharp"}}
    (folder / "environment.json").write_text(json.dumps(facts))
    return folder


def test_it_is_opened_rendered_exported_and_evaluated(orphan: Path, tmp_path: Path) -> None:
    run, settings = open_run(orphan, plugins())
    assert run.step == 2
    assert (settings.augmenters, settings.regenerators) == ({}, {})
    assert settings.resolved["augmenter"]["upscale"]["name"] == "doubled"
    assert main(["render", str(orphan), "--to", str(tmp_path / "views")]) == 0
    assert main(["export", str(orphan), str(tmp_path / "x.ply")]) == 0
    assert main(["eval", str(orphan), "eval.zoom=[1]"]) == 0


def test_an_absent_competitor_is_needed_to_evaluate_alone(orphan: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(orphan, tmp_path / "run"))
    config = OmegaConf.load(folder / "config.yaml")
    config.eval.competitor = {"name": "doubled"}
    OmegaConf.save(config, folder / "config.yaml")
    assert open_run(folder, plugins())[1].competitor is None
    with pytest.raises(ConfigError, match=r"^eval.competitor is 'doubled', .*, or leave it out by "):
        open_run(folder, plugins(), evaluating=True)
    assert open_run(folder, plugins(), ["eval.competitor=null"], evaluating=True)[1].competitor is None


def test_training_on_names_the_plugin(orphan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["resume", str(orphan), "iterations=4"]) == 2
    assert (
        capsys.readouterr()
        .err.strip()
        .endswith("is 'doubled', which no plugin provides: install gsx-sharp 0.1, with which the run was trained")
    )
    facts = json.loads((orphan / "environment.json").read_text())
    (orphan / "environment.json").write_text(json.dumps(facts | {"plugins": {}}))
    with pytest.raises(ConfigError, match=r"which no plugin provides: install the plugin that it was trained with$"):
        open_run(orphan, plugins(), training=True)


def test_an_absent_backbone_is_always_needed(orphan: Path) -> None:
    config = orphan / "config.yaml"
    config.write_text(config.read_text().replace("name: gs3d\n", "name: gs4d\n"))
    with pytest.raises(ConfigError, match=r"^backbone is 'gs4d', which no plugin provides"):
        open_run(orphan, plugins())
