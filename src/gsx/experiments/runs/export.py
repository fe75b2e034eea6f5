"""Splat files of a run or of another file, and pages that show one."""

import logging
from collections.abc import Iterator, Sequence
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
"""Suffix of a page with a viewer and the model in it."""
PAGE_VIEWS = 6
"""Test views that a page offers; it starts at the first."""
LOSS_VIEWS = 5
"""Views that losses are measured on."""
SPZ_FORM = SpzForm()

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class Exported:
    """Content of a standard splat file."""

    gaussians: Gaussians
    baked: bool
    """True: the model has other Gaussians for every camera."""


def export(
    run: Run, path: Path, camera: Camera | None = None, spz: SpzForm = SPZ_FORM, zoom: float = 0, local: bool = False
) -> Exported | None:
    """Write the backbone's own splat file, a standard one, or a page; return the content of a standard one.

    camera: write only its splats. Without it a model without a standard form is baked. zoom above 0: bake in any case,
    for cameras at so many times their resolution. local: positions relative to the scene's origin.

    Raises:
        InputError: the format cannot hold the splats, or the model cannot be baked.
    """
    columns = own_columns(run) if camera is None else None
    if columns is not None and suffix_of(path) == STANDARD and not zoom:
        origin, stated = placement(run.scene.origin, local)
        write_columns(path, columns, [*notes(run), *stated], origin)
        log_coordinates(path, run.scene.origin, local)
        return None
    explicit = None if columns is not None or zoom > 0 else explicit_of(run, camera)
    baked = explicit is None
    gaussians = bake(run, zoom or 1.0) if explicit is None else explicit
    gaussians = Gaussians(**{name: value.detach().cpu() for name, value in vars(gaussians).items()})
    averaged = [f"splats averaged over training cameras at {zoom or 1:g} times their resolution"] if baked else []
    write_model(run, gaussians, path, averaged, spz, local)
    return Exported(gaussians=gaussians, baked=baked)


def write_model(
    run: Run, gaussians: Gaussians, path: Path, remarks: Sequence[str], spz: SpzForm = SPZ_FORM, local: bool = False
) -> None:
    """Write splats with the rules and the scene of a run as a standard splat file or a page.

    Raises:
        InputError: the format cannot hold the splats.
    """
    origin, stated = placement(run.scene.origin, local or is_page(path))
    comments = [*notes(run), *stated, mode_note(run.raster.compensate), *remarks]
    if is_page(path):
        up = upright(torch.stack([view.camera.rotation for view in run.scene.train]).double())
        views, background = evaluation_views(run.scene)[:PAGE_VIEWS], run.scene.background.tolist()
        page = viewer_page(gaussians, views, up, background, f"{run.scene.name}, gsx", comments)
        write_whole(path, page.encode())
    else:
        refuse_too_far(path, gaussians, origin)
        write_gaussians(path, gaussians, comments, run.raster.compensate, spz, origin)
        log_axes_written(path, spz)
    log_coordinates(path, run.scene.origin, local or is_page(path), gaussians)


def log_axes_written(path: Path, spz: SpzForm) -> None:
    """Log the axes of a .spz file, as readers differ in them."""
    if suffix_of(path) == ".spz":
        states = "which it states" if spz.version > 3 else "which version 3 cannot state"
        logger.info("%s: SPZ version %d, axes %s, %s", path, spz.version, spz.axes, states)


def read_again(path: Path, spz: SpzForm = SPZ_FORM, origin: Origin = NO_ORIGIN) -> Gaussians:
    """Read a file of `export` relative to an origin."""
    return around(read_splats(path, spz.axes if suffix_of(path) == ".spz" else AUTO).gaussians, origin)


def explicit_of(run: Run, camera: Camera | None) -> Gaussians | None:
    """Return the splats of a backbone; None: they differ between cameras and can be baked; raise GsxError otherwise."""
    try:
        return run.backbone.explicit(camera, run.model_step)
    except GsxError:
        if camera is None and isinstance(run.backbone, Bakeable):
            return None
        raise


def own_columns(run: Run) -> dict[str, Float[Tensor, "N"]] | None:
    """Return the columns that the published code of the backbone writes; None: the standard ones."""
    return run.backbone.file_columns() if isinstance(run.backbone, WithOwnFile) else None


def is_page(path: Path) -> bool:
    """Return True for the name of a page."""
    return path.suffix.lower() == PAGE


def refuse_export(path: Path, spz: SpzForm = SPZ_FORM) -> None:
    """Raise InputError for a format that is not written, and for options of .spz with another format."""
    if not is_page(path):
        refuse_suffix(path, (PAGE,))
    if spz != SPZ_FORM and suffix_of(path) != ".spz":
        raise InputError(f"axes and SPZ version are for .spz files, not for {path}: leave them out, or write model.spz")


def evaluation_views(scene: Scene) -> Sequence[View]:
    """Return the test views of a scene, or its training views if none is held out."""
    return scene.test or scene.train


def notes(run: Run) -> list[str]:
    """Return comments for viewers: source, screen dilation, zoom rules, units."""
    file_notes = run.backbone.file_notes() if isinstance(run.backbone, WithOwnFile) else ()
    times, reduction = run.views.raster_scale(run.model_step), run.scene.reduction.filter
    finer = f"trained through renders {times} times as fine, reduced by the {reduction} filter"
    return [
        f"gsx {__version__}, step {run.step}, scene {run.scene.name}, in its units times {unit_of(run):g}",
        f"screen dilation {run.raster.dilation} px^2, {'with' if run.raster.compensate else 'no'} opacity compensation",
        *([f"trained around {in_words(run.scene.origin)}"] if any(run.scene.origin) else []),
        *zoomed_note(run.raster),
        *([finer] if times > 1 else []),
        *file_notes,
        "quaternions w x y z; scales ln; opacity logit; f_rest channel-major",
    ]


def mode_note(compensated: bool) -> str:
    """Return the comment that Brush and SuperSplat read: `mip` compensates opacities for screen dilation."""
    return f"SplatRenderMode: {'mip' if compensated else 'default'}"


def zoomed_note(raster: RasterSettings) -> list[str]:
    """Return the rule for cameras k times as fine as those of training, if it differs."""
    finer = f"at k times the focal length of {raster.training_focal:.6g} px: dilation"
    if raster.zoomed == "magnified":
        return [f"{finer} {raster.dilation} k^2 px^2 for k > 1"]
    if raster.zoomed == "resampled":
        opacity = f"opacity x sqrt(|S + {raster.dilation} k^2 I| / |S + dilation I|), at most {raster.alpha_max}"
        return [f"{finer} {raster.dilation - PIXEL_VARIANCE:.6g} k^2 + {PIXEL_VARIANCE} px^2, {opacity}"]
    return []


def losses(
    run: Run,
    settings: Settings,
    path: Path,
    views: Sequence[View],
    written: Exported,
    spz: SpzForm = SPZ_FORM,
    local: bool = False,
) -> list[str]:
    """Report the loss by the file format and by baking, as PSNR of renders."""
    views, inside = views[:LOSS_VIEWS], written.gaussians
    stated = local and suffix_of(path) in COMMENTED
    origin = NO_ORIGIN if local and not stated else run.scene.origin
    again = as_in_page(inside) if is_page(path) else read_again(path, spz, origin)

    def pictures(gaussians: Gaussians) -> list[Float[Tensor, "3 H W"]]:
        pixels = settings.evaluation.tile_pixels
        return [render(run, v.camera, pixels, splats=splats_of(gaussians, v.camera.centre)).image for v in views]

    own = [render(run, view.camera, settings.evaluation.tile_pixels).image for view in views]
    read, before = pictures(again), pictures(inside) if written.baked else own
    worst = min(levels(read, before))
    lines = [f"{worst:.1f} dB at worst over {len(views)} views (inf: identical), {path.stat().st_size / 1e6:,.2f} MB"]
    if written.baked:
        truth = [view.image().to(own[0]) for view in views]
        alike, model, baked = (fmean(levels(a, b)) for a, b in ((before, own), (own, truth), (before, truth)))
        lines.append(
            f"baked for all views: {alike:.1f} dB against the model; {baked:.2f} dB against photos, the model has "
            f"{model:.2f} dB: {model - baked:.2f} dB lost"
        )
    return lines


def levels(pictures: Sequence[Float[Tensor, "3 H W"]], others: Sequence[Float[Tensor, "3 H W"]]) -> Iterator[float]:
    """Yield the PSNR of each pair."""
    return (psnr(a, b) for a, b in zip(pictures, others, strict=True))


def as_in_page(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians after the compression of a page."""
    return gaussians_from(decode_compressed_ply(encode_compressed_ply(arrays_of(gaussians), ())))


def convert(source: Path, to: Path, axes: str = AUTO, spz: SpzForm = SPZ_FORM, local: bool = False) -> None:
    """Write the splats of a file in the format of another suffix, with its mark for compensated opacities.

    axes: of `source`. spz: form of a .spz `to`. local: relative to an origin if positions are far from (0, 0, 0).

    Raises:
        InputError: one of them cannot be read or written, or both are the same file.
    """
    refuse_suffix(to)
    if to.resolve() == source.resolve():
        raise InputError(f"{to} is the file to read: name another to write")
    (gaussians, origin), mip = read_around(source, axes), compensated(source)
    if not len(gaussians.means):
        raise InputError(f"{source} holds no splats: choose another file")
    comments = [f"gsx {__version__}, from {source.name}", mode_note(mip)]
    added, stated = placement(origin, local)
    refuse_too_far(to, gaussians, added)
    write_gaussians(to, gaussians, [*comments, *stated], mip, spz, added)
    if local and not any(origin):
        logger.info("--local changes nothing: the positions of %s are near (0, 0, 0)", source)
    log_axes_written(to, spz)
    log_coordinates(to, origin, local, gaussians)
    written = len(read_again(to, spz).means)
    logger.info("%s: %d splats read, %d written, %.2f MB", to, len(gaussians.means), written, to.stat().st_size / 1e6)


COMMENTED = (STANDARD, ".compressed.ply", ".glb", "")
"""Suffixes of files with comments; empty: a page."""


def placement(origin: Origin, local: bool) -> tuple[Origin, list[str]]:
    """Return (offset of a file's positions, comments): the origin, or a comment with it in a `local` file."""
    if not any(origin):
        return NO_ORIGIN, []
    return (NO_ORIGIN, [comment_of(origin)]) if local else (origin, [])


def refuse_too_far(path: Path, gaussians: Gaussians, origin: Origin) -> None:
    """Raise InputError for SPZ with coordinates beyond its range."""
    if not any(origin) or suffix_of(path) != ".spz" or not len(gaussians.means):
        return
    furthest = float(away(gaussians, origin).means.abs().max())
    if furthest > FURTHEST:
        raise InputError(
            f"{path} is not written: SPZ holds coordinates up to {FURTHEST:,.0f}, the scene's reach {furthest:,.0f}. "
            f"Add --local for positions relative to {in_words(origin)}, or export .ply or .glb, which hold them exactly"
        )


def log_coordinates(path: Path, origin: Origin, local: bool, gaussians: Gaussians | None = None) -> None:
    """Log the coordinates of a file of a scene far from (0, 0, 0), and their rounding."""
    if not any(origin):
        return
    suffix, middle = suffix_of(path), in_words(origin)
    step = rounding_at(torch.tensor([origin]))
    scales = ""
    if gaussians is not None and len(gaussians.means):
        scales = f" ({step / float(gaussians.log_scales.median().exp()):.2g} x the median scale of splats)"
    steps, remedy = f"steps of {step:.2g} units{scales}", f"--local writes them relative to {middle}"
    if local:
        states = "as its comment states" if suffix in COMMENTED else f"which {suffix} has no place to state"
        message = f"positions are relative to {middle}, {states}"
    elif suffix == ".glb":
        message = f"positions are the scene's own: floats, to which the node adds {middle} exactly"
    elif suffix == ".compressed.ply":
        message = f"positions are the scene's own; ends of chunks are floats, rounded to {steps}: {remedy}"
    else:
        message = f"positions are the scene's own; programs that read only floats round them to {steps}: {remedy}"
    logger.info("%s: %s", path, message)
