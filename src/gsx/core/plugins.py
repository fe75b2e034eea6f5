"""The doors of gsx: hook specifications, the registry they fill, and discovery of installed plugins.

Built-ins come in through the same hooks as third parties. A third party ships a wheel with an entry point in group
`gsx` that names a module or object implementing hooks (docs/how-to/write-a-plugin.md). A plugin that fails to load is
reported by `gsx plugins` and at the start of a run, and everything else goes on.
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
"""Environment variable: when set and not empty, only built-ins are loaded."""
KINDS = ("scene", "backbone", "module", "augmenter", "regenerator", "tracker", "compositor")

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


@dataclass(frozen=True)
class Component:
    """Something a configuration can name: `<kind>.name: <name>`."""

    kind: str
    name: str
    factory: Callable[..., Any]
    options: type
    """Dataclass of its configuration: types and keys; a YAML file in conf/<kind>/ gives the values."""
    provider: str
    """Plugin it came from."""
    scene_format: SceneFormat | None = None
    """Of a scene loader: how it tells its folders, if it reads any."""


@dataclass
class Registry:
    """Components by kind and name."""

    components: dict[tuple[str, str], Component] = field(default_factory=dict)
    provider: str = "gsx"
    """Plugin that is registering at the moment."""

    def add(
        self,
        kind: str,
        name: str,
        factory: Callable[..., Any],
        options: type,
        scene_format: SceneFormat | None = None,
    ) -> None:
        """Register a component; `scene_format`: see `Component`.

        Raises:
            ConfigError: the kind is unknown or the name is taken.
        """
        if kind not in KINDS:
            raise ConfigError(
                f"'{kind}' is no kind of component; choose from {', '.join(KINDS)}.{nearest(kind, KINDS)}"
            )
        if (kind, name) in self.components:
            taken = self.components[kind, name].provider
            raise ConfigError(f"{kind} '{name}' is already registered by {taken}; choose another name")
        self.components[kind, name] = Component(kind, name, factory, options, self.provider, scene_format)

    def formats(self) -> list[tuple[Component, SceneFormat]]:
        """Scene loaders that read folders, the latest first: plugins before what ships with gsx."""
        scenes = [component for component in self.components.values() if component.kind == "scene"]
        return [(scene, scene.scene_format) for scene in reversed(scenes) if scene.scene_format is not None]

    def names(self, kind: str) -> list[str]:
        """Names of a kind, sorted."""
        return sorted(name for k, name in self.components if k == kind)

    def of(self, kind: str) -> dict[str, Component]:
        """Components of a kind by name, in the order in which they were registered."""
        return {name: component for (k, name), component in self.components.items() if k == kind}

    def find(self, kind: str, name: str) -> Component:
        """The component, or ConfigError with the nearest name."""
        if (kind, name) not in self.components:
            options = self.names(kind)
            raise ConfigError(
                f"{kind}.name is '{name}', which no installed plugin provides; "
                f"there are: {', '.join(options) or 'none'}.{nearest(name, options)}"
            )
        return self.components[kind, name]


class Hooks:
    """The whole plugin interface. Implementations may take fewer arguments than listed here."""

    @hookspec
    def gsx_register(self, registry: Registry) -> None:
        """Called once at start-up: add components with `registry.add(kind, name, factory, options)`."""

    @hookspec
    def gsx_config_paths(self) -> list[str]:  # type: ignore[empty-body]
        """Extra Hydra search paths with configuration groups, for example ['pkg://your_package.conf']."""

    @hookspec
    def gsx_run_started(self, run: "Run") -> None:
        """The scene and backbone are built (and restored, when resuming); training is about to begin."""

    @hookspec(firstresult=True)
    def gsx_gradients_ready(self, run: "Run", step: "StepResult") -> str | None:
        """After the backward pass, before anything changes: return a reason to skip this step, else None."""

    @hookspec
    def gsx_step_finished(self, run: "Run", step: "StepResult") -> None:
        """One training step is done."""

    @hookspec
    def gsx_evaluated(self, run: "Run", evaluation: dict[str, Any]) -> None:
        """An evaluation on held-out views is done; `evaluation` is what evaluation.json holds."""

    @hookspec
    def gsx_training_finished(self, run: "Run") -> None:
        """The loop has ended, complete or interrupted (`run.complete` says which); nothing is evaluated yet."""

    @hookspec
    def gsx_run_finished(self, run: "Run") -> None:
        """Everything of the run is on disk."""

    @hookspec
    def gsx_run_failed(self, run: "Run", reason: str) -> None:
        """Training or what follows it ended with an error, or with a second Ctrl-C (KeyboardInterrupt: ...)."""


@dataclass(frozen=True)
class Failure:
    """A plugin that could not be loaded."""

    plugin: str
    reason: str


@dataclass
class Plugins:
    """Loaded plugins: the pluggy manager that emits events, the registry, and what failed."""

    manager: pluggy.PluginManager
    registry: Registry
    failures: list[Failure]
    versions: dict[str, str]
    """Version of each loaded plugin's distribution."""
    config_paths: list[str] = field(default_factory=list)
    """Hydra search paths of all plugins."""

    @property
    def emit(self) -> pluggy.HookRelay:
        """Hook calls by name: `plugins.emit.gsx_step_finished(run=run, step=step)`."""
        return self.manager.hook

    @contextmanager
    def listening(self, listeners: Iterable[object]) -> Iterator[None]:
        """Objects with event hooks listen for the duration of a run; the first listed is called first."""
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
    """Register the built-ins, then every entry point that loads. `points` replaces discovery in tests."""
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    plugins = Plugins(manager, Registry(), [], {})
    for name, plugin in builtins:
        admit(plugins, name, plugin)
    if points is None:
        points = [] if os.environ.get(BLOCK) else entry_points(group=GROUP)
    for point in points:
        try:
            admit(plugins, point.name, point.load())
            plugins.versions[point.name] = point.dist.version if point.dist else "?"
        except Exception as error:  # whatever a third party raises, the rest must go on
            plugins.failures.append(Failure(point.name, f"{type(error).__name__}: {error}"))
    return plugins


def admit(plugins: Plugins, name: str, plugin: object) -> None:
    """Register one plugin and let it fill the registry; on an error it is taken out again, and the error raised."""
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
                raise TypeError(f"gsx_config_paths must return a list of texts, got {added!r}")
            plugins.config_paths += added
    except Exception:
        plugins.manager.unregister(plugin)
        plugins.registry.components, plugins.config_paths = before, paths
        raise


def refuse_unmarked(plugin: object) -> None:
    """Raise TypeError for a function named like a hook without `@hookimpl`: it would silently never run."""
    for name in dir(plugin):
        if (
            name.startswith(f"{GROUP}_")
            and callable(hook := getattr(plugin, name))
            and not hasattr(hook, f"{GROUP}_impl")
        ):
            raise TypeError(f"{name} is not marked with @hookimpl")
