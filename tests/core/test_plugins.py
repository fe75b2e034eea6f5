"""Plugins: what they may add, and what happens when they are wrong."""

from importlib.metadata import EntryPoint
from pathlib import Path
from textwrap import dedent

import pytest

from gsx.core.errors import ConfigError
from gsx.core.plugins import BLOCK, Plugins, Registry, hookimpl, load_plugins

GOOD = """
    from gsx.core.plugins import hookimpl

    class Options: ...
    def build(options, beginning): return "built"

    @hookimpl
    def gsx_register(registry):
        registry.add("backbone", "mine", build, Options)

    @hookimpl
    def gsx_config_paths():
        return ["pkg://mine.conf"]
"""


def point(name: str, source: str, folder: Path) -> EntryPoint:
    """An entry point to a module made of `source`; `folder` must be importable."""
    (folder / f"{name}_module.py").write_text(dedent(source))
    return EntryPoint(name=name, value=f"{name}_module", group="gsx")


@pytest.fixture
def importable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def load(importable: Path, **sources: str) -> Plugins:
    return load_plugins([], points=[point(name, source, importable) for name, source in sources.items()])


def test_a_plugin_adds_components_and_search_paths(importable: Path) -> None:
    plugins = load(importable, good1=GOOD)
    component = plugins.registry.find("backbone", "mine")
    assert (component.kind, component.name, component.provider) == ("backbone", "mine", "good1")
    assert component.factory(None, None) == "built"
    assert component.options.__name__ == "Options"
    assert plugins.config_paths == ["pkg://mine.conf"]
    assert plugins.failures == []
    assert plugins.versions == {"good1": "?"}


def test_builtins_come_in_through_the_same_hook() -> None:
    from gsx import builtin

    registry = load_plugins([("gsx", builtin)], points=[]).registry
    gaussians, anchors = ["gs3d", "gs3d_zoom", "mip_splatting"], ["octree_gs3d", "octree_scaffold", "scaffold"]
    assert registry.names("backbone") == [*gaussians, *anchors]
    assert {"demo", "colmap", "photos", "blender", "transforms", "bungee"} <= set(registry.names("scene"))
    assert registry.find("backbone", "gs3d").provider == "gsx"


def test_name_clash_keeps_the_first_and_reports_the_second(importable: Path) -> None:
    second = GOOD.replace('"mine"', '"extra"').replace(
        'registry.add("backbone", "extra", build, Options)',
        'registry.add("backbone", "extra", build, Options); registry.add("backbone", "mine", build, Options)',
    )
    plugins = load(importable, first2=GOOD, second2=second)
    assert plugins.registry.find("backbone", "mine").provider == "first2"
    [failure] = plugins.failures
    assert failure.plugin == "second2"
    assert "backbone 'mine' is already registered by first2" in failure.reason
    # nothing of the second is left: neither what it had added before nor its other hooks
    assert plugins.registry.names("backbone") == ["mine"]
    assert plugins.config_paths == ["pkg://mine.conf"]
    assert list(plugins.versions) == ["first2"]


def test_one_name_may_serve_two_kinds() -> None:
    registry = Registry()
    registry.add("scene", "mine", int, dict)
    registry.add("backbone", "mine", str, dict)
    assert registry.find("scene", "mine").factory is int
    assert registry.find("backbone", "mine").factory is str


BROKEN = {
    "misspelt hook": (GOOD.replace("gsx_config_paths", "gsx_confg_paths"), "PluginValidationError", "gsx_confg_paths"),
    "unknown argument": (GOOD + "\n    @hookimpl\n    def gsx_step_finished(stop): ...", "Validation", "stop"),
    "import error": ("import a_module_that_does_not_exist", "ModuleNotFoundError", "a_module_that_does_not_exist"),
    "syntax error": ("def f(:", "SyntaxError", ""),
    "error while registering": (GOOD.replace('"mine", build', '"mine", 1 / 0'), "ZeroDivisionError", "division"),
    "unknown kind": (GOOD.replace('"backbone"', '"backbon"'), "ConfigError", "Did you mean 'backbone'?"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_plugin_is_reported_and_the_others_load(case: str, importable: Path) -> None:
    source, error, words = BROKEN[case]
    stem = case.replace(" ", "_")
    good = GOOD.replace('"mine"', '"good"').replace("mine.conf", "good.conf")
    plugins = load(importable, **{f"bad_{stem}": source, f"good_{stem}": good})
    [failure] = plugins.failures
    assert failure.plugin == f"bad_{stem}"
    assert error in failure.reason
    assert words in failure.reason
    assert plugins.registry.names("backbone") == ["good"]
    assert plugins.config_paths == ["pkg://good.conf"]
    assert plugins.manager.get_plugin(f"bad_{stem}") is None
    assert list(plugins.versions) == [f"good_{stem}"]


def test_two_plugins_of_one_name_are_one_too_many(importable: Path) -> None:
    twice = point("twice", GOOD, importable)
    other = EntryPoint(name="twice", value="json", group="gsx")
    plugins = load_plugins([], points=[twice, other])
    assert [failure.plugin for failure in plugins.failures] == ["twice"]
    assert plugins.registry.names("backbone") == ["mine"]


def installed(folder: Path, name: str, version: str) -> None:
    """A distribution as pip would leave it, with an entry point in group gsx."""
    (folder / f"{name}_package.py").write_text(dedent(GOOD).replace('"mine"', f'"{name}"'))
    info = folder / f"{name}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[gsx]\n{name} = {name}_package\n")


def test_installed_plugins_are_found_unless_blocked(importable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(importable, "found", "1.2.3")
    monkeypatch.delenv(BLOCK, raising=False)
    plugins = load_plugins([])
    assert plugins.versions["found"] == "1.2.3"
    assert "found" in plugins.registry.names("backbone")
    monkeypatch.setenv("GSX_NO_PLUGINS", "1")
    blocked = load_plugins([("own", Recorder("own", []))])
    assert blocked.versions == {}
    assert blocked.registry.names("backbone") == []
    assert blocked.manager.get_plugin("own") is not None  # built-ins are not blocked
    monkeypatch.setenv("GSX_NO_PLUGINS", "")
    assert "found" in load_plugins([]).versions


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("backbone", "gs3", r"backbone\.name is 'gs3', .* there are: gs3d, mip\. Did you mean 'gs3d'\?"),
        ("backbone", "zzz", r"there are: gs3d, mip\.$"),
        ("scene", "gs3d", r"scene\.name is 'gs3d', .* there are: none\."),
    ],
)
def test_unknown_names_come_with_the_nearest(kind: str, name: str, message: str) -> None:
    registry = Registry()
    registry.add("backbone", "mip", int, dict)
    registry.add("backbone", "gs3d", int, dict)
    with pytest.raises(ConfigError, match=message):
        registry.find(kind, name)


class Recorder:
    """Writes its name into a common list at two events; may veto steps."""

    def __init__(self, name: str, calls: list[str], veto: str | None = None) -> None:
        self.name, self.calls, self.veto = name, calls, veto

    @hookimpl
    def gsx_run_finished(self, run: object) -> None:
        self.calls.append(self.name)

    @hookimpl
    def gsx_gradients_ready(self) -> str | None:  # hooks may take fewer arguments
        self.calls.append(self.name)
        return self.veto


def test_listeners_are_called_in_the_order_listed_then_plugins() -> None:
    calls: list[str] = []
    plugins = load_plugins([("first", Recorder("first", calls)), ("second", Recorder("second", calls))], points=[])
    with plugins.listening([Recorder(name, calls) for name in "abc"]):
        plugins.emit.gsx_run_finished(run=None)
    assert calls[:3] == ["a", "b", "c"]
    assert sorted(calls[3:]) == ["first", "second"]


def test_listeners_leave_when_the_run_ends_or_fails() -> None:
    calls: list[str] = []
    plugins = load_plugins([], points=[])
    with pytest.raises(RuntimeError), plugins.listening([Recorder("a", calls)]):
        raise RuntimeError
    plugins.emit.gsx_run_finished(run=None)
    assert calls == []


def test_the_first_reason_to_skip_a_step_wins_and_ends_the_questions() -> None:
    calls: list[str] = []
    plugins = load_plugins([], points=[])
    listeners = [Recorder("a", calls), Recorder("b", calls, "too bright"), Recorder("c", calls, "too dark")]
    with plugins.listening(listeners):
        assert plugins.emit.gsx_gradients_ready(run=None, step=None) == "too bright"
    assert calls == ["a", "b"]
