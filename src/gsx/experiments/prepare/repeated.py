"""Overrides that load the same scene and evaluation again, from any folder."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from gsx.core.plugins import Plugins
from gsx.experiments.runs.compose import Compositions
from gsx.experiments.runs.overrides import word_of
from gsx.experiments.runs.settings import Settings, settings_from

KEPT = ("scene", "eval", "metrics")
"""Groups that decide photos and figures."""


def repeating_words(settings: Settings, plugins: Plugins) -> list[str]:
    """Return overrides with the scene's format, and all values of scene and evaluation that are no defaults."""
    scene = f"scene={settings.scene.component.name}"
    with Compositions(plugins) as compositions:
        defaults = settings_from(compositions.composed([scene]), plugins).resolved
    groups = {group: differing(settings.resolved[group], defaults[group], group) for group in KEPT}
    seed = [f"seed={settings.general.seed}"] if settings.general.seed != defaults["seed"] else []
    return [scene, *(word for words in groups.values() for word in words), *seed]


def differing(values: Mapping[str, Any], defaults: Mapping[str, Any], place: str) -> Iterator[str]:
    """Yield an override for each value below a dotted key that is not the default."""
    for key, value in values.items():
        default = defaults.get(key)
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            yield from differing(value, default, f"{place}.{key}")
        elif value != default:
            yield override_of(f"{place}.{key}", value)


def override_of(key: str, value: Any) -> str:
    """Return an override by Hydra's grammar."""
    return word_of(key, value) if isinstance(value, str) else f"{key}={json.dumps(value)}"
