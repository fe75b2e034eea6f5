"""Files of configuration packages (`pkg://...`) as Hydra reads them, but parsed once per process."""

import pickle
from collections.abc import Sequence
from functools import lru_cache
from importlib import resources
from pathlib import Path

from hydra._internal.core_plugins.importlib_resources_config_source import ImportlibResourcesConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin

HYDRAS, OURS = "pkg://", "parsed-once://"


@lru_cache(maxsize=1024)
def parsed(provider: str, module: str, option: str, modified: int, size: int) -> bytes:
    """Return a parsed file pickled: Hydra changes it, and unpickling copies fast.

    modified: time in ns; with the size it distinguishes edited files.
    """
    return pickle.dumps(ImportlibResourcesConfigSource(provider, HYDRAS + module).load_config(option))


class ParsedOnce(ImportlibResourcesConfigSource):
    """Configuration in an importable package; a composition needs some twenty files of hundreds."""

    @staticmethod
    def scheme() -> str:
        return OURS.removesuffix("://")

    def load_config(self, config_path: str) -> ConfigResult:
        file = resources.files(self.path) / self._normalize_file_name(config_path)
        if not (isinstance(file, Path) and file.is_file()):  # in an archive, or absent
            return super().load_config(config_path)
        state = file.stat()
        return pickle.loads(parsed(self.provider, self.path, config_path, state.st_mtime_ns, state.st_size))


class GsxSearchPath(SearchPathPlugin):
    """Search path of a session: packages parsed once; those of gsx's plugins come last."""

    extra: tuple[str, ...] = ()
    """Search paths of gsx's plugins."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for path in self.extra:
            search_path.append(provider="gsx", path=path)
        for element in search_path.get_path():
            element.path = element.path.replace(HYDRAS, OURS, 1) if element.path.startswith(HYDRAS) else element.path


def register(extra: Sequence[str]) -> None:
    """Add search paths to all later sessions of Hydra."""
    GsxSearchPath.extra = tuple(extra)
    for plugin in (ParsedOnce, GsxSearchPath):
        Plugins.instance().register(plugin)
