"""Verbs on a finished run: eval, photographs, render, export."""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gsx.builtin import plugins
from gsx.cli.arguments import Parser, positive, refuse_beyond, run_arguments, whole
from gsx.cli.train import print_report
from gsx.core.errors import ConfigError, InputError
from gsx.core.ranges import ZOOMS, Range
from gsx.engine.collector import loading
from gsx.experiments.runs.job import train
from gsx.formats.axis_names import AUTO, CHOICES, SPECIFIED, TRAINED
from gsx.formats.suffixes import READABLE, SPZ_VERSIONS, WRITTEN, splat_file_at, suffix_of

if TYPE_CHECKING:
    from gsx.formats.splat_files import SpzForm

logger = logging.getLogger("gsx.cli")

MOST_FRAMES = 100_000
"""Of an orbit, whose cameras are held in memory."""


def verb_eval(arguments: list[str]) -> int:
    """gsx eval RUN|FILE [KEY=VALUE ...]"""
    description = (
        "Evaluate a run again, for example with 'eval.zoom=[1,2,4]', drawn by the path that trained it; or a splat "
        "file of any program on a scene, in a run folder of its own: gsx eval FILE scene=colmap scene.path=FOLDER. "
        f"FILE: {READABLE}"
    )
    folder, overrides = run_arguments("eval", arguments, description)
    file = splat_file_at(folder)
    if suffix_of(file) and not file.is_dir():
        return evaluate_file(file, overrides)
    with loading():
        from gsx.experiments.runs.execute import evaluate_again

    evaluate_again(folder, plugins(), overrides)
    sys.stdout.write(f"{folder / 'report.html'}\n")
    return 0


def evaluate_file(path: Path, overrides: Sequence[str]) -> int:
    """gsx eval FILE scene=... [KEY=VALUE ...]"""
    with loading():
        from gsx.experiments.runs.compose import compose
        from gsx.experiments.runs.start_file import composition_of

    folders: list[Path] = []
    settings = compose(composition_of(path, overrides), loaded := plugins())
    if getattr(settings.scene.options, "split", "") == "none":
        raise ConfigError(f"gsx eval {path} compares with test views: choose another split than scene.split=none")
    code = train(settings, loaded, folders)
    return print_report(code, *folders)


def verb_photographs(arguments: list[str]) -> int:
    """gsx photographs RUN [KEY=VALUE ...] [--worst N]"""
    description = (
        "What is wrong with training photographs, told from what the trained model shows in their places: exposure, "
        "pose, blur, things that only one shows. The report then shows the worst."
    )
    parser = Parser(prog="gsx photographs", description=description)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_overrides("values that take the place of the run's own")
    parser.add_argument("--worst", type=positive(int), default=10, help="photographs that are shown (10)")
    if not arguments and Path("photographs").is_dir():
        raise InputError("gsx photographs RUN judges a run's photographs: to train from that folder, gsx ./photographs")
    options = parser.parse_intermixed_args(arguments)
    with loading():
        from gsx.experiments.runs.photo_check import check_photos, lines

    findings = check_photos(options.run, plugins(), options.worst, options.overrides)
    for line in lines(findings, options.worst):
        logger.info("%s", line)
    sys.stdout.write(f"{options.run / 'report.html'}\n")
    return 0


def add_axes(parser: Parser, flag: str = "--axes") -> None:
    """Adds a flag for the axes of a splat file that is read."""
    values = (
        "of the FILE: rub (SPZ as specified), rdf (as trained), any three letters (auto: as it states, or its format)"
    )
    parser.add_argument(flag, choices=CHOICES, default=AUTO, metavar="AXES", help=values)


def refuse_axes_of_run(verb: str, options: argparse.Namespace) -> None:
    """Raises InputError for --axes of a run, whose axes are those of its scene."""
    if options.axes != AUTO and splat_file_at(options.target).is_dir():
        raise InputError(f"{verb}: --axes {options.axes} is for splat files, {options.target} is a run: leave it out")


def verb_render(arguments: list[str]) -> int:
    """gsx render RUN|FILE [--orbit FILE | --path CAMERAS.json [--movie FILE]] ..."""
    parser = Parser(prog="gsx render", description="Render test views, an orbit as an animation, or a camera path.")
    kinds = f"run folder, or, with --path, a splat file: {READABLE}"
    parser.add_argument("target", type=Path, metavar="RUN|FILE", help=kinds)
    parser.add_argument("--orbit", type=Path, metavar="FILE", help="animate a closed orbit: .gif, .webp or .mp4")
    parser.add_argument("--frames", type=int, default=60, help="frames of the orbit (60)")
    parser.add_argument("--fps", type=positive(float), default=20, help="frames per second of the orbit (20)")
    parser.add_argument("--path", type=Path, metavar="JSON", help="cameras: saved by gsx view, or nerfstudio's")
    parser.add_argument("--movie", type=Path, metavar="FILE", help="animate the path, at its own frames per second")
    parser.add_argument("--zoom", type=float, default=1, help="times the training resolution, or that of the path (1)")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="folder for pictures (RUN/renders/test, or path)")
    add_axes(parser)
    options = parser.parse_args(arguments)
    refuse_axes_of_run(parser.prog, options)
    refuse_beyond("gsx render --zoom", options.zoom, ZOOMS)
    refuse_beyond("gsx render --frames", options.frames, Range(1, MOST_FRAMES))
    refuse_beyond("gsx render --fps", options.fps, Range(0.1, 240))
    if not options.orbit and (options.frames, options.fps) != (parser.get_default("frames"), parser.get_default("fps")):
        raise InputError("gsx render: --frames and --fps go with --orbit FILE")
    if (options.movie and not options.path) or (options.orbit and options.path):
        raise InputError("gsx render: --movie FILE goes with --path JSON, --orbit FILE alone")
    if options.to and (options.movie or options.orbit):
        raise InputError("gsx render: --to FOLDER is for pictures; --movie and --orbit name their own FILE")
    sys.stdout.write(f"{rendered(options)}\n")
    return 0


def rendered(options: argparse.Namespace) -> Path:
    """Carries out `gsx render`; returns the file or folder written."""
    with loading():
        from gsx.core.files import remove_partial
        from gsx.experiments.runs.open import open_run
        from gsx.experiments.runs.render_views import (
            file_pictures,
            render_orbit,
            render_path,
            render_test_views,
            run_pictures,
        )
        from gsx.experiments.viewer.camera_path import read_camera_path

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


def verb_view(arguments: list[str]) -> int:
    """gsx view RUN|FILE [--host ADDRESS] [--port N] [--axes AXES]"""
    parser = Parser(prog="gsx view", description="Look around in a model with a browser, until Ctrl-C.")
    kinds = f"run folder, also of a run under way; splat file: {READABLE}"
    parser.add_argument("target", type=Path, metavar="RUN|FILE", help=kinds)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (127.0.0.1: this machine alone)")
    parser.add_argument("--port", type=whole, default=8080, help="port (8080); 0: any that is free")
    add_axes(parser)
    options = parser.parse_args(arguments)
    if not options.target.exists():
        raise InputError(f"'{options.target}' does not exist: give a run folder or a splat file")
    refuse_axes_of_run(parser.prog, options)
    with loading():
        from gsx.experiments.runs.view import view_file, view_run

    def announce(address: str) -> None:
        logger.info("Ctrl-C ends it")
        sys.stdout.write(f"{address}\n")
        sys.stdout.flush()

    try:
        file = splat_file_at(options.target)
        if file.is_dir():
            view_run(file, plugins(), options.host, options.port, announce)
        else:
            view_file(file, options.axes, options.host, options.port, announce)
    except KeyboardInterrupt:
        return 0
    return 0


def verb_export(arguments: list[str]) -> int:
    """gsx export RUN|FILE [TO] [--view NAME] [--bake ZOOM] [--axes rub|rdf] [--spz-version 3|4] [--from-axes AXES]
    [--local]"""
    options = export_parser().parse_args(arguments)
    with loading():
        from gsx.experiments.runs.export import refuse_export
        from gsx.formats.splat_files import SpzForm

    spz = SpzForm(version=options.spz_version, axes=options.axes)
    refuse_export(options.file or Path("point_cloud.ply"), spz)
    if options.bake:
        refuse_beyond("gsx export --bake", options.bake, ZOOMS)
    if options.view and options.bake:
        raise InputError("gsx export: --view NAME is what one view draws, --bake ZOOM a file for all: give one of them")
    source = splat_file_at(options.run)
    is_file = bool(suffix_of(source)) and not source.is_dir()
    sys.stdout.write(f"{converted(source, options, spz) if is_file else exported(options, spz)}\n")
    return 0


def export_parser() -> Parser:
    """Returns the parser of `gsx export`."""
    description = (
        f"Write a splat file, read back and compared; its suffix says which: {', '.join(WRITTEN)}; or .html, one page "
        "with a viewer in it that opens from disk. Of a splat file: the same splats in a file of another kind."
    )
    parser = Parser(prog="gsx export", description=description)
    parser.add_argument("run", type=Path, metavar="RUN|FILE", help=f"run folder, or splat file: {READABLE}")
    parser.add_argument("file", type=Path, nargs="?", metavar="TO", help="splat file to write (RUN/point_cloud.ply)")
    parser.add_argument("--view", metavar="NAME", help="only what is drawn for this view, as a standard splat file")
    parser.add_argument(
        "--bake",
        type=positive(float),
        metavar="ZOOM",
        default=0.0,
        help="one standard file for all views of a model that decodes splats for each, as cameras see it at ZOOM times "
        "their resolution",
    )
    parser.add_argument(
        "--axes",
        choices=(SPECIFIED, TRAINED),
        default=SPECIFIED,
        help="of .spz: the specification's (rub), or as trained, as SuperSplat and splat-transform have it (rdf)",
    )
    parser.add_argument(
        "--spz-version",
        type=int,
        choices=SPZ_VERSIONS,
        default=SPZ_VERSIONS[0],
        help="of .spz: 3, which more programs read, or 4, which states its axes (gsx[spz])",
    )
    add_axes(parser, "--from-axes")
    parser.add_argument("--local", action="store_true", help="of a scene far from (0, 0, 0): positions relative to the "
                        "origin that it was trained around, which the file states where it can")  # fmt: skip
    return parser


def exported(options: argparse.Namespace, spz: "SpzForm") -> Path:
    """Writes the model of a run as a splat file or a page; returns that.

    Raises:
        InputError: an option is for splat files alone, or the format cannot hold the model.
    """
    with loading():
        from gsx.core.files import remove_partial
        from gsx.experiments.reports.report import write_report
        from gsx.experiments.runs.export import evaluation_views, export, is_page, losses
        from gsx.experiments.runs.open import open_run
        from gsx.experiments.runs.render_views import view_named

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
        logger.info("--local changes nothing: %s was trained in its own coordinates", run.scene.name)
    written = export(run, path, view.camera if view else None, spz, options.bake, options.local)
    if written:
        views = [view] if view else evaluation_views(run.scene)
        for line in losses(run, settings, path, views, written, spz, options.local):
            logger.info("read back and rendered again: %s", line)
    if is_page(path) and path.parent.resolve() == options.run.resolve():
        write_report(options.run)  # it links to its pages
    return path


def converted(source: Path, options: argparse.Namespace, spz: "SpzForm") -> Path:
    """Writes the splats of a file as a file of another kind; returns that.

    Raises:
        InputError: it names no file to write, an option is for runs alone, or the file cannot be read or written.
    """
    from gsx.experiments.runs.export import convert

    if options.file is None:
        raise InputError(f"gsx export {source}: name the file to write as well, for example model.ply")
    if options.view or options.bake:
        raise InputError(f"gsx export: --view and --bake are for runs, and {source} is a splat file: leave them out")
    convert(source, options.file, options.from_axes, spz, options.local)
    return Path(options.file)
