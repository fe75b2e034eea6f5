"""The command line: `gsx OVERRIDES...` trains; verbs do the rest. torch is imported only where it is needed."""

import argparse
import errno
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from gsx import __version__
from gsx.core.errors import ConfigError, GsxError, InputError, nearest

if TYPE_CHECKING:
    from gsx.core.plugins import Plugins
    from gsx.core.training.run import Run
    from gsx.experiments.runs.settings import Settings

logger = logging.getLogger("gsx.cli")

HELP = """\
gsx trains and evaluates 3D Gaussian Splatting models, with an eye for what happens when you zoom in.

  gsx                                            train the built-in scene (start here; a few minutes on a laptop)
  gsx scene=photos scene.path=FOLDER             train from nothing but photos
  gsx scene=colmap scene.path=FOLDER scene.downscale=4 iterations=2000 'eval.zoom=[1,2,4]'

  gsx OVERRIDES...          train, evaluate and report; any configuration value can be overridden
  gsx resume RUN [K=V ...]  go on where a run stopped, bit for bit; iterations=N lengthens it
  gsx eval RUN [K=V ...]    evaluate a run again, for example with 'eval.zoom=[1,2,4]'
  gsx render RUN            test views as PNG, or an orbit: --orbit FILE.gif (.webp, .mp4: gsx[video])
  gsx export RUN [FILE]     standard splat file (PLY), re-read and compared
  gsx report DIR [DIR ...]  report.html of a run, or one page over all runs of some folders; --to FOLDER
  gsx trade rasterizer RUN  which settings draw a model (RUN, FILE.ply, or none) fastest within an error
  gsx scenes PATH           what is this folder: format, cameras, images, points, problems
  gsx datasets [NAME ...]   the paper's datasets: what is expected below data_root=FOLDER, found, missing
  gsx plugins               what is installed, from where, and what failed to load

  gsx --cfg job --resolve   print the configuration instead of training
  gsx -m K=V1,V2 ...        a run for every combination; hydra/launcher=processes|slurm for several at once
  gsx variant=octree_ub ... a method of the paper; dataset=mipnerf360 dataset.scene=garden budget=paper|quick|smoke
  gsx +experiment=TABLE ... a table of the paper: runs what is missing, skips what is finished
  torchrun --nproc-per-node 2 -m gsx training.batch=2 ...   one scene on two GPUs (docs/clusters.md)
  gsx --version, gsx --help, gsx VERB --help

Completion: eval "$(gsx -sc install=bash)". In zsh quote brackets: 'eval.zoom=[1,2]'.
"""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells report it."""
STOPPING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGUSR2") if hasattr(signal, name))
"""Signals of the end of a job: preempted or requeued; out of time (submitit asks Slurm for the latter)."""
HYDRA_FLAGS = (
    "-m",
    "--multirun",
    "-sc",
    "--shell-completion",
    "--info",
    "--hydra-help",
    "--cfg",
    "-c",
    "-p",
    "--package",
    "--resolve",
)
"""Flags that are handed to Hydra as they are."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0 done, 2 something for the user to mend, 130 interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if processes() > 1:
        from gsx.core.training.distributed import as_one

        return as_one(lambda: dispatch_together(words), explained)
    try:
        return dispatch(words)
    except BaseException as error:
        return explained(error)


def explained(error: BaseException) -> int:
    """The exit code of an error that people can mend, which is shown; others are raised again."""
    if isinstance(error, GsxError):
        return complain(str(error))
    if isinstance(error, OSError):
        return complain(os_sentence(error))
    if isinstance(error, KeyboardInterrupt):
        say("\ngsx: interrupted before a checkpoint was due; nothing half-written is left\n", sys.stderr)
        return INTERRUPTED
    raise error


def complain(sentence: str) -> int:
    """Show an error as one sentence."""
    say(f"gsx: {sentence}\n", sys.stderr)
    return 2


def processes() -> int:
    """How many processes torchrun has started for this run; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", 1)) if "LOCAL_RANK" in os.environ else 1


def speaks() -> bool:
    """Whether this process is the one that is heard: of torchrun's the first."""
    return processes() == 1 or os.environ["RANK"] == "0"


def say(text: str, stream: TextIO) -> None:
    """Write to a stream, once for all processes."""
    if speaks():
        stream.write(text)


def os_sentence(error: OSError) -> str:
    """A failure of the file system with its remedy."""
    where = f" ({error.filename})" if error.filename else ""
    remedy = "free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "check that path and its permissions"
    return f"{error.strerror or error}{where}: {remedy}, or choose a writable place, for example output=FOLDER"


def dispatch_together(words: list[str]) -> int:
    """Train or resume on several processes.

    Raises:
        ConfigError: anything else is asked for.
    """
    if any(word.startswith("-") for word in words) or (words[:1] and words[0] in VERBS and words[0] != "resume"):
        asked = " ".join(words[:2])
        raise ConfigError(f"gsx {asked}: torchrun is for training one scene and for gsx resume; call gsx without it")
    from gsx.experiments.tables.sweep import is_table

    if is_table(words):
        raise ConfigError("a table is many runs, and torchrun is for one: call gsx without it (docs/clusters.md)")
    return dispatch(words)


def dispatch(words: list[str]) -> int:
    """Find the verb and run it."""
    if words[:1] == ["help"] or ({"--help", "-h"} & set(words) and words[0] not in VERBS):
        sys.stdout.write(HELP)
        return 0
    if words == ["--version"]:
        sys.stdout.write(f"gsx {__version__}\n")
        return 0
    if not words or words[0].startswith(("-", "+", "~")) or "=" in words[0]:
        return verb_train(words)
    if words[0] not in VERBS:
        raise ConfigError(f"'{words[0]}' is no verb of gsx.{nearest(words[0], VERBS)} See gsx --help")
    set_up_logging()
    return VERBS[words[0]](words[1:])


def set_up_logging() -> None:
    """Plain messages of gsx on standard error, warnings marked."""

    class Plain(logging.Formatter):
        def format(self, record: logging.LogRecord) -> str:
            mark = f"{record.levelname.lower()}: " if record.levelno > logging.INFO else ""
            return mark + record.getMessage()

    root = logging.getLogger("gsx")
    root.setLevel(logging.INFO)
    root.propagate = False
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(Plain())
    root.handlers = [handler] if speaks() else [logging.NullHandler()]


@contextmanager
def logged_to(folder: Path) -> Iterator[None]:
    """Also write messages to the run's log.txt."""
    if not speaks():
        yield
        return
    handler = logging.FileHandler(folder / "log.txt", encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    handler.handleError = lambda record: None  # type: ignore[method-assign]  # a full disk is reported once, elsewhere
    logging.getLogger("gsx").addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger("gsx").removeHandler(handler)
        handler.close()


def plugins() -> "Plugins":
    """Built-in and installed plugins."""
    from gsx import builtin
    from gsx.core.plugins import load_plugins

    return load_plugins([("gsx", builtin)])


@contextmanager
def interruptible(run: "Run") -> Iterator[object]:
    """The first Ctrl-C ends training after the current step; a second one, or one after training, ends the program.

    So do the signals by which a cluster takes a machine back (STOPPING): with a checkpoint at hand they are sent again,
    to whoever waited for them before.

    Yields a listener that takes the handlers away when training is over.
    """
    from gsx.core.plugins import hookimpl

    received: list[int] = []

    def stop(number: int, frame: Any) -> None:
        run.stopping = True
        received.append(number)
        give_back()

    def give_back() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    class UntilTrained:
        @hookimpl
        def gsx_training_finished(self) -> None:
            give_back()

    alone = STOPPING if processes() == 1 else ()  # torchrun ends its processes itself, some while they wait for others
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, *alone)}
    try:
        yield UntilTrained()
    finally:
        give_back()
    if received and received[0] in STOPPING and not run.complete:
        logger.info("stopped at step %d by %s", run.step, signal.Signals(received[0]).name)
        signal.raise_signal(received[0])
        raise SystemExit(128 + received[0])  # it was not fatal: there is no result to hand over either way


# -- verbs ---------------------------------------------------------------------------------------------------------


def verb_train(words: list[str]) -> int:
    """gsx OVERRIDES..."""
    set_up_logging()
    flags = [word for word in words if word.startswith("-")]
    for flag in flags:
        if flag.split("=")[0] not in HYDRA_FLAGS:
            raise ConfigError(f"'{flag}' is no option of gsx.{nearest(flag, HYDRA_FLAGS)} See gsx --help")
    if flags:
        return hand_to_hydra(words)
    from gsx.experiments.tables.sweep import is_table

    if is_table(words):
        return fill_table(words)
    from gsx.experiments.runs.compose import compose

    return train(compose(words, loaded := plugins()), loaded)


def fill_table(words: list[str]) -> int:
    """gsx +experiment=TABLE ..."""
    from gsx.experiments.tables.sweep import run_table

    text, code = run_table(words, plugins(), sweep_job)
    sys.stdout.write(text)
    return code


def hand_to_hydra(words: list[str]) -> int:
    """Multirun, completion and information flags, by Hydra's own command line; a multirun ends with one report."""
    from gsx.experiments.runs.compose import check_overrides, hydra_main, quoted
    from gsx.experiments.tables.sweep import is_table

    if is_table(words) and {"-m", "--multirun"} & set(words):
        raise ConfigError("a table is many runs already: leave out -m, launchers work without it")
    loaded = plugins()
    if not {"-m", "--multirun"} & set(words):
        hydra_main(words, loaded, sweep_job)
        return 0
    given = [word for word in words if not word.startswith("-")]
    sweep = new_sweep(check_overrides(given, loaded))
    try:
        hydra_main([*words, f"hydra.sweep.dir={quoted(str(sweep))}"], loaded, sweep_job)
    finally:
        code = close_sweep(sweep)
    return code


def new_sweep(output: Path) -> Path:
    """A new folder for the record of a multirun."""
    for number in range(1, 1000):
        stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        folder = output / "sweeps" / (stamp if number == 1 else f"{stamp}_{number}")
        if not folder.exists():
            folder.mkdir(parents=True)
            return folder
    raise InputError(f"no free folder below {output / 'sweeps'}: clean it up")


def close_sweep(sweep: Path) -> int:
    """Report on the runs that a multirun has made; returns the worst exit code of its jobs."""
    from gsx.core.files import read_json
    from gsx.experiments.reports.overview import write_overview

    records = [read_json(path) for path in sorted((sweep / "jobs").glob("*.json"))]
    folders = [folder for record in records if record["folder"] and (folder := Path(record["folder"])).is_dir()]
    if folders:
        sys.stdout.write(f"{write_overview(sweep, folders)}\n")
    return max((record["code"] for record in records), default=0)


def sweep_job(config: Any) -> int:
    """One job of a multirun or of a table, in this process or in one of a launcher's; its record stays with the sweep.

    An error is shown and does not end the others; Ctrl-C does.
    """
    from gsx.core.files import write_json
    from gsx.experiments.runs.compose import job_place
    from gsx.experiments.runs.settings import settings_from

    set_up_logging()
    folders: list[Path] = []
    try:
        code = train(settings_from(config, loaded := plugins()), loaded, folders)
    except GsxError as error:
        code = complain(str(error))
    except OSError as error:
        code = complain(os_sentence(error))
    except Exception:  # a defect, perhaps a plugin's: the other jobs are worth no less
        logger.exception("this job failed")
        code = 1
    place = job_place()
    if place is not None:
        (place[0] / "jobs").mkdir(parents=True, exist_ok=True)
        record = {"folder": str(folders[0].resolve()) if folders else "", "code": code}
        write_json(place[0] / "jobs" / f"{place[1]:05d}.json", record)
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    return code


def train(settings: "Settings", loaded: "Plugins", folders: list[Path] | None = None) -> int:
    """Train one composed experiment in a new folder, or go on in that of its composition; `folders` learns which."""
    from gsx.experiments.runs.open import start

    if settings.general.reuse:
        return reused(settings, loaded, [] if folders is None else folders)
    run = start(settings, loaded)
    if folders is not None:
        folders.append(run.folder)
    return carry_out(run, settings, loaded)


def reused(settings: "Settings", loaded: "Plugins", folders: list[Path]) -> int:
    """Train what is left of a composition in its own folder."""
    from gsx.core.run_folder.run_key import claimed, place_of, scene_stamp
    from gsx.experiments.runs.open import resume_or_start

    if processes() > 1:
        raise ConfigError("reuse=true is for one process: leave it out under torchrun, folder=NAME and `gsx resume` do")
    stamp = scene_stamp(settings.resolved)
    folder = place_of(settings.resolved, stamp)
    folders.append(folder)
    with claimed(folder) as alone:
        if not alone:
            raise InputError(f"{folder} is being trained by another process: wait for it, and give the command again")
        _, run = resume_or_start(settings, loaded, stamp)
        if run is None:
            sys.stdout.write(f"{folder / 'report.html'}\n")
            return 0
        return carry_out(run, settings, loaded)


def carry_out(run: "Run", settings: "Settings", loaded: "Plugins") -> int:
    """Train to the end or to Ctrl-C, and say where things are."""
    from gsx.experiments.runs.execute import execute

    try:
        with interruptible(run) as listener, loaded.listening([listener]), logged_to(run.folder):
            execute(run, settings, loaded)
    except KeyboardInterrupt:
        say(f"\ngsx: interrupted after step {run.step}; go on with: {onwards(run)}\n", sys.stderr)
        return INTERRUPTED
    if not run.complete:
        say(f"gsx: stopped at step {run.step}; go on with: {onwards(run)}\n", sys.stderr)
        return INTERRUPTED
    say(f"{run.folder / 'report.html'}\n", sys.stdout)
    return 0


def onwards(run: "Run") -> str:
    """The command that goes on with a run; one that is named by its composition is found again by it."""
    return "the same command" if run.config.get("reuse") else f"gsx resume {run.folder}"


def run_words(verb: str, words: list[str], description: str) -> tuple[Path, list[str]]:
    """The run folder and the overrides after it."""
    parser = Parser(prog=f"gsx {verb}", usage="%(prog)s RUN [KEY=VALUE ...]", description=description)
    parser.add_argument("run", metavar="RUN", help="run folder")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="values that take the place of the run's own")
    given = parser.parse_args(words)
    if "=" in given.run and not Path(given.run).exists():
        raise InputError(f"gsx {verb} needs a run folder: gsx {verb} RUN [KEY=VALUE ...]")
    return Path(given.run), given.overrides


def verb_resume(words: list[str]) -> int:
    """gsx resume RUN [KEY=VALUE ...]"""
    told = "Go on where a run stopped, bit for bit; iterations=N lengthens it."
    folder, overrides = run_words("resume", words, told)
    from gsx.experiments.runs.open import open_run
    from gsx.experiments.runs.settings import write_config

    loaded = plugins()
    run, settings = open_run(folder, loaded, overrides, training=True)
    if run.complete and (folder / "evaluation.json").is_file():
        raise InputError(f"{folder} is complete at step {run.step}: give iterations=N with N above that to lengthen it")
    if run.ranks.first:
        write_config(folder / "config.yaml", settings.resolved)
    logger.info("resuming %s at step %d", folder, run.step)
    return carry_out(run, settings, loaded)


def verb_eval(words: list[str]) -> int:
    """gsx eval RUN [KEY=VALUE ...]"""
    told = "Evaluate a run again, for example with 'eval.zoom=[1,2,4]', drawn by the path that trained it."
    folder, overrides = run_words("eval", words, told)
    from gsx.core.rasterizer.prepare import warm
    from gsx.experiments.reports.report import write_report
    from gsx.experiments.runs.evaluate import evaluate
    from gsx.experiments.runs.execute import finish
    from gsx.experiments.runs.open import as_trained, open_run

    loaded = plugins()
    run, settings = open_run(folder, loaded, overrides)
    run.raster = as_trained(run)
    warm(run.raster, run.device)
    if run.complete:
        finish(run, settings, loaded)
    else:
        loaded.emit.gsx_evaluated(run=run, evaluation=evaluate(run, settings))
        write_report(folder)
    sys.stdout.write(f"{folder / 'report.html'}\n")
    return 0


def verb_render(words: list[str]) -> int:
    """gsx render RUN [--orbit FILE] ..."""
    parser = argparse.ArgumentParser(prog="gsx render", description="Render test views, or an orbit as an animation.")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--orbit", type=Path, metavar="FILE", help="animate a closed orbit: .gif, .webp or .mp4")
    parser.add_argument("--frames", type=int, default=60, help="frames of the orbit (60)")
    parser.add_argument("--fps", type=float, default=20, help="frames per second (20)")
    parser.add_argument("--zoom", type=float, default=1, help="times the training resolution (1)")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="folder for test views (RUN/renders/test)")
    given = parser.parse_args(words)
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


def verb_export(words: list[str]) -> int:
    """gsx export RUN [FILE.ply] [--view NAME]"""
    parser = argparse.ArgumentParser(prog="gsx export", description="Write a splat file (PLY), read back and compared.")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("file", type=Path, nargs="?", help="splat file to write (RUN/point_cloud.ply)")
    parser.add_argument("--view", metavar="NAME", help="only what is drawn for this view, as a standard splat file")
    given = parser.parse_args(words)
    from gsx.core.gaussians.splat_files import refuse_suffix
    from gsx.experiments.runs.export import export, reimport_psnr
    from gsx.experiments.runs.open import open_run
    from gsx.experiments.runs.render import view_named

    if given.file:
        refuse_suffix(given.file)
    run, settings = open_run(given.run, plugins())
    view = view_named(run, given.view) if given.view else None
    path = given.file or given.run / ("point_cloud.ply" if view is None else "point_cloud_of_view.ply")
    export(run, path, view.camera if view else None)
    if view is not None or run.backbone.standard_file:
        views = [view] if view else run.scene.test
        logger.info("read back and rendered again: %s", reimport_psnr(run, settings, path, views))
    sys.stdout.write(f"{path}\n")
    return 0


def verb_report(words: list[str]) -> int:
    """gsx report DIR [DIR ...] [--to FOLDER]"""
    parser = Parser(prog="gsx report", description="Report of a run, or one page over all runs of some folders.")
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="run, or folder with runs below it")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="folder for the page (DIR, or what several share)")
    given = parser.parse_args(words)
    from gsx.experiments.reports.report import report_on

    sys.stdout.write(f"{report_on(given.folders, new_folder(given.to) if given.to else None)}\n")
    return 0


def verb_scenes(words: list[str]) -> int:
    """gsx scenes PATH"""
    parser = Parser(prog="gsx scenes", description="What a folder is: format, cameras, images, points, problems.")
    parser.add_argument("path", type=Path, metavar="PATH", help="folder of a scene")
    given = parser.parse_args(words)
    from gsx.experiments.runs.inspect import describe

    lines = describe(given.path)
    sys.stdout.write("\n".join(lines) + "\n")
    return 2 if any(line.startswith("problem") for line in lines) else 0


def verb_datasets(words: list[str]) -> int:
    """gsx datasets [NAME ...] [data_root=FOLDER]"""
    parser = Parser(
        prog="gsx datasets",
        usage="%(prog)s [NAME ...] [data_root=FOLDER]",
        description="The paper's datasets: what is expected below data_root=FOLDER, what is found, what is missing.",
    )
    parser.add_argument("words", nargs="*", metavar="NAME", help="datasets (all)")
    words = parser.parse_args(words).words
    from gsx.experiments.runs.compose import Compositions
    from gsx.experiments.tables.datasets import described

    overrides = [word for word in words if "=" in word]
    with Compositions(plugins()) as compositions:
        known = [name for name in compositions.choices("dataset") if name != "own"]
        names = [word for word in words if word not in overrides] or known
        for name in names:
            if name not in known:
                raise InputError(f"'{name}' is no dataset; there are {', '.join(known)}.{nearest(name, known)}")
            asked = [f"dataset={name}", *overrides]
            root = Path(str(compositions.value(asked, "data_root")))
            sys.stdout.write("\n".join(described(compositions.node(asked, "dataset"), root)) + "\n")
    return 0


class Parser(argparse.ArgumentParser):
    """Mistakes become errors of ours: one sentence, without the usage text."""

    def error(self, message: str) -> NoReturn:
        """Raise ConfigError."""
        raise ConfigError(f"{self.prog}: {message}. See {self.prog} --help")


def positive(kind: type[int] | type[float]) -> Callable[[str], Any]:
    """What reads a finite number above 0 from a word."""

    def read(word: str) -> int | float:
        try:
            number = kind(word)
        except ValueError:
            number = kind(0)
        if not 0 < number < float("inf"):
            what, example = ("whole number of 1 or more", "3") if kind is int else ("number above 0", "1e-3")
            raise argparse.ArgumentTypeError(f"'{word}' is no {what}: give one, for example {example}")
        return number

    return read


def whole(word: str) -> int:
    """A whole number of 0 or more."""
    if not word.isdecimal():
        raise argparse.ArgumentTypeError(f"'{word}' is no whole number of 0 or more: give one, for example 4")
    return int(word)


def trade_arguments(words: list[str]) -> argparse.Namespace:
    """The options of gsx trade; `target` is a path or None, `overrides` what has an equals sign.

    Raises:
        ConfigError: a word means nothing here.
    """
    parser = Parser(
        prog="gsx trade rasterizer",
        usage="%(prog)s [RUN or FILE.ply] [KEY=VALUE ...] [options]",
        description="Try the rasterizer's settings on a model: time each, compare with a float64 truth, recommend "
        "some. Without a model the built-in scene stands in; KEY=VALUE changes the settings to start from.",
    )
    parser.add_argument("words", nargs="*", help=argparse.SUPPRESS)
    add = parser.add_argument
    add("--max-error", type=positive(float), default=1e-3, metavar="E", help="error budget in display units (1e-3)")
    add("--to", type=Path, metavar="FOLDER", help="folder for trade.html and trade.json (RUN/trade, else ./trade)")
    add("--repeats", type=positive(int), default=3, metavar="N", help="rounds of timing (3)")
    add("--views", type=positive(int), metavar="N", help="pictures to measure on (2, built-in scene: 1)")
    add("--combinations", type=whole, metavar="N", help="most combinations of knobs to try (4, built-in scene: 1)")
    add("--knobs", metavar="A,B,...", help="turn only these settings, for example tile_size,cull (all)")
    given, unknown = parser.parse_known_intermixed_args(words)
    if unknown:
        options = ("--max-error", "--to", "--repeats", "--views", "--combinations", "--knobs")
        hint = nearest(unknown[0], options)
        raise ConfigError(f"'{unknown[0]}' is no option of {parser.prog}.{hint} See {parser.prog} --help")
    targets = [word for word in given.words if "=" not in word or Path(word).exists()]
    given.overrides = [word for word in given.words if word not in targets]
    if len(targets) > 1:
        raise InputError(f"gsx trade rasterizer takes one run or one splat file, got {' and '.join(targets)}")
    given.target = Path(targets[0]) if targets else None
    return given


def new_folder(folder: Path) -> Path:
    """The folder, made where it is missing.

    Raises:
        InputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}): choose another with --to FOLDER") from error
    return folder


def verb_trade(words: list[str]) -> int:
    """gsx trade rasterizer [RUN or FILE.ply] [KEY=VALUE ...] ..."""
    if words[:1] in (["--help"], ["-h"]):
        words = ["rasterizer", "--help"]
    if not words:
        raise InputError("gsx trade needs to know what to trade: gsx trade rasterizer [RUN or FILE.ply]")
    if words[0] != "rasterizer":
        remedy = "gsx trade rasterizer [RUN or FILE.ply] [KEY=VALUE ...]"
        raise ConfigError(f"'{words[0]}' is nothing gsx can trade.{nearest(words[0], ['rasterizer'])} Type {remedy}")
    given = trade_arguments(words[1:])
    from gsx.experiments.trade.knobs import advice_lines, check_knobs, table
    from gsx.experiments.trade.measure import sweep, usable_paths
    from gsx.experiments.trade.page import write_trade
    from gsx.experiments.trade.subject import open_subject

    knobs, loaded = check_knobs(given.knobs), plugins()
    views, combinations = (2, 4) if given.target else (1, 1)
    subject = open_subject(given.target, given.overrides, given.views or views, loaded)
    folder = new_folder(given.to or (given.target if given.target and given.target.is_dir() else Path()) / "trade")
    for note in (subject.name, *subject.notes):
        logger.info("%s", note)
    presets, notes = usable_paths(loaded, subject.device)
    for note in notes:
        logger.warning("%s", note)
    trade = sweep(
        subject,
        presets,
        knobs=knobs,
        repeats=given.repeats,
        max_error=given.max_error,
        most_combinations=combinations if given.combinations is None else given.combinations,
        notes=notes,
    )
    lines = ["", *table(trade.rows), "", *advice_lines(trade.rows, given.max_error)]
    sys.stdout.write("\n".join(lines) + f"\n{write_trade(trade, folder, given.max_error)}\n")
    return 0


def verb_plugins(words: list[str]) -> int:
    """gsx plugins"""
    Parser(prog="gsx plugins", description="What is installed, from where, and what failed to load.").parse_args(words)
    from gsx.core.plugins import KINDS

    loaded = plugins()
    for kind in KINDS:
        parts = [f"{name} ({loaded.registry.find(kind, name).provider})" for name in loaded.registry.names(kind)]
        sys.stdout.write(f"{kind + ':':13} {', '.join(parts) or '-'}\n")
    for name, plugin_version in loaded.versions.items():
        sys.stdout.write(f"plugin {name} {plugin_version}\n")
    for failure in loaded.failures:
        sys.stdout.write(f"failed to load: {failure.plugin}: {failure.reason}\n")
    return 0


VERBS: dict[str, Callable[[list[str]], int]] = {
    "resume": verb_resume,
    "eval": verb_eval,
    "render": verb_render,
    "export": verb_export,
    "report": verb_report,
    "trade": verb_trade,
    "scenes": verb_scenes,
    "datasets": verb_datasets,
    "plugins": verb_plugins,
}
