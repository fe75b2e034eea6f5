"""Optional packages: there, or an error with the remedy."""

from collections.abc import Sequence
from importlib import import_module

from gsx.core.errors import ConfigError, first_line


def require(what: str, packages: Sequence[str], extra: str) -> None:
    """Raise ConfigError if a package cannot be imported; `extra`: what pip is to install."""
    for package in packages:
        try:
            import_module(package)
        except ImportError as error:
            remedy = f"pip install '{extra}'"
            raise ConfigError(f"{what} needs {package} ({first_line(error)}): {remedy}") from error
