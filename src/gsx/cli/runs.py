"""Verbs on a finished run or a splat file: eval, photographs, render, view."""

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
from gsx.experiments.runs import job
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import evaluate_again
from gsx.experiments.runs.open import open_run
from gsx.experiments.runs.photo_check import check_photos, summary_lines
from gsx.experiments.runs.render_views import file_pictures, render_orbit, render_path, render_test_views, run_pictures
from gsx.experiments.runs.start_file import composition_of
from gsx.experiments.runs.view import view_file, view_run
from gsx.experiments.viewer.camera_path import read_camera_path
from gsx.formats.suffixes import splat_file_at, suffix_of

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
