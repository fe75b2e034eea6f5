"""Images that are expensive to compute, cached between runs."""

import functools
import logging
from pathlib import Path

from torch import Tensor

from gsx.core.data.images import read_image, write_image
from gsx.core.errors import InputError
from gsx.core.shapes import Float, UInt8
from gsx.engine.cache import add_to_manifest, is_intact, make_folder

logger = logging.getLogger(__name__)


def read_cached_image(path: Path) -> UInt8[Tensor, "C H W"] | None:
    """Reads an image as `cache_image` left it; None if it is missing or damaged."""
    if not is_intact(path):
        return None
    try:
        return read_image(path)
    except InputError as error:
        logger.warning("%s Computing it again.", error)
        return None


def cache_image(path: Path, image: UInt8[Tensor, "C H W"] | Float[Tensor, "C H W"]) -> None:
    """Writes an image to the cache as PNG; warns if that fails."""
    try:
        make_folder(path.parent)
        write_image(path, image)
        add_to_manifest(path)
    except (OSError, InputError) as error:
        warn_once(str(error).rstrip("."))


@functools.lru_cache(maxsize=16)
def warn_once(problem: str) -> None:
    """Warns once of a problem with the cache."""
    logger.warning("%s; images are computed again next time", problem)
