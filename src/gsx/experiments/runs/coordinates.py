"""Coordinates of splat files far from (0, 0, 0): which are written, and what that costs."""

import logging
from pathlib import Path

import torch

from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.formats.origin import NO_ORIGIN, Origin, away, comment_of, in_words, rounding_at
from gsx.formats.spz import FURTHEST
from gsx.formats.suffixes import STANDARD, suffix_of

logger = logging.getLogger(__name__)

COMMENTED = (STANDARD, ".compressed.ply", ".glb", "")
"""Suffixes of files that hold comments; empty: of pages, which do."""


def placement(origin: Origin, local: bool) -> tuple[Origin, list[str]]:
    """Returns (what is added to positions of a file, comments): the origin, or its statement in a `local` file."""
    if not any(origin):
        return NO_ORIGIN, []
    return (NO_ORIGIN, [comment_of(origin)]) if local else (origin, [])


def refuse_too_far(path: Path, gaussians: Gaussians, origin: Origin) -> None:
    """Raises InputError for SPZ where it cannot hold coordinates, with the remedies that exports have."""
    if not any(origin) or suffix_of(path) != ".spz" or not len(gaussians.means):
        return
    furthest = float(away(gaussians, origin).means.abs().max())
    if furthest > FURTHEST:
        raise InputError(
            f"{path} is not written: SPZ holds coordinates up to {FURTHEST:,.0f}, the scene's reach {furthest:,.0f}. "
            f"Add --local for positions relative to {in_words(origin)}, or export .ply or .glb, which hold them exactly"
        )


def log_coordinates(path: Path, origin: Origin, local: bool, gaussians: Gaussians | None = None) -> None:
    """Logs in which coordinates the file of a scene far from (0, 0, 0) is, and what that costs."""
    if not any(origin):
        return
    suffix, middle = suffix_of(path), in_words(origin)
    step = rounding_at(torch.tensor([origin]))
    scales = "" if gaussians is None else f" ({step / median_scale(gaussians):.2g} x the median scale of splats)"
    steps, remedy = f"steps of {step:.2g} units{scales}", f"--local writes them relative to {middle}"
    if local:
        states = "as its comment states" if suffix in COMMENTED else f"which {suffix} has no place to state"
        message = f"positions are relative to {middle}, {states}"
    elif suffix == ".glb":
        message = f"positions are the scene's own: floats, to which the node adds {middle} exactly"
    elif suffix == ".compressed.ply":
        message = f"positions are the scene's own; ends of chunks are floats, rounded to {steps}: {remedy}"
    else:
        message = f"positions are the scene's own; programs that read floats alone round them to {steps}: {remedy}"
    logger.info("%s: %s", path, message)


def median_scale(gaussians: Gaussians) -> float:
    """Returns the median standard deviation of Gaussians along their axes, scene units."""
    return float(gaussians.log_scales.median().exp()) if len(gaussians.means) else 1.0
