"""Files of configuration packages (`pkg://...`) as Hydra reads them, but each of them parsed once by a process."""

import os
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from io import StringIO
from pathlib import Path

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigLoadError, ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

HYDRAS, OURS = "pkg://", "parsed-once://"


@dataclass(frozen=True)
class Version:
    """A file as it was when it was parsed: one that has been edited since is another."""

    file: Path
    modified: int
    """ns."""
    size: int
    """Bytes."""

    @classmethod
    def of(cls, file: Path) -> "Version":
        """As it is now."""
        found = file.stat()
        return cls(file, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=1024)
def parsed(version: Version) -> tuple[bytes, dict[str, str | None]]:
    """(contents of a YAML file, what its `# @key value` header says): pickled, since Hydra changes what it is given,
    and a copy made from bytes is made three times as fast."""
    text = version.file.read_text(encoding="utf-8")
    return pickle.dumps(OmegaConf.load(StringIO(text))), ConfigSource._get_header_dict(text)


class ParsedOnce(ConfigSource):
    """Configuration in a folder of an importable package; a composition asks for some twenty files of hundreds."""

    @staticmethod
    def scheme() -> str:
        """What its search paths begin with."""
        return OURS.removesuffix("://")

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        self.root = Path(str(resources.files(self.path)))

    def file(self, name: str) -> Path:
        """The file of an option, `GROUP/NAME`."""
        return self.root / (name if name.endswith(".yaml") else f"{name}.yaml")

    def available(self) -> bool:
        """Whether there is such a folder."""
        return self.root.is_dir()

    def is_group(self, config_path: str) -> bool:
        """Whether it is a folder of options."""
        return (self.root / config_path).is_dir()

    def is_config(self, config_path: str) -> bool:
        """Whether it is an option."""
        return self.file(config_path).is_file()

    def load_config(self, config_path: str) -> ConfigResult:
        """An option.

        Raises:
            ConfigLoadError: there is none of that name.
        """
        try:
            config, header = parsed(Version.of(self.file(config_path)))
        except FileNotFoundError as error:
            raise ConfigLoadError(f"no configuration file {config_path} in {self.path}") from error
        return ConfigResult(self.provider, self.full_path(), pickle.loads(config), dict(header))

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Names of groups and options below a group."""
        entries = [entry for entry in os.scandir(self.root / config_path) if entry.name != "__pycache__"]
        groups = [entry.name for entry in entries if entry.is_dir()]
        options = [entry.name.removesuffix(".yaml") for entry in entries if entry.name.endswith(".yaml")]
        chosen = {ObjectType.GROUP: groups, ObjectType.CONFIG: options}
        return sorted({*groups, *options} if results_filter is None else set(chosen[results_filter]))


class GsxSearchPath(SearchPathPlugin):
    """The search path of a session: packages parsed once, and those of gsx's plugins behind the others."""

    extra: tuple[str, ...] = ()
    """Of gsx's plugins."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Hydra's hook."""
        for path in self.extra:
            search_path.append(provider="gsx", path=path)
        for element in search_path.get_path():
            element.path = parsed_once(element.path)


def parsed_once(path: str) -> str:
    """The search path to take in place of one of a package in a folder; others are Hydra's, also those in archives."""
    if not path.startswith(HYDRAS):
        return path
    module = path.removeprefix(HYDRAS).replace("/", ".").rstrip(".")
    try:
        return OURS + module if Path(str(resources.files(module))).is_dir() else path
    except (ModuleNotFoundError, TypeError, ValueError):
        return path


def register(extra: Sequence[str]) -> None:
    """Let Hydra search these paths, too, from now on."""
    GsxSearchPath.extra = tuple(extra)
    for plugin in (ParsedOnce, GsxSearchPath):
        Plugins.instance().register(plugin)
