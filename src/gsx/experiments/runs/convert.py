"""`gsx export FILE OTHER`: the splats of a file as a file of another kind."""

import logging
from pathlib import Path

from gsx import __version__
from gsx.core.errors import InputError
from gsx.formats.splat_files import compensated, read_gaussians, write_gaussians
from gsx.formats.suffixes import refuse_suffix

logger = logging.getLogger(__name__)


def convert(source: Path, to: Path, axes: str = "rub") -> None:
    """Write the splats of a file as the kind that the other name says, with its mark for compensated opacities.

    axes: of a .spz that is written.

    Raises:
        InputError: one of them cannot be read or written, or both are the same file.
    """
    refuse_suffix(to)
    if to.resolve() == source.resolve():
        raise InputError(f"{to} is the file to read: name another to write")
    gaussians, mip = read_gaussians(source), compensated(source)
    if not len(gaussians.means):
        raise InputError(f"{source} holds no splats: choose another file")
    comments = [f"gsx {__version__}, from {source.name}", f"SplatRenderMode: {'mip' if mip else 'default'}"]
    write_gaussians(to, gaussians, comments, mip, axes)
    written = len(read_gaussians(to, axes).means)
    logger.info("%s: %d splats read, %d written, %.2f MB", to, len(gaussians.means), written, to.stat().st_size / 1e6)
