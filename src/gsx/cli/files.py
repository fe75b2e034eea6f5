"""gsx export and gsx compact."""

import logging
import sys
from argparse import Namespace
from pathlib import Path

from gsx.builtin import plugins
from gsx.core.errors import InputError
from gsx.core.files import remove_partial
from gsx.experiments.compact.compact import compact
from gsx.experiments.reports.report import write_report
from gsx.experiments.runs.export import convert, evaluation_views, export, is_page, losses, refuse_export
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.render_views import view_named
from gsx.formats.axis_names import AUTO
from gsx.formats.splat_files import SpzForm
from gsx.formats.suffixes import META, splat_file_at, suffix_of

logger = logging.getLogger("gsx.cli")


def compact_model(options: Namespace) -> int:
    """Shrink a model and print the page that compares both."""
    file = splat_file_at(options.target)
    to = options.to or compact_folder(file.resolve())
    page = compact(file, to, options.max_drop_db, options.steps, options.overrides, plugins())
    sys.stdout.write(f"{page}\n")
    return 0


def compact_folder(target: Path) -> Path:
    """Return the new folder next to a run or a splat file, named after it."""
    place = target.parent if target.name.lower() == META else target
    return place.with_name(f"{place.name.split('.')[0] if place.is_file() else place.name}_compact")


def export_file(options: Namespace) -> int:
    """Export a run, or convert a splat file, and print the file written."""
    spz = SpzForm(version=options.spz_version, axes=options.axes)
    refuse_export(options.file or Path("point_cloud.ply"), spz)
    source = splat_file_at(options.run)
    is_file = bool(suffix_of(source)) and not source.is_dir()
    sys.stdout.write(f"{convert_file(source, options, spz) if is_file else export_run(options, spz)}\n")
    return 0


def export_run(options: Namespace, spz: SpzForm) -> Path:
    """Write the model of a run as a splat file or a page, compare it with the model, and return its path.

    Raises:
        InputError: an option is for splat files only, or the format cannot hold the model.
    """
    if options.from_axes != AUTO:
        raise InputError(
            f"gsx export: --from-axes {options.from_axes} is for splat files, {options.run} is a run: leave it out"
        )
    run, settings = open_run(options.run, plugins())
    view = view_named(run, options.view) if options.view else None
    stem = "point_cloud_of_view" if view else "point_cloud_baked" if options.bake else "point_cloud"
    path: Path = options.file or options.run / f"{stem}.ply"
    remove_partial(path.parent, below=False)
    if options.local and not any(run.scene.origin):
        logger.info("--local changes nothing: scene %s has no origin of its own", run.scene.name)
    written = export(run, path, view.camera if view else None, spz, options.bake, options.local)
    if written:
        views = [view] if view else evaluation_views(run.scene)
        for line in losses(run, settings, path, views, written, spz, options.local):
            logger.info("read back and rendered: %s", line)
    if is_page(path) and path.parent.resolve() == options.run.resolve():
        write_report(options.run)  # it links to its pages
    return path


def convert_file(source: Path, options: Namespace, spz: SpzForm) -> Path:
    """Write the splats of a file in another format and return its path; raise InputError for options of runs."""
    if options.file is None:
        raise InputError(f"gsx export {source}: name the file to write as well, for example model.ply")
    if options.view or options.bake:
        raise InputError(f"gsx export: --view and --bake are for runs, {source} is a splat file: leave them out")
    convert(source, options.file, options.from_axes, spz, options.local)
    return Path(options.file)
