"""Parsers of the commands. They run before torch is imported, so that help and mistakes are quick."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gsx.core.errors import ConfigError, InputError, command, nearest
from gsx.core.files import expand_home
from gsx.core.ranges import MOST_STEPS, ZOOMS, Range
from gsx.experiments.runs.overrides import is_override
from gsx.formats.axis_names import AUTO, CHOICES, SPECIFIED, TRAINED
from gsx.formats.suffixes import READABLE, SPZ_VERSIONS, WRITTEN, splat_file_at

RESUME_FLAGS = ("--trust", "--changed")
HYDRA_FLAGS = (
    *("-m", "--multirun", "-sc", "--shell-completion", "--info", "--hydra-help"),
    *("--cfg", "-c", "-p", "--package", "--resolve"),
)
"""Flags that Hydra handles."""
VALUED_FLAGS = ("--cfg", "-c", "-p", "--package", "--info")
"""Flags before a value."""
MOST_FRAMES = 100_000
"""Frames of an orbit: its cameras are held in memory."""
SPLAT_FILE = f"splat file: {READABLE}"


class Parser(argparse.ArgumentParser):
    """Parser of one command whose mistakes are errors of one sentence, without the usage text."""

    def __init__(self, verb: str, description: str, usage: str | None = None) -> None:
        super().__init__(
            prog=f"gsx {verb}", usage=usage and f"%(prog)s {usage}", description=description, allow_abbrev=False
        )
        self.settings = False
        """True: it takes KEY=VALUE."""

    def add_overrides(self, description: str) -> None:
        """Add any number of KEY=VALUE as `overrides`."""
        # with a default: argparse requires what has none
        self.settings = True
        self.add_argument("overrides", nargs="*", default=[], metavar="KEY=VALUE", help=description)

    def add_axes(self, flag: str = "--axes") -> None:
        """Add a flag for the axes of the splat file to read."""
        words = "axes of FILE: rub (SPZ standard), rdf (as trained), three letters (auto: by the file or its format)"
        self.add_argument(flag, choices=CHOICES, default=AUTO, metavar="AXES", help=words)

    def error(self, message: str) -> NoReturn:
        """Raise ConfigError."""
        flag, equals, value = message.removeprefix("unrecognized arguments: ").split()[0].partition("=")
        if self.settings and flag.startswith("-") and equals:
            raise ConfigError(f"{self.prog}: {without_dashes(flag, value)}")
        raise ConfigError(f"{self.prog}: {message}. See {self.prog} --help")


def positive(kind: type[int] | type[float]) -> Callable[[str], Any]:
    """Return a reader of finite numbers above 0."""

    def read(word: str) -> int | float:
        try:
            number = kind(word)
        except ValueError:
            number = kind(0)
        if not 0 < number < float("inf"):
            what, example = ("whole number of 1 or more", "3") if kind is int else ("number above 0", "1e-3")
            raise argparse.ArgumentTypeError(f"'{word}' is not valid: give a {what}, for example {example}")
        return number

    return read


def whole(word: str) -> int:
    """Read a whole number of 0 or more."""
    if not word.isdecimal():
        raise argparse.ArgumentTypeError(f"'{word}' is not valid: give a whole number of 0 or more, for example 4")
    return int(word)


def refuse_beyond(flag: str, value: float, bounds: Range) -> None:
    """Raise InputError for a number outside of its range."""
    if value not in bounds:
        raise InputError(f"{flag} is {value:,}: give a number {bounds}")


def refuse_missing(path: Path) -> None:
    """Raise InputError for a path that does not exist."""
    if not path.exists():
        raise InputError(f"'{path}' does not exist: give a run folder or a splat file")


def refuse_axes_of_run(verb: str, options: argparse.Namespace) -> None:
    """Raise InputError for --axes of a run, which has the axes of its scene."""
    if options.axes != AUTO and splat_file_at(options.target).is_dir():
        raise InputError(f"{verb}: --axes {options.axes} is for splat files, {options.target} is a run: leave it out")


def parse_train(arguments: list[str]) -> list[str]:
    """Refuse unknown flags of `gsx OVERRIDES...`, and words that are no overrides."""
    for word in split_flags(arguments)[1]:
        if not is_override(word):
            raise ConfigError(misplaced(word, [other for other in arguments if other != word]))
    return arguments


def split_flags(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return (Hydra's flags with their values, other words); raise ConfigError for another flag."""
    flags, others = list[str](), list[str]()
    for before, word in zip(["", *arguments], arguments, strict=False):
        if word.startswith("-"):
            refuse_flag(word)
        (flags if word.startswith("-") or before in VALUED_FLAGS else others).append(word)
    return flags, others


def refuse_flag(word: str) -> None:
    """Raise ConfigError for a flag that Hydra does not have."""
    flag, equals, value = word.partition("=")
    if flag in HYDRA_FLAGS:
        return
    if equals:
        raise ConfigError(without_dashes(flag, value))
    remedy = nearest(word, HYDRA_FLAGS) or f" Settings have no dashes: {flag.lstrip('-')}=VALUE."
    raise ConfigError(f"Unknown option '{word}'.{remedy} See gsx --help")


def without_dashes(flag: str, value: str) -> str:
    """Return the error for a setting that is written as a flag."""
    return f"'{flag}={value}': settings have no dashes, write {flag.lstrip('-')}={value}"


def misplaced(word: str, others: Sequence[str]) -> str:
    """Return the error for a word among overrides that is none; `others`: the other words."""
    path = expand_home(word)
    if path.exists():
        kind = "folder" if path.is_dir() else "file"
        return f"'{word}' is a {kind}: put it first, `{command(word, *others)}`"
    return f"'{word}' is neither a setting (KEY=VALUE) nor a folder or file: check its name. See gsx --help"


def parse_folder(arguments: list[str]) -> list[str]:
    """Refuse words that name another scene in `gsx FOLDER [KEY=VALUE ...]`."""
    for word in split_flags(arguments[1:])[1]:
        if "=" not in word or word.startswith(("scene=", "scene.path=")):
            raise ConfigError(f"gsx {arguments[0]}: '{word}' does not go with the folder of a scene: leave it out")
    return arguments


def parse_resume(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx resume RUN [KEY=VALUE ...] [--trust] [--changed]`."""
    parser = Parser("resume", "Continue a run where it stopped. The result has the same bits as without the stop.")
    parser.add_argument("run", metavar="RUN", help="run folder")
    parser.add_overrides("settings to change; iterations=N trains up to step N")
    parser.add_argument("--trust", action="store_true", help="also run code that the settings in RUN name")
    parser.add_argument("--changed", action="store_true", help="continue even if cameras or config.yaml have changed")
    return with_run_folder(parser, parser.parse_intermixed_args(arguments))


def with_run_folder(parser: Parser, options: argparse.Namespace) -> argparse.Namespace:
    """Make the first word a path; raise InputError if it is an override."""
    if "=" in options.run and not Path(options.run).exists():
        raise InputError(f"{parser.prog} needs a run folder: {parser.prog} RUN [KEY=VALUE ...]")
    options.run = Path(options.run)
    return options


def parse_eval(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx eval RUN|FILE [KEY=VALUE ...]`."""
    description = (
        "Measure a run again on its test views, for example zoomed in with 'eval.zoom=[1,2,4]'. Or measure a splat "
        "file of any program on a scene, in a new run folder: gsx eval FILE scene=colmap scene.path=FOLDER."
    )
    parser = Parser("eval", description)
    parser.add_argument("run", metavar="RUN|FILE", help=f"run folder or {SPLAT_FILE}")
    parser.add_overrides("settings to change")
    options = with_run_folder(parser, parser.parse_args(arguments))
    refuse_missing(options.run)
    return options


def parse_photographs(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx photographs RUN [KEY=VALUE ...] [--worst N]`."""
    description = (
        "Compare training photos with renders of the trained model to find wrong exposure, wrong poses, blur and "
        "passers-by. The report then shows the worst photos."
    )
    parser = Parser("photographs", description)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_overrides("settings to change")
    parser.add_argument("--worst", type=positive(int), default=10, metavar="N", help="photos to list (10)")
    if not arguments and Path("photographs").is_dir():
        raise InputError("gsx photographs needs a run folder: give RUN, or train from that folder: gsx ./photographs")
    return parser.parse_intermixed_args(arguments)


def parse_render(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx render RUN|FILE [--orbit FILE | --path CAMERAS.json [--movie FILE]] ...`."""
    parser = Parser("render", "Save test views as PNG, an orbit as an animation, or the frames of a camera path.")
    parser.add_argument("target", type=Path, metavar="RUN|FILE", help=f"run folder; with --path also a {SPLAT_FILE}")
    parser.add_argument("--orbit", type=Path, metavar="FILE", help="animate a closed orbit: .gif, .webp or .mp4")
    parser.add_argument("--frames", type=int, default=60, metavar="N", help="frames of the orbit (60)")
    parser.add_argument("--fps", type=positive(float), default=20, help="frames per second of the orbit (20)")
    parser.add_argument("--path", type=Path, metavar="JSON", help="cameras saved by gsx view or nerfstudio")
    parser.add_argument("--movie", type=Path, metavar="FILE", help="animate the path at its own frames per second")
    parser.add_argument("--zoom", type=float, default=1, help="factor on the resolution of training or of the path (1)")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="folder for pictures (RUN/renders/test or .../path)")
    parser.add_axes()
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
    refuse_missing(options.target)
    return options


def parse_view(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx view RUN|FILE [--host ADDRESS] [--port N] [--axes AXES]`."""
    parser = Parser("view", "Look around in a model in the browser. Ctrl-C ends it.")
    words = f"run folder, also during training, or {SPLAT_FILE}"
    parser.add_argument("target", type=Path, metavar="RUN|FILE", help=words)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (127.0.0.1: this machine only)")
    parser.add_argument("--port", type=whole, default=8080, help="port (8080); 0: any free port")
    parser.add_axes()
    options = parser.parse_args(arguments)
    refuse_missing(options.target)
    refuse_axes_of_run(parser.prog, options)
    return options


def parse_export(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx export RUN|FILE [TO] [--view NAME | --bake ZOOM] ...`."""
    description = (
        f"Write a splat file ({', '.join(WRITTEN)}, by the suffix of TO) or a web page (.html) with a viewer; it opens "
        "from disk. The file is read back and compared with the model. FILE is converted to another format."
    )
    parser = Parser("export", description)
    parser.add_argument("run", type=Path, metavar="RUN|FILE", help=f"run folder or {SPLAT_FILE}")
    parser.add_argument("file", type=Path, nargs="?", metavar="TO", help="file to write (RUN/point_cloud.ply)")
    parser.add_argument("--view", metavar="NAME", help="write only the splats that this view draws")
    baked = "for models that decode splats per view: write one file for all views, at ZOOM times their resolution"
    parser.add_argument("--bake", type=positive(float), metavar="ZOOM", default=0.0, help=baked)
    axes = "axes of .spz: rub (SPZ standard) or rdf (as trained; SuperSplat and splat-transform)"
    parser.add_argument("--axes", choices=(SPECIFIED, TRAINED), default=SPECIFIED, help=axes)
    versions = "version of .spz: 3 (most programs) or 4 (states its axes; pip install 'gsx[spz]')"
    parser.add_argument("--spz-version", type=int, choices=SPZ_VERSIONS, default=SPZ_VERSIONS[0], help=versions)
    parser.add_axes("--from-axes")
    local = "for a scene far from (0, 0, 0): write positions relative to its origin; the file states it where it can"
    parser.add_argument("--local", action="store_true", help=local)
    options = parser.parse_args(arguments)
    if options.bake:
        refuse_beyond("gsx export --bake", options.bake, ZOOMS)
    if options.view and options.bake:
        raise InputError("gsx export: --view NAME writes one view, --bake ZOOM all of them: give one of the two")
    refuse_missing(options.run)
    return options


def parse_compact(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx compact RUN|FILE [KEY=VALUE ...] [--max-drop-db DB] [--steps N] [--to FOLDER]`."""
    description = (
        "Shrink a model: remove primitives and colour bands that the pictures do not need, then train on for a "
        "while. Writes a run folder with splat files and a page that compares both models. A splat FILE of any "
        "program needs its scene: scene=colmap scene.path=FOLDER."
    )
    parser = Parser("compact", description, "RUN|FILE [KEY=VALUE ...] [options]")
    parser.add_argument("target", type=Path, metavar="RUN|FILE", help=f"run folder or {SPLAT_FILE}")
    parser.add_overrides("settings to change")
    drop = "largest PSNR drop at any zoom (0.1)"
    parser.add_argument("--max-drop-db", type=positive(float), default=0.1, metavar="DB", help=drop)
    parser.add_argument("--steps", type=whole, metavar="N", help="training steps per candidate (a tenth of the run's)")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="new run folder (RUN_compact)")
    options = parser.parse_intermixed_args(arguments)
    refuse_beyond("gsx compact --steps", options.steps or 0, Range(0, MOST_STEPS))
    for word in options.overrides:
        if word.lstrip("+~").partition("=")[0] in ("output", "folder", "reuse"):
            raise ConfigError(f"gsx compact does not take '{word}': --to FOLDER names the folder of the smaller run")
    refuse_missing(options.target)
    return options


def parse_merge(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx merge DIR [DIR ...] --to FILE`."""
    description = (
        "Join runs that were trained on the blocks of a scene (scene.block=1/3 and so on) to one splat file, and "
        "measure it on the test views of the whole scene."
    )
    parser = Parser("merge", description)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="run, or folder with runs below it")
    parser.add_argument("--to", type=Path, required=True, metavar="FILE", help="splat file to write")
    return parser.parse_args(arguments)


def parse_report(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx report DIR [DIR ...] [--to FOLDER]`."""
    parser = Parser("report", "Write report.html of one run, or one page that compares all runs below some folders.")
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="run, or folder with runs below it")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="folder for the page (DIR, or the common parent)")
    return parser.parse_args(arguments)


def parse_scenes(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx scenes PATH [--poses]`."""
    description = "Check a folder before training: format, cameras, images, points, sharpness, exposure and coverage."
    parser = Parser("scenes", description)
    parser.add_argument("path", type=Path, metavar="PATH", help="folder of a scene")
    poses = "first estimate missing camera poses, which takes minutes, then check coverage as well"
    parser.add_argument("--poses", action="store_true", help=poses)
    return parser.parse_args(arguments)


def parse_datasets(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx datasets [NAME ...] [data_root=FOLDER] [--get NAME [--to FOLDER]]`."""
    description = (
        "List public datasets: the folders that gsx expects below data_root, what is missing, size and licence. With "
        "--get NAME fetch one: a cut download continues, archives are compared with their checksum and unpacked."
    )
    parser = Parser("datasets", description, "[NAME ...] [--get NAME [dataset.scene=SCENE]] [data_root=FOLDER]")
    parser.add_argument("words", nargs="*", metavar="NAME", help="datasets (all)")
    parser.add_argument("--get", metavar="NAME", help="dataset to fetch; dataset.scene=SCENE: only this scene")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="folder for it, as data_root=FOLDER (data)")
    options = parser.parse_intermixed_args(arguments)
    if options.to and (not options.get or any(word.startswith("data_root=") for word in options.words)):
        raise InputError("gsx datasets: --to FOLDER goes with --get NAME, in place of data_root=FOLDER")
    if options.get and (names := [word for word in options.words if "=" not in word]):
        raise InputError(f"gsx datasets --get fetches one dataset: leave {names[0]} for another call")
    return options


def parse_explain(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx explain KEY [KEY=VALUE ...]`."""
    description = "Explain a setting or a group: its value, its range, its meaning, and the file that sets it."
    parser = Parser("explain", description, "KEY [KEY=VALUE ...]")
    words = "for example training.supersampling.factor, backbone, backbone=scaffold"
    parser.add_argument("key", metavar="KEY", help=words)
    parser.add_overrides("settings that differ from the default")
    return parser.parse_args(arguments)


def parse_plugins(arguments: list[str]) -> argparse.Namespace:
    """Parse `gsx plugins`."""
    return Parser("plugins", "List installed components, their packages, and plugins that failed to load.").parse_args(
        arguments
    )
