"""Splat files of a run."""

from collections.abc import Sequence
from pathlib import Path

from gsx import __version__
from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.errors import InputError
from gsx.core.gaussians.splat_files import read_gaussians, splats_of, write_columns, write_gaussians
from gsx.core.gaussians.suffixes import STANDARD, suffix_of
from gsx.core.quality.metrics import psnr
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.settings import PIXEL_VARIANCE
from gsx.core.training.backbone import WithOwnFile
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.runs.load_scene import unit_of
from gsx.experiments.runs.settings import Settings


def export(run: Run, path: Path, camera: Camera | None = None, axes: str = "rub") -> bool:
    """Write the backbone's splat file, or what it draws for one camera as a standard one; returns whether it is one.

    The comments hold the conventions that a viewer must know. axes: of SPZ.

    Raises:
        InputError: the model has no standard form, and the suffix is that of a format that holds no other; or the
            format cannot hold the splats.
    """
    own = run.backbone if isinstance(run.backbone, WithOwnFile) else None
    columns = own.file_columns() if own and camera is None else None
    if columns is not None and suffix_of(path) != STANDARD:
        raise InputError(f"{path}: this model has splats for one view alone: add --view NAME, or write a .ply")
    comments = [
        f"gsx {__version__}, step {run.step}, scene {run.scene.name}, in its units times {unit_of(run):g}",
        f"screen dilation {run.raster.dilation} px^2, {'with' if run.raster.compensate else 'no'} opacity compensation",
        *zoomed_note(run.raster),
        *supersampling_note(run),
        *(own.file_notes() if own else ()),
        *([f"SplatRenderMode: {render_mode(run.raster)}"] if columns is None else []),
        "quaternions w x y z; scales ln; opacity logit; f_rest channel-major",
    ]
    if columns is None:
        explicit = run.backbone.explicit(camera, run.model_step)
        write_gaussians(path, explicit, comments, run.raster.compensate, axes)
    else:
        write_columns(path, columns, comments)
    return columns is None


def zoomed_note(raster: RasterSettings) -> list[str]:
    """How cameras draw that are k times as fine as those of training, where they do not as those."""
    finer = f"at k times the focal length of {raster.training_focal:.6g} px: dilation"
    if raster.zoomed == "magnified":
        return [f"{finer} {raster.dilation} k^2 px^2 for k > 1"]
    if raster.zoomed == "resampled":
        opacity = f"opacity x sqrt(|S + {raster.dilation} k^2 I| / |S + dilation I|), at most {raster.alpha_max}"
        return [f"{finer} {raster.dilation - PIXEL_VARIANCE:.6g} k^2 + {PIXEL_VARIANCE} px^2, {opacity}"]
    return []


def supersampling_note(run: Run) -> list[str]:
    """How training saw the model, where that was through finer pixels."""
    times = run.supersample_at(run.model_step)
    filter_ = run.scene.reduction.filter
    return [f"trained through renders {times} times as fine, reduced by the {filter_} filter"] if times > 1 else []


def render_mode(raster: RasterSettings) -> str:
    """What viewers are to do about their screen dilation: `mip` compensates opacities for it, `default` does not.

    Values of the comment SplatRenderMode, which Brush writes and SuperSplat reads.
    """
    return "mip" if raster.compensate else "default"


def reimport_psnr(run: Run, settings: Settings, path: Path, views: Sequence[View], axes: str = "rub") -> str:
    """PSNR between the model and its exported standard file, both rendered from up to five views."""
    gaussians, pixels = read_gaussians(path, axes), settings.evaluation.tile_pixels
    figures = []
    for view in views[:5]:
        again = render(run, view.camera, pixels, splats=splats_of(gaussians, view.camera.centre))
        figures.append(psnr(again.image, render(run, view.camera, pixels).image))
    size = path.stat().st_size / 1e6
    return f"{min(figures):.1f} dB at worst over {len(figures)} views (inf: identical), {size:,.2f} MB"
