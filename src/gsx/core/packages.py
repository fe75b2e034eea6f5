"""Optional packages."""

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec

from gsx.core.errors import ConfigError, first_line


def require(what: str, packages: Sequence[str], extra: str) -> None:
    """Raises ConfigError, with the pip command for `extra`, if a package is missing or cannot be imported."""
    missing = [package for package in packages if find_spec(package.partition(".")[0]) is None]
    if missing:
        raise ConfigError(f"{what} needs {', '.join(missing)}: pip install '{extra}'")
    for package in packages:
        try:
            import_module(package)
        except ImportError as error:
            raise ConfigError(f"{what} needs {package} ({first_line(error)}): pip install '{extra}'") from error
