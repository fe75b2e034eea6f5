"""gsx: experiments with 3D Gaussian Splatting and pseudo details, from the command line and from Python (`gsx.api`).

Importing this module does not import torch; the first use of `gsx.train` or `gsx.load` does.
"""

import sys
import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

# pycolmap brings its own zlib. Loaded before the system's, the two mix and the process crashes.
if "pycolmap" in sys.modules and "zlib" not in sys.modules:
    warnings.warn("pycolmap was imported before zlib, which can crash Python: import gsx first", stacklevel=2)
import zlib  # noqa: F401

if TYPE_CHECKING:
    from gsx.api import SplatFile as SplatFile
    from gsx.api import TrainedRun as TrainedRun
    from gsx.api import load as load
    from gsx.api import show_messages as show_messages
    from gsx.api import train as train
    from gsx.api import write_image as write_image

__version__ = "0.1.0"

OFFERED = ("SplatFile", "TrainedRun", "load", "show_messages", "train", "write_image")
"""Names of `gsx.api`."""


def __getattr__(name: str) -> Any:
    """Return a name of `gsx.api`."""
    if name not in OFFERED:
        raise AttributeError(f"module 'gsx' has no attribute '{name}'; it has {', '.join(OFFERED)}")
    return getattr(import_module("gsx.api"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *OFFERED})
