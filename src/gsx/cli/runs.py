"""Verbs on a finished run or a splat file: eval, photographs, render, view, export, compact."""

import logging
import sys
from argparse import Namespace
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from gsx.builtin import plugins
from gsx.cli.train import print_report
from gsx.core.errors import ConfigError, InputError
from gsx.core.files import remove_partial
from gsx.experiments.blocks.merge import merge_blocks
from gsx.experiments.compact.compact import compact
from gsx.experiments.reports.overview import runs_in
from gsx.experiments.reports.report import write_report
from gsx.experiments.runs import job
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import evaluate_again
from gsx.experiments.runs.export import convert, evaluation_views, export, is_page, losses, refuse_export
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.photo_check import check_photos, summary_lines
from gsx.experiments.runs.render_views import (
    file_pictures,
    render_orbit,
    render_path,
    render_test_views,
    run_pictures,
    view_named,
)
from gsx.experiments.runs.start_file import composition_of
from gsx.experiments.runs.view import view_file, view_run
from gsx.experiments.viewer.camera_path import read_camera_path
from gsx.formats.axis_names import AUTO
from gsx.formats.splat_files import SpzForm
from gsx.formats.suffixes import META, splat_file_at, suffix_of

logger = logging.getLogger("gsx.cli")


def evaluate(options: Namespace) -> int:
    """Evaluate a run or a splat file and print the report."""
    file = splat_file_at(options.run)
    if suffix_of(file) and not file.is_dir():
        return evaluate_file(file, options.overrides)
    evaluate_again(options.run, plugins(), options.overrides)
    return print_report(0, options.run)


def evaluate_file(path: Path, overrides: Sequence[str]) -> int:
    """Evaluate a splat file on a scene in a new run folder; raise ConfigError without test views."""
    folders: list[Path] = []
    settings = compose(composition_of(path, overrides), loaded := plugins())
    if getattr(settings.scene.options, "split", "") == "none":
        raise ConfigError(f"gsx eval {path} compares with test views: choose another split than scene.split=none")
    return print_report(job.train(settings, loaded, folders), *folders)


def check_photographs(options: Namespace) -> int:
    """Check the training photos of a run, log the worst and print the report."""
    findings = check_photos(options.run, plugins(), options.worst, options.overrides)
    for line in summary_lines(findings, options.worst):
        logger.info("%s", line)
    return print_report(0, options.run)


def render(options: Namespace) -> int:
    """Render test views, an orbit or a camera path and print the file or folder written."""
    sys.stdout.write(f"{rendered(options)}\n")
    return 0


def rendered(options: Namespace) -> Path:
    """Render what the options name; return the file or folder written."""
    way = read_camera_path(options.path) if options.path else None
    file = splat_file_at(options.target)
    if file.is_file():
        if way is None:
            raise InputError(f"gsx render {options.target}: a splat file has no views; give cameras with --path JSON")
        to = options.movie or options.to or file.parent / "path"
        draw = file_pictures(file, way.cameras(options.zoom), options.axes)
        return render_path(way, draw, to, bool(options.movie), options.zoom)
    run, settings = open_run(options.target, plugins())
    remove_partial(options.target / "renders")
    if way is not None:
        to = options.movie or options.to or options.target / "renders" / "path"
        return render_path(way, run_pictures(run, settings), to, bool(options.movie), options.zoom, options.target)
    if options.orbit:
        render_orbit(run, settings, options.orbit, options.frames, options.fps, options.zoom)
        return Path(options.orbit)
    folder: Path = options.to or options.target / "renders" / "test"
    render_test_views(run, settings, folder, options.zoom)
    return folder


def view(options: Namespace) -> int:
    """Show a run or a splat file in the browser until Ctrl-C, and print the address."""

    def announce(address: str) -> None:
        logger.info("press Ctrl-C to stop")
        sys.stdout.write(f"{address}\n")
        sys.stdout.flush()

    file = splat_file_at(options.target)
    with suppress(KeyboardInterrupt):
        if file.is_dir():
            view_run(file, plugins(), options.host, options.port, announce)
        else:
            view_file(file, options.axes, options.host, options.port, announce)
    return 0


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


def merge_runs(options: Namespace) -> int:
    """Join runs on blocks to one splat file, measure it, and print file and report."""
    words = merge_blocks(runs_in(options.folders), options.to, plugins())
    sys.stdout.write(f"{options.to}\n")
    return evaluate_file(options.to, words)
