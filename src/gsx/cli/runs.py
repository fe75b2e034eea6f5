"""Verbs on a finished run: eval, render, export."""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from gsx.builtin import plugins
from gsx.cli.arguments import Parser, positive, run_arguments
from gsx.cli.train import tell_report
from gsx.core.errors import InputError
from gsx.core.gaussians.suffixes import suffix_of
from gsx.experiments.runs.job import train

logger = logging.getLogger("gsx.cli")


def verb_eval(arguments: list[str]) -> int:
    """gsx eval RUN|FILE [KEY=VALUE ...]"""
    told = (
        "Evaluate a run again, for example with 'eval.zoom=[1,2,4]', drawn by the path that trained it; or a splat "
        "file of any program on a scene, in a run folder of its own: gsx eval FILE scene=colmap scene.path=FOLDER"
    )
    folder, overrides = run_arguments("eval", arguments, told)
    if suffix_of(folder) and not folder.is_dir():
        return evaluate_file(folder, overrides)
    from gsx.experiments.runs.again import evaluate_again

    evaluate_again(folder, plugins(), overrides)
    sys.stdout.write(f"{folder / 'report.html'}\n")
    return 0


def evaluate_file(path: Path, overrides: Sequence[str]) -> int:
    """gsx eval FILE scene=... [KEY=VALUE ...]"""
    from gsx.experiments.runs.compose import compose
    from gsx.experiments.runs.start_file import composition_of

    folders: list[Path] = []
    code = train(compose(composition_of(path, overrides), loaded := plugins()), loaded, folders)
    return tell_report(code, *folders)


def verb_render(arguments: list[str]) -> int:
    """gsx render RUN [--orbit FILE] ..."""
    parser = argparse.ArgumentParser(prog="gsx render", description="Render test views, or an orbit as an animation.")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--orbit", type=Path, metavar="FILE", help="animate a closed orbit: .gif, .webp or .mp4")
    parser.add_argument("--frames", type=int, default=60, help="frames of the orbit (60)")
    parser.add_argument("--fps", type=float, default=20, help="frames per second (20)")
    parser.add_argument("--zoom", type=float, default=1, help="times the training resolution (1)")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="folder for test views (RUN/renders/test)")
    given = parser.parse_args(arguments)
    if given.zoom <= 0 or given.frames < 1:
        raise InputError(f"gsx render got --zoom {given.zoom:g} and --frames {given.frames}: both must be positive")
    from gsx.experiments.runs.open import open_run
    from gsx.experiments.runs.render import render_orbit, render_test_views

    run, settings = open_run(given.run, plugins())
    if given.orbit:
        render_orbit(run, settings, given.orbit, given.frames, given.fps, given.zoom)
        sys.stdout.write(f"{given.orbit}\n")
    else:
        folder = given.to or given.run / "renders" / "test"
        render_test_views(run, settings, folder, given.zoom)
        sys.stdout.write(f"{folder}\n")
    return 0


def verb_export(arguments: list[str]) -> int:
    """gsx export RUN [FILE] [--view NAME] [--bake ZOOM] [--axes rub|rdf]"""
    told = (
        "Write a splat file, read back and compared; its suffix says which: .ply, .compressed.ply, .spz, .glb; or "
        ".html, one page with a viewer in it that opens from disk."
    )
    parser = Parser(prog="gsx export", description=told)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("file", type=Path, nargs="?", help="splat file to write (RUN/point_cloud.ply)")
    parser.add_argument("--view", metavar="NAME", help="only what is drawn for this view, as a standard splat file")
    parser.add_argument(
        "--bake",
        type=positive(float),
        metavar="ZOOM",
        default=0.0,
        help="one standard file for all "
        "views of a model that decodes splats for each, as cameras see it at ZOOM times their resolution",
    )
    parser.add_argument("--axes", choices=("rub", "rdf"), default="rub", help="of .spz: the specification's (rub), "
                        "or as trained, which Niantic's converter and SuperSplat have (rdf)")  # fmt: skip
    given = parser.parse_args(arguments)
    from gsx.core.files import remove_partial
    from gsx.experiments.runs.export import export, losses, refuse_export
    from gsx.experiments.runs.open import open_run
    from gsx.experiments.runs.render import view_named

    if given.file:
        refuse_export(given.file)
    run, settings = open_run(given.run, plugins())
    view = view_named(run, given.view) if given.view else None
    path = given.file or given.run / ("point_cloud.ply" if view is None else "point_cloud_of_view.ply")
    remove_partial(path.parent, below=False)
    written = export(run, path, view.camera if view else None, given.axes, given.bake)
    if written:
        views = [view] if view else run.scene.test
        for line in losses(run, settings, path, views, written, given.axes):
            logger.info("read back and rendered again: %s", line)
    sys.stdout.write(f"{path}\n")
    return 0
