"""Splat files of a run or of another file, and pages that show one."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from gsx import __version__
from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.core.errors import GsxError, InputError
from gsx.core.gaussians.splats import Gaussians, splats_of
from gsx.core.quality.metrics import psnr
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.settings import PIXEL_VARIANCE
from gsx.core.shapes import Float
from gsx.core.training.backbone import Bakeable, WithOwnFile
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.reports.viewer_page import viewer_page
from gsx.experiments.runs.bake import bake
from gsx.experiments.runs.load_scene import unit_of
from gsx.experiments.runs.settings import Settings
from gsx.experiments.viewer.up_direction import upright
from gsx.formats.arrays import arrays_of, gaussians_from
from gsx.formats.axis_names import AUTO
from gsx.formats.compressed_ply import decode_compressed_ply, encode_compressed_ply
from gsx.formats.origin import NO_ORIGIN, Origin, around, away, comment_of, in_words, rounding_at
from gsx.formats.ply import write_whole
from gsx.formats.splat_files import SpzForm, compensated, read_around, read_splats, write_columns, write_gaussians
from gsx.formats.spz import FURTHEST
from gsx.formats.suffixes import STANDARD, refuse_suffix, suffix_of

PAGE = ".html"
"""A page with a viewer and the model in it."""
PAGE_VIEWS = 6
"""Test views that a page has as places to go to; it starts at the first."""
LOOKED_AT = 5
"""Views by which losses are measured."""
SPZ_FORM = SpzForm()

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class Exported:
    """What was written in a standard form."""

    gaussians: Gaussians
    baked: bool
    """They stand for a model that has others for every camera."""


def export(
    run: Run, path: Path, camera: Camera | None = None, spz: SpzForm = SPZ_FORM, zoom: float = 0, local: bool = False
) -> Exported | None:
    """Writes the backbone's own splat file, or a standard one, or a page; returns what a standard one holds.

    camera: what is drawn for it alone. Without one a model that has no standard form is baked where the file is to hold
    one; `zoom` above 0: baked in any case, as cameras see it at so many times their resolution. local: positions
    relative to the scene's origin.

    Raises:
        InputError: the format cannot hold the splats, or the model cannot be baked.
    """
    columns = own_columns(run) if camera is None else None
    origin, stated = placement(run.scene.origin, local or is_page(path))
    if columns is not None and suffix_of(path) == STANDARD and not zoom:
        write_columns(path, columns, [*notes(run), *stated], origin)
        log_coordinates(path, run.scene.origin, local)
        return None
    explicit = None if columns is not None or zoom > 0 else explicit_of(run, camera)
    baked = explicit is None
    gaussians = bake(run, zoom or 1.0) if explicit is None else explicit
    gaussians = Gaussians(**{name: value.detach().cpu() for name, value in vars(gaussians).items()})
    comments = [*notes(run), *stated, f"SplatRenderMode: {render_mode(run.raster)}"]
    if baked:
        comments.append(f"splats as training cameras see them on average, at {zoom or 1:g} times their resolution")
    if is_page(path):
        write_whole(path, page_of(run, gaussians, comments).encode())
    else:
        refuse_too_far(path, gaussians, origin)
        write_gaussians(path, gaussians, comments, run.raster.compensate, spz, origin)
        log_axes_written(path, spz)
    log_coordinates(path, run.scene.origin, local or is_page(path), gaussians)
    return Exported(gaussians=gaussians, baked=baked)


def log_axes_written(path: Path, spz: SpzForm) -> None:
    """Logs the axes of a file whose reader may take it for others."""
    if suffix_of(path) == ".spz":
        states = "which it states" if spz.version > 3 else "which version 3 cannot state"
        logger.info("%s: SPZ version %d, axes %s, %s", path, spz.version, spz.axes, states)


def read_again(path: Path, spz: SpzForm = SPZ_FORM, origin: Origin = NO_ORIGIN) -> Gaussians:
    """Reads a file that was written here, relative to an origin."""
    return around(read_splats(path, spz.axes if suffix_of(path) == ".spz" else AUTO).gaussians, origin)


def explicit_of(run: Run, camera: Camera | None) -> Gaussians | None:
    """Returns the splats of a backbone as they are; None: none hold for all cameras, but some can be baked.

    Raises:
        GsxError: neither.
    """
    try:
        return run.backbone.explicit(camera, run.model_step)
    except GsxError:
        if camera is None and isinstance(run.backbone, Bakeable):
            return None
        raise


def own_columns(run: Run) -> dict[str, Float[Tensor, "N"]] | None:
    """Returns columns of the file that the published code of the backbone writes; None: the standard ones."""
    return run.backbone.file_columns() if isinstance(run.backbone, WithOwnFile) else None


def is_page(path: Path) -> bool:
    """Returns whether a name is that of a page."""
    return path.suffix.lower() == PAGE


def refuse_export(path: Path, spz: SpzForm = SPZ_FORM) -> None:
    """Raises InputError for a name whose format is not written, and for a form of .spz of another file."""
    if not is_page(path):
        refuse_suffix(path, (PAGE,))
    if spz != SPZ_FORM and suffix_of(path) != ".spz":
        raise InputError(f"axes and version are of .spz files, not of {path}: leave them out, or write model.spz")


def page_of(run: Run, gaussians: Gaussians, comments: Sequence[str]) -> str:
    """Returns a page that starts at the first test view, or training view where none is held out."""
    up = upright(torch.stack([view.camera.rotation for view in run.scene.train]).double())
    views, background = evaluation_views(run.scene)[:PAGE_VIEWS], run.scene.background.tolist()
    return viewer_page(gaussians, views, up, background, f"{run.scene.name}, gsx", comments)


def evaluation_views(scene: Scene) -> Sequence[View]:
    """Returns the test views of a scene, or its training views where none is held out."""
    return scene.test or scene.train


def notes(run: Run) -> list[str]:
    """Returns what a viewer must know of the model."""
    own = run.backbone if isinstance(run.backbone, WithOwnFile) else None
    return [
        f"gsx {__version__}, step {run.step}, scene {run.scene.name}, in its units times {unit_of(run):g}",
        f"screen dilation {run.raster.dilation} px^2, {'with' if run.raster.compensate else 'no'} opacity compensation",
        *([f"trained around {in_words(run.scene.origin)}"] if any(run.scene.origin) else []),
        *zoomed_note(run.raster),
        *supersampling_note(run),
        *(own.file_notes() if own else ()),
        "quaternions w x y z; scales ln; opacity logit; f_rest channel-major",
    ]


def zoomed_note(raster: RasterSettings) -> list[str]:
    """Returns how cameras k times as fine as those of training draw, where they differ."""
    finer = f"at k times the focal length of {raster.training_focal:.6g} px: dilation"
    if raster.zoomed == "magnified":
        return [f"{finer} {raster.dilation} k^2 px^2 for k > 1"]
    if raster.zoomed == "resampled":
        opacity = f"opacity x sqrt(|S + {raster.dilation} k^2 I| / |S + dilation I|), at most {raster.alpha_max}"
        return [f"{finer} {raster.dilation - PIXEL_VARIANCE:.6g} k^2 + {PIXEL_VARIANCE} px^2, {opacity}"]
    return []


def supersampling_note(run: Run) -> list[str]:
    """Returns through which finer pixels the model was trained, if any."""
    times = run.views.raster_scale(run.model_step)
    filter_ = run.scene.reduction.filter
    return [f"trained through renders {times} times as fine, reduced by the {filter_} filter"] if times > 1 else []


def render_mode(raster: RasterSettings) -> str:
    """Returns how viewers treat their screen dilation: `mip` compensates opacities for it, `default` does not.

    Values of the comment SplatRenderMode, which Brush writes and SuperSplat reads.
    """
    return "mip" if raster.compensate else "default"


def losses(
    run: Run,
    settings: Settings,
    path: Path,
    views: Sequence[View],
    written: Exported,
    spz: SpzForm = SPZ_FORM,
    local: bool = False,
) -> list[str]:
    """Returns what a standard file, read again, and baking have lost, in PSNR of renders of some views."""
    views, inside = views[:LOOKED_AT], written.gaussians
    stated = local and suffix_of(path) in COMMENTED
    origin = NO_ORIGIN if local and not stated else run.scene.origin
    again = as_in_page(inside) if is_page(path) else read_again(path, spz, origin)

    def pictures(gaussians: Gaussians) -> list[Float[Tensor, "3 H W"]]:
        pixels = settings.evaluation.tile_pixels
        return [render(run, v.camera, pixels, splats=splats_of(gaussians, v.camera.centre)).image for v in views]

    own = [render(run, view.camera, settings.evaluation.tile_pixels).image for view in views]
    read, before = pictures(again), pictures(inside) if written.baked else own
    worst = min(psnr(a, b) for a, b in zip(read, before, strict=True))
    lines = [f"{worst:.1f} dB at worst over {len(views)} views (inf: identical), {path.stat().st_size / 1e6:,.2f} MB"]
    if written.baked:
        truth = [view.image().to(own[0]) for view in views]
        alike, model, baked = (mean_psnr(a, b) for a, b in ((before, own), (own, truth), (before, truth)))
        lines.append(
            f"baked for all views: {alike:.1f} dB against the model; against photographs {baked:.2f} dB, where the "
            f"model has {model:.2f} dB: {model - baked:.2f} dB lost"
        )
    return lines


def mean_psnr(pictures: Sequence[Float[Tensor, "3 H W"]], others: Sequence[Float[Tensor, "3 H W"]]) -> float:
    """Returns the mean PSNR over pairs."""
    return fmean(psnr(a, b) for a, b in zip(pictures, others, strict=True))


def as_in_page(gaussians: Gaussians) -> Gaussians:
    """Returns Gaussians as a page holds them, but not turned."""
    return gaussians_from(decode_compressed_ply(encode_compressed_ply(arrays_of(gaussians), ())))


# -- of another file ---------------------------------------------------------------------------------------------------


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


# -- coordinates far from (0, 0, 0) ------------------------------------------------------------------------------------

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
