"""Settings with other values for some keys."""

from collections.abc import Mapping

from omegaconf import OmegaConf

from gsx.core.plugins import Plugins
from gsx.experiments.runs.settings import Settings, settings_from


def overridden(settings: Settings, changes: Mapping[str, object], loaded: Plugins) -> Settings:
    """Returns settings with other values by dotted key; raises ConfigError as `settings_from`."""
    config = OmegaConf.create(settings.resolved)
    for key, value in changes.items():
        OmegaConf.update(config, key, value, force_add=True)
    return settings_from(config, loaded)
