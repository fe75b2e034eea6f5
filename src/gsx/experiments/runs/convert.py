"""`gsx export FILE OTHER`: the splats of a file as a file of another kind."""

import logging
from pathlib import Path

from gsx import __version__
from gsx.core.errors import InputError
from gsx.experiments.runs.coordinates import log_coordinates, placement, refuse_too_far
from gsx.experiments.runs.export import SPZ_FORM, log_axes_written, read_again
from gsx.formats.axis_names import AUTO
from gsx.formats.splat_files import SpzForm, compensated, read_around, write_gaussians
from gsx.formats.suffixes import refuse_suffix

logger = logging.getLogger(__name__)


def convert(source: Path, to: Path, axes: str = AUTO, spz: SpzForm = SPZ_FORM, local: bool = False) -> None:
    """Writes the splats of a file as the kind that the other name says, with its mark for compensated opacities.

    axes: of the file that is read; spz: form of a .spz that is written; local: positions relative to an origin, where
    they are far from (0, 0, 0).

    Raises:
        InputError: one of them cannot be read or written, or both are the same file.
    """
    refuse_suffix(to)
    if to.resolve() == source.resolve():
        raise InputError(f"{to} is the file to read: name another to write")
    (gaussians, origin), mip = read_around(source, axes), compensated(source)
    if not len(gaussians.means):
        raise InputError(f"{source} holds no splats: choose another file")
    comments = [f"gsx {__version__}, from {source.name}", f"SplatRenderMode: {'mip' if mip else 'default'}"]
    added, stated = placement(origin, local)
    refuse_too_far(to, gaussians, added)
    write_gaussians(to, gaussians, [*comments, *stated], mip, spz, added)
    if local and not any(origin):
        logger.info("--local changes nothing: the positions of %s are near (0, 0, 0)", source)
    log_axes_written(to, spz)
    log_coordinates(to, origin, local, gaussians)
    written = len(read_again(to, spz).means)
    logger.info("%s: %d splats read, %d written, %.2f MB", to, len(gaussians.means), written, to.stat().st_size / 1e6)
