"""Options of training modules: below `training`, each by the schema of its module, of gsx's and of plugins'."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import pytest

from gsx.builtin import plugins
from gsx.core.errors import ConfigError
from gsx.core.options import without_effect
from gsx.core.plugins import Plugins
from gsx.core.ranges import Range
from gsx.experiments.run_folder.run_key import composition_key
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.explain import explain
from gsx.experiments.runs.saved_settings import read_config, write_config


@dataclass(frozen=True, kw_only=True)
class FogOptions:
    """Of a toy."""

    density: Annotated[float, Range(0, 1)]
    views: int = without_effect(default=3)


@pytest.fixture
def foggy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plugins:
    """gsx with a plugin that has a training module."""
    folder = tmp_path / "foggy" / "conf" / "module"
    folder.mkdir(parents=True)
    for place in (folder.parents[1], folder.parent):
        (place / "__init__.py").touch()
    (folder / "fog.yaml").write_text(
        "# @package training.fog\n# Haze in the air.\ndensity: 0.25  # of the air\nviews: 4\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    loaded = plugins()
    loaded.registry.add("module", "fog", SimpleNamespace, FogOptions)
    loaded.registry.add("module", "absent", SimpleNamespace, FogOptions)
    loaded.config_paths.append("pkg://foggy.conf")
    return loaded


def test_a_module_that_is_chosen_has_its_options(foggy: Plugins) -> None:
    chosen = compose(["module=[fog]", "training.fog.density=0.5"], foggy)
    assert chosen.modules["fog"].options == FogOptions(density=0.5, views=4)
    assert "absent" not in chosen.modules
    assert chosen.resolved["training"]["fog"] == {"density": 0.5, "views": 4}
    assert "module" not in chosen.resolved
    assert "fog" not in compose([], foggy).modules


def test_what_changes_no_result_does_not_count_for_the_name_of_a_run(foggy: Plugins) -> None:
    words = (["module=[fog]"], ["module=[fog]", "training.fog.views=9"], ["module=[fog]", "training.fog.density=0.9"])
    composed = [compose(own, foggy) for own in words]
    first, same, other = (composition_key(one.resolved, "", one.idle) for one in composed)
    assert first == same != other
    assert "training.fog.views" in composed[0].idle


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            ["module=[fig]"],
            r"Unknown module 'fig'. Choose from appearance, .*, fog, .*\. Did you mean 'fog'\?",
        ),
        (["module=[fog]", "training.fog.densty=1"], r"Did you mean 'training\.fog\.density'\?"),
        (["module=[fog]", "+training.fog.densty=1"], r"Did you mean 'training\.fog\.density'\?"),
        (["module=[fog]", "training.fog.density=2"], r"training\.fog\.density is 2\.0; give a number from 0 to 1"),
        (["+training.fgo=1"], r"Unknown key 'training\.fgo'\. Did you mean 'training\.fog'\?"),
        (["+training.fgo.density=1"], r"and no installed plugin has a module of that name\. Did you mean"),
        (["+training.fog=1"], r"training\.fog is 1, but it is a group of settings: give training\.fog\.NAME=VALUE"),
        (["training.btach=2"], r"Did you mean 'training\.batch'\?"),
    ],
)
def test_mistakes_get_the_nearest(words: list[str], complaint: str, foggy: Plugins) -> None:
    with pytest.raises(ConfigError, match=complaint):
        compose(words, foggy)


def test_without_plugins_there_is_no_module_to_choose() -> None:
    with pytest.raises(ConfigError, match=r"Unknown module '.*'\. Choose from appearance, blur, coarse_to_fine"):
        compose(["module=[fog]"], plugins())


def test_a_saved_run_keeps_its_modules_and_takes_new_ones(foggy: Plugins, tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    write_config(path, compose([], foggy).resolved)
    assert "fog" not in read_config(path, foggy).modules
    assert read_config(path, foggy, ["training.fog.density=0.5"]).modules["fog"].options.density == 0.5
    write_config(path, compose(["module=[fog]"], foggy).resolved)
    assert read_config(path, foggy).modules["fog"].options.density == 0.25
    with pytest.raises(ConfigError, match=r"Did you mean 'training\.fog\.density'\?"):
        read_config(path, foggy, ["training.fog.densty=0.5"])
    with pytest.raises(
        ConfigError,
        match=r"^training.fog is 'fog', which no plugin provides: install the plugin that it was trained with$",
    ):
        read_config(path, plugins())


def test_a_key_of_a_module_is_explained(foggy: Plugins) -> None:
    lines = explain("training.fog.density", ["module=[fog]"], foggy)
    assert lines[:2] == ["training.fog.density = 0.25", "  number from 0 to 1"]
    assert any("of the air" in line for line in lines)
    assert any(
        line.startswith("* fog") and "Haze in the air" in line for line in explain("module", ["module=[fog]"], foggy)
    )
