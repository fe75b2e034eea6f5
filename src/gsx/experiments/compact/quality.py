"""PSNR of a run and of its splat files on some training views, at several zooms."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory

import torch

from gsx.core.data.scene import View
from gsx.core.errors import ConfigError, InputError, first_line
from gsx.core.gaussians.splats import Gaussians, splats_of
from gsx.core.quality.metrics import psnr
from gsx.core.training.importance import ROUNDING
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.runs.export import export, own_columns, read_again

logger = logging.getLogger(__name__)

QUANTISED = (".sog", ".compressed.ply", ".spz")
"""Suffixes of files with quantised values."""


@torch.no_grad()
def zoomed_psnr(
    run: Run, views: Sequence[View], zooms: Sequence[float], gaussians: Gaussians | None = None
) -> dict[str, float]:
    """Returns mean PSNR over views by zoom, dB; zooms without truth are left out. `gaussians` replace the model."""

    def level(view: View) -> float:
        """Compares a render at the exposure of its photo with that photo."""
        splats = None if gaussians is None else splats_of(gaussians, view.camera.centre)
        image = run.as_photo(render(run, view.camera, splats=splats).image, view).clamp(0, 1).cpu()
        return above_rounding(psnr(image, view.image(), view.counted()))

    out = {}
    for factor in zooms:
        closer = [zoomed for view in views if (zoomed := view.zoom(factor)) is not None]
        if closer:
            out[f"{factor:g}"] = fmean(map(level, closer))
    return out


def above_rounding(decibels: float) -> float:
    """Adds the rounding of photos to 8 bits to the squared error of a PSNR: 58.9 dB at most."""
    return -10 * math.log10(10 ** (-decibels / 10) + ROUNDING)


@dataclass(frozen=True)
class File:
    """A splat file of a model."""

    bytes: int
    lost: float
    """Largest PSNR that the file loses of the model at any zoom, dB."""


def write_files(
    run: Run, views: Sequence[View], before: Mapping[str, float], folder: Path, suffixes: Sequence[str]
) -> dict[str, File]:
    """Writes files of a model by suffix, without those that cannot hold it; `before`: PSNR of the model by zoom."""
    out = dict[str, File]()
    for suffix in suffixes:
        path = folder / f"point_cloud{suffix}"
        try:
            export(run, path)
            again = read_again(path, origin=run.scene.origin)
            after = zoomed_psnr(run, views, [float(zoom) for zoom in before], again)
            out[suffix] = File(path.stat().st_size, max(before[zoom] - after[zoom] for zoom in before))
        except (ConfigError, InputError) as error:  # a package is missing, or a value is beyond what it holds
            path.unlink(missing_ok=True)
            logger.info("no %s: %s", suffix, first_line(error))
    return out


def least_file_loss(run: Run, views: Sequence[View], before: Mapping[str, float]) -> float:
    """Returns the least PSNR that a quantised file loses of a model, dB; 0 for a model without a standard form."""
    if own_columns(run) is not None:
        return 0.0
    with TemporaryDirectory() as scratch:
        files = write_files(run, views, before, Path(scratch), QUANTISED)
    return max(0.0, min((file.lost for file in files.values()), default=0.0))
