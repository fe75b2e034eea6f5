"""The command line: `gsx OVERRIDES...` trains; verbs do the rest. torch is imported only where it is needed."""

import io
import sys
from collections.abc import Callable, Sequence

from gsx import __version__
from gsx.cli.arguments import RESUME_FLAGS
from gsx.cli.compact import verb_compact
from gsx.cli.exit_codes import discard_unwritten, explained, unheard
from gsx.cli.folder import is_given, train_from
from gsx.cli.look import verb_datasets, verb_explain, verb_plugins, verb_report, verb_scenes
from gsx.cli.runs import verb_eval, verb_export, verb_photographs, verb_render, verb_view
from gsx.cli.train import verb_resume, verb_train
from gsx.core.errors import ConfigError, nearest
from gsx.engine.processes import processes
from gsx.experiments.runs.logs import set_up_logging
from gsx.experiments.runs.overrides import is_override

HELP = """\
gsx trains and evaluates 3D Gaussian Splatting models, with an eye for what happens when you zoom in.

  gsx                                            train the built-in scene (start here; a few minutes on a laptop)
  gsx FOLDER                                     train from what is in it: photos, COLMAP, transforms; or from a VIDEO
  gsx scene=colmap scene.path=FOLDER scene.downscale=4 iterations=2000 'eval.zoom=[1,2,4]'

  gsx OVERRIDES...          train, evaluate and report; any configuration value can be overridden
  gsx resume RUN [K=V ...]  go on where a run stopped, bit for bit; iterations=N lengthens it
  gsx view RUN|FILE         look around in a browser, also while RUN is trained (gsx[viewer]); or viewer=true
  gsx eval RUN|FILE [K=V ...]  evaluate a run again, with 'eval.zoom=[1,2,4]'; or a splat file on scene=...
  gsx photographs RUN       what is wrong with training photographs: exposure, pose, blur, passers-by; the ten worst
  gsx render RUN|FILE       test views as PNG, --orbit FILE.gif (.webp, .mp4: gsx[video]), or along --path CAMERAS.json
  gsx export RUN|FILE [TO]  splat file by suffix (.ply, .compressed.ply, .spz, .sog, .glb), or .html: one page to send
  gsx compact RUN|FILE      the smallest model that looks the same: --max-drop-db 0.1; FILE with scene=...
  gsx report DIR [DIR ...]  report.html of a run, or one page over all runs of some folders; --to FOLDER
  gsx scenes PATH           what is this folder: format, cameras, images, points, problems
  gsx datasets [NAME ...]   the paper's datasets: what is expected below data_root=FOLDER, found, missing
  gsx explain KEY           a key or group of the configuration: value, range, comment, and the file that sets it
  gsx plugins               what is installed, from where, and what failed to load

  gsx --cfg job --resolve   print the configuration instead of training
  gsx -m K=V1,V2 ...        a run for every combination; hydra/launcher=processes|slurm for several at once
  gsx variant=octree_ub ... a method of the paper; dataset=mipnerf360 dataset.scene=garden budget=paper|quick|smoke
  gsx +experiment=TABLE ... a table of the paper: runs what is missing, skips what is finished
  torchrun --nproc-per-node 2 -m gsx training.batch=2 ...   one scene on two GPUs (docs/how-to/sweeps-and-clusters.md)
  gsx --version, gsx --help, gsx VERB --help

Completion: eval "$(gsx -sc install=bash)". In zsh quote brackets: 'eval.zoom=[1,2]'.
"""
TRADE_MOVED = (
    "gsx trade is gone. Compare settings of a training with `gsx -m KEY=A,B ...`, whose page draws the fronts; "
    "`python benchmarks/trades.py --what rasterizer` measures those of the rasterizer (docs/how-to/choose-settings.md)"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns the exit code.

    0: done; 2: something for the user to correct; 130: interrupted; 141: nobody reads on (`| head`).
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors in ("strict", "surrogateescape"):
        unicode = sys.stdout.encoding.lower().startswith("utf")  # then only bytes of file names are no letters of it
        sys.stdout.reconfigure(errors="surrogateescape" if unicode else "backslashreplace")
    if processes() > 1:
        from gsx.engine.joined_ranks import run_together

        return run_together(lambda: dispatch_together(arguments), explained)
    try:
        code = dispatch(arguments)
        sys.stdout.flush()  # what nobody takes is noticed here, not when Python ends
        return code
    except BrokenPipeError as error:
        return unheard(error)
    except BaseException as error:
        code = explained(error)
        discard_unwritten()
        return code


def dispatch_together(arguments: list[str]) -> int:
    """Trains or resumes on several processes.

    Raises:
        ConfigError: anything else is asked for.
    """
    from gsx.experiments.tables.sweep import is_table

    flags = {word for word in arguments if word.startswith("-")}
    allowed = set(RESUME_FLAGS) if arguments[:1] == ["resume"] else set()
    if flags - allowed or set(arguments[:1]) & (VERBS.keys() - {"resume"}):
        words = " ".join(arguments[:2])
        raise ConfigError(f"gsx {words}: torchrun is for training one scene and for gsx resume; call gsx without it")

    if is_table(arguments):
        raise ConfigError("torchrun trains one run and a table has many: call gsx without torchrun")
    return dispatch(arguments)


def dispatch(arguments: list[str]) -> int:
    """Finds the verb and runs it."""
    if arguments[:1] == ["help"] or ({"--help", "-h"} & set(arguments) and arguments[0] not in VERBS):
        sys.stdout.write(HELP)
        return 0
    if arguments == ["--version"]:
        sys.stdout.write(f"gsx {__version__}\n")
        return 0
    if not arguments or is_override(arguments[0]):
        return verb_train(arguments)
    if arguments[0] == "trade":
        raise ConfigError(TRADE_MOVED)
    if arguments[0] not in VERBS and is_given(arguments[0]):
        set_up_logging()
        return train_from(arguments)
    if arguments[0] not in VERBS:
        problem = f"'{arguments[0]}' is no verb of gsx, and no folder."
        raise ConfigError(f"{problem}{nearest(arguments[0], VERBS)} See gsx --help")
    set_up_logging()
    return VERBS[arguments[0]](arguments[1:])


VERBS: dict[str, Callable[[list[str]], int]] = {
    "resume": verb_resume,
    "eval": verb_eval,
    "photographs": verb_photographs,
    "render": verb_render,
    "export": verb_export,
    "compact": verb_compact,
    "view": verb_view,
    "report": verb_report,
    "scenes": verb_scenes,
    "datasets": verb_datasets,
    "explain": verb_explain,
    "plugins": verb_plugins,
}
