"""Configuration files are parsed once: as Hydra reads them, and as they are now."""

from pathlib import Path

import pytest
from hydra._internal.core_plugins.importlib_resources_config_source import ImportlibResourcesConfigSource
from hydra.plugins.config_source import ConfigLoadError

from gsx.builtin import plugins
from gsx.experiments.runs.compose import MODULE, Compositions
from gsx.experiments.runs.config_files import HYDRAS, OURS, ParsedOnce


def test_what_a_composition_does_to_a_file_stays_its_own() -> None:
    ours, hydras = ParsedOnce("main", f"{OURS}{MODULE}"), ImportlibResourcesConfigSource("main", f"{HYDRAS}{MODULE}")
    once, again, expected = (source.load_config("backbone/gs3d") for source in (ours, ours, hydras))
    assert once.config == again.config == expected.config
    assert once.header == expected.header
    again.config["changed"] = 1
    assert ours.load_config("backbone/gs3d").config == expected.config


def test_a_file_that_was_edited_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "edited_conf"
    (package / "part").mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "part" / "one.yaml").write_text("# @package _global_\na: 1\n")
    (package / "part" / "none.yaml").write_text("\n")
    monkeypatch.syspath_prepend(tmp_path)
    source = ParsedOnce("gsx", f"{OURS}edited_conf")
    assert source.available()
    assert (source.load_config("part/one").config, source.load_config("part/one").header) == (
        {"a": 1}, {"package": "_global_"},
    )  # fmt: skip
    assert source.load_config("part/none").config == {}
    (package / "part" / "one.yaml").write_text("a: 22\n")
    assert (source.load_config("part/one").config, source.load_config("part/one").header) == (
        {"a": 22}, {"package": None},
    )  # fmt: skip
    with pytest.raises(ConfigLoadError, match="part/two"):
        source.load_config("part/two")


def test_packages_are_parsed_once() -> None:
    with Compositions(plugins()):
        from hydra.core.global_hydra import GlobalHydra

        found = [source.full_path() for source in GlobalHydra.instance().config_loader().get_sources()]
    assert f"{OURS}{MODULE}" in found
    assert not [path for path in found if path.startswith(HYDRAS)]


def test_search_paths_of_plugins_do_not_pile_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each session once had those of all sessions before it."""
    from hydra.core.global_hydra import GlobalHydra

    loaded = plugins()
    monkeypatch.setattr(loaded, "config_paths", ["pkg://hydra.conf.help"])
    for _ in range(3):
        with Compositions(loaded):
            found = [source.path for source in GlobalHydra.instance().config_loader().get_sources()]
        assert found.count("hydra.conf.help") == 1
    with Compositions(plugins()):
        assert "hydra.conf.help" not in [s.path for s in GlobalHydra.instance().config_loader().get_sources()]
