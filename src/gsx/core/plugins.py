"""Hook specifications, the component registry, and discovery of installed plugins.

A plugin is a package with an entry point in group `gsx` that names a module or object with hooks
(docs/how-to/write-a-plugin.md). Built-in components use the same hooks. A plugin that fails to load is reported by
`gsx plugins` and at the start of a run; everything else works.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

import pluggy

from gsx.core.data.scene_format import SceneFormat
from gsx.core.errors import ConfigError, nearest

if TYPE_CHECKING:
    from gsx.core.training.run import Run, StepResult

GROUP = "gsx"
"""Entry-point group and pluggy project name."""
BLOCK = "GSX_NO_PLUGINS"
"""Environment variable; if set and not empty, only built-ins are loaded."""
KINDS = ("scene", "backbone", "module", "augmenter", "regenerator", "tracker", "compositor")

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


@dataclass(frozen=True)
class Component:
    """Component that a configuration names by `<kind>.name: <name>`."""

    kind: str
    name: str
    factory: Callable[..., Any]
    options: type
    """Dataclass with keys and types of its configuration; a YAML file in conf/<kind>/ holds the values."""
    provider: str
    """Plugin that registered it."""
    scene_format: SceneFormat | None = None
    """Format of a scene loader that reads folders."""


@dataclass
class Registry:
    """Components by kind and name."""

    components: dict[tuple[str, str], Component] = field(default_factory=dict)
    provider: str = "gsx"
    """Plugin that is registering now."""

    def add(
        self, kind: str, name: str, factory: Callable[..., Any], options: type, scene_format: SceneFormat | None = None
    ) -> None:
        """Registers a component.

        Args:
            kind: One of `KINDS`.
            name: Name in configurations.
            factory: Returns the component from an instance of `options` and, for some kinds, a context.
            options: Dataclass of its configuration.
            scene_format: Format of a scene loader that reads folders.

        Raises:
            ConfigError: the kind is unknown or the name is in use.
        """
        if kind not in KINDS:
            raise ConfigError(
                f"'{kind}' is not a kind of component; choose from {', '.join(KINDS)}.{nearest(kind, KINDS)}"
            )
        if (kind, name) in self.components:
            other = self.components[kind, name].provider
            raise ConfigError(f"{kind} '{name}' is already registered by {other}; choose another name")
        self.components[kind, name] = Component(kind, name, factory, options, self.provider, scene_format)

    def formats(self) -> list[tuple[Component, SceneFormat]]:
        """Returns scene loaders that read folders, with their formats, plugins before built-ins."""
        scenes = [component for component in self.components.values() if component.kind == "scene"]
        return [(scene, scene.scene_format) for scene in reversed(scenes) if scene.scene_format is not None]

    def names(self, kind: str) -> list[str]:
        """Returns the names of a kind, sorted."""
        return sorted(name for k, name in self.components if k == kind)

    def of(self, kind: str) -> dict[str, Component]:
        """Returns the components of a kind by name, in the order of their registration."""
        return {name: component for (k, name), component in self.components.items() if k == kind}

    def find(self, kind: str, name: str) -> Component:
        """Returns a component; ConfigError: there is none, with the nearest name."""
        if (kind, name) in self.components:
            return self.components[kind, name]
        names = self.names(kind)
        known = f"there are: {', '.join(names) or 'none'}.{nearest(name, names)}"
        raise ConfigError(f"{kind}.name is '{name}', which no installed plugin provides; {known}")


class Hooks:
    """Hooks of the plugin interface; an implementation may take fewer of the arguments."""

    @hookspec
    def gsx_register(self, registry: Registry) -> None:
        """Registers components by `registry.add(kind, name, factory, options)`; called once at start-up."""

    @hookspec
    def gsx_config_paths(self) -> list[str]:  # type: ignore[empty-body]
        """Returns Hydra search paths with configuration groups, such as ['pkg://your_package.conf']."""

    @hookspec
    def gsx_run_started(self, run: "Run") -> None:
        """Runs before the first step, with scene and backbone built or restored."""

    @hookspec(firstresult=True)
    def gsx_gradients_ready(self, run: "Run", step: "StepResult") -> str | None:
        """Runs after the backward pass, before any update; returns a reason to skip this step, or None."""

    @hookspec
    def gsx_step_finished(self, run: "Run", step: "StepResult") -> None:
        """Runs after each step."""

    @hookspec
    def gsx_evaluated(self, run: "Run", evaluation: dict[str, Any]) -> None:
        """Runs after an evaluation on held-out views; `evaluation` is the content of evaluation.json."""

    @hookspec
    def gsx_training_finished(self, run: "Run") -> None:
        """Runs after the last step, before the evaluation; `run.complete` is False for an interrupted run."""

    @hookspec
    def gsx_run_finished(self, run: "Run") -> None:
        """Runs when all files of the run are written."""

    @hookspec
    def gsx_run_failed(self, run: "Run", reason: str) -> None:
        """Runs after an error in training or evaluation, or a second Ctrl-C (KeyboardInterrupt: ...)."""


@dataclass(frozen=True)
class Failure:
    """Plugin that failed to load."""

    plugin: str
    reason: str


@dataclass
class Plugins:
    """Loaded plugins: the pluggy manager that calls hooks, the registry, and failures."""

    manager: pluggy.PluginManager
    registry: Registry
    failures: list[Failure]
    versions: dict[str, str]
    """Version of each loaded plugin's distribution."""
    config_paths: list[str] = field(default_factory=list)
    """Hydra search paths of all plugins."""

    @property
    def emit(self) -> pluggy.HookRelay:
        """Hooks by name: `plugins.emit.gsx_step_finished(run=run, step=result)`."""
        return self.manager.hook

    @contextmanager
    def listening(self, listeners: Iterable[object]) -> Iterator[None]:
        """Registers objects with event hooks inside the block; the first is called first."""
        registered = list(listeners)
        for listener in reversed(registered):  # pluggy calls the latest registration first
            refuse_unmarked(listener)
            self.manager.register(listener)
        self.manager.check_pending()
        try:
            yield
        finally:
            for listener in registered:
                self.manager.unregister(listener)


def load_plugins(builtins: Iterable[tuple[str, object]], points: Iterable[EntryPoint] | None = None) -> Plugins:
    """Registers the built-ins, then all entry points that load; `points` replaces discovery in tests."""
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    plugins = Plugins(manager, Registry(), [], {})
    for name, plugin in builtins:
        register_plugin(plugins, name, plugin)
    if points is None:
        points = [] if os.environ.get(BLOCK) else entry_points(group=GROUP)
    for point in points:
        try:
            register_plugin(plugins, point.name, point.load())
            plugins.versions[point.name] = point.dist.version if point.dist else "?"
        except Exception as error:  # any error of a third party; other plugins must load
            plugins.failures.append(Failure(point.name, f"{type(error).__name__}: {error}"))
    return plugins


def register_plugin(plugins: Plugins, name: str, plugin: object) -> None:
    """Registers one plugin and its components; unregisters it on an error."""
    before, paths = dict(plugins.registry.components), list(plugins.config_paths)
    refuse_unmarked(plugin)
    plugins.manager.register(plugin, name=name)
    try:
        plugins.manager.check_pending()
        plugins.registry.provider = name
        if hasattr(plugin, "gsx_register"):
            plugin.gsx_register(registry=plugins.registry)
        if hasattr(plugin, "gsx_config_paths"):
            added = plugin.gsx_config_paths()
            if not isinstance(added, list) or not all(isinstance(path, str) for path in added):
                raise TypeError(f"gsx_config_paths returned {added!r}; return a list of strings")
            plugins.config_paths += added
    except Exception:
        plugins.manager.unregister(plugin)
        plugins.registry.components, plugins.config_paths = before, paths
        raise


def refuse_unmarked(plugin: object) -> None:
    """Raises TypeError for a function named like a hook but without `@hookimpl`, which pluggy would ignore."""
    for name in dir(plugin):
        hook = getattr(plugin, name) if name.startswith(f"{GROUP}_") else None
        if callable(hook) and not hasattr(hook, f"{GROUP}_impl"):
            raise TypeError(f"{name} is not marked with @hookimpl; add the decorator")
