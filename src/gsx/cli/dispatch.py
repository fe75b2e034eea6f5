"""The command line: `gsx OVERRIDES...` trains; verbs do the rest. torch is imported only after the words are parsed."""

import io
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from gsx import __version__
from gsx.cli import arguments as parsers
from gsx.cli.exit_codes import discard_unwritten, report_closed_output, report_error
from gsx.cli.program_arguments import parse_methods, parse_prepare
from gsx.core.errors import ConfigError, nearest
from gsx.core.files import expand_home
from gsx.engine.collector import loading
from gsx.engine.processes import processes
from gsx.experiments.runs.logs import set_up_logging
from gsx.experiments.runs.overrides import is_override

HELP = """\
gsx trains 3D Gaussian splats from photos, zooms in, and measures how much of the detail is real.

  gsx                        train the built-in demo scene: start here, a few minutes on a laptop
  gsx FOLDER minutes=10      train from a folder: photos, COLMAP, transforms.json; or from a VIDEO
  gsx view RUN               look around in the browser (pip install 'gsx[viewer]'); RUN is the folder of the report
  gsx resume RUN             continue an interrupted run; iterations=N trains longer
  gsx eval RUN 'eval.zoom=[1,2,4]'  measure a run again, here also zoomed in
  gsx judge A=PATH B=PATH FOLDER  compare pictures or splats of any programs on test views; prepare writes them a scene
  gsx export RUN model.ply   write a splat file (.ply, .compressed.ply, .spz, .sog, .glb) or a web page (.html)

More commands; view, eval and export also take splat files of other programs:
  gsx scenes FOLDER          check photos before training: format, cameras, sharpness, exposure, coverage
  gsx prepare FOLDER --to OUT  write a scene for other programs: photos, COLMAP model, transforms.json, test cameras
  gsx photographs RUN        find training photos with wrong exposure or pose, blur or passers-by
  gsx render RUN             save test views as PNG; animate --orbit FILE.gif or a camera --path FILE.json
  gsx compact RUN            shrink a model while PSNR drops by at most 0.1 dB; merge joins runs on blocks of a scene
  gsx report DIR ...         write report.html of a run, or one page that compares all runs below some folders
  gsx explain KEY            explain a setting; gsx datasets [--get NAME]: list or fetch datasets; gsx plugins

Every setting is a word KEY=VALUE:
  gsx scene=colmap scene.path=FOLDER scene.downscale=4 iterations=2000 'eval.zoom=[1,2,4]'
  gsx minutes=N ...          plan size, steps and growth for N minutes; without it photos take 10 minutes on a CPU;
                             length=published trains all 30,000 steps, as photos on a GPU do without it
  gsx --cfg job --resolve    print the settings instead of training
  gsx -m KEY=A,B ...         train once per combination; hydra/launcher=processes|slurm trains several at once
  gsx variant=octree_ub dataset=mipnerf360 dataset.scene=garden budget=paper|quick|smoke   train a published method
  gsx +experiment=TABLE ...  reproduce a table of the paper; finished runs are reused
  torchrun --nproc-per-node 2 -m gsx training.batch=2 ...   train on two GPUs (docs/how-to/sweeps-and-clusters.md)

gsx VERB --help explains a command. Tab completion: eval "$(gsx -sc install=bash)". In zsh quote brackets.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    0: done; 2: an error that the user can correct; 130: interrupted; 141: the reader of a pipe has gone (`| head`).
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors in ("strict", "surrogateescape"):
        unicode = sys.stdout.encoding.lower().startswith("utf")  # then only bytes of file names are not text
        sys.stdout.reconfigure(errors="surrogateescape" if unicode else "backslashreplace")
    if processes() > 1:
        from gsx.engine.joined_ranks import run_together

        return run_together(lambda: dispatch_together(arguments), report_error)
    try:
        code = dispatch(arguments)
        sys.stdout.flush()  # a closed pipe raises here, not when Python ends
        return code
    except BrokenPipeError as error:
        return report_closed_output(error)
    except BaseException as error:
        code = report_error(error)
        discard_unwritten()
        return code


def dispatch_together(arguments: list[str]) -> int:
    """Train or resume on several processes; raise ConfigError for anything else."""
    from gsx.experiments.tables.sweep import is_table

    flags = {word for word in arguments if word.startswith("-")}
    allowed = set(parsers.RESUME_FLAGS) if arguments[:1] == ["resume"] else set()
    if flags - allowed or set(arguments[:1]) & (VERBS.keys() - {"resume"}):
        words = " ".join(arguments[:2])
        raise ConfigError(f"gsx {words}: torchrun is for training one scene and for gsx resume; call gsx without it")
    if is_table(arguments):
        raise ConfigError("torchrun trains one run, a table has many: call gsx without torchrun")
    return dispatch(arguments)


def dispatch(arguments: list[str]) -> int:
    """Run the command that the words name."""
    first = arguments[0] if arguments else ""
    if first == "help" or ({"--help", "-h"} & set(arguments) and first not in VERBS and not is_unknown(first)):
        sys.stdout.write(HELP)
        return 0
    if arguments == ["--version"]:
        sys.stdout.write(f"gsx {__version__}\n")
        return 0
    set_up_logging()
    if not arguments or is_override(first):
        return TRAIN(arguments)
    if first in VERBS:
        return VERBS[first](arguments[1:])
    if expand_home(first).exists():
        return TRAIN_FOLDER(arguments)
    raise ConfigError(unknown_command(first))


def is_unknown(word: str) -> bool:
    """Return True for a word that names neither a setting, an option nor a path."""
    return bool(word) and not word.startswith("-") and not is_override(word) and not expand_home(word).exists()


def unknown_command(word: str) -> str:
    """Return the error for a word that is neither a command nor a path."""
    if Path(word).name != word:
        return f"No such file or folder: '{word}'. Check the path"
    trains = " `gsx KEY=VALUE ...` and `gsx FOLDER` train." if word == "train" else nearest(word, VERBS)
    return f"Unknown command or path '{word}'.{trains} See gsx --help"


def command(parse: Callable[[list[str]], Any], module: str, function: str) -> Callable[[list[str]], int]:
    """Return a command that parses its words, then imports and calls the function of a module of `gsx.cli`."""

    def run(arguments: list[str]) -> int:
        options = parse(arguments)
        with loading():
            imported = import_module(f"gsx.cli.{module}")
        return int(getattr(imported, function)(options))

    return run


TRAIN = command(parsers.parse_train, "train", "train")
TRAIN_FOLDER = command(parsers.parse_folder, "train", "train_folder")
VERBS = {
    "resume": command(parsers.parse_resume, "train", "resume"),
    "eval": command(parsers.parse_eval, "runs", "evaluate"),
    "judge": command(parse_methods, "programs", "compare"),
    "photographs": command(parsers.parse_photographs, "runs", "check_photographs"),
    "render": command(parsers.parse_render, "runs", "render"),
    "view": command(parsers.parse_view, "runs", "view"),
    "export": command(parsers.parse_export, "runs", "export_file"),
    "compact": command(parsers.parse_compact, "runs", "compact_model"),
    "merge": command(parsers.parse_merge, "runs", "merge_runs"),
    "report": command(parsers.parse_report, "facts", "report"),
    "scenes": command(parsers.parse_scenes, "facts", "check_scene"),
    "prepare": command(parse_prepare, "programs", "prepare_scene"),
    "datasets": command(parsers.parse_datasets, "facts", "datasets"),
    "explain": command(parsers.parse_explain, "facts", "explain_key"),
    "plugins": command(parsers.parse_plugins, "facts", "list_plugins"),
}
