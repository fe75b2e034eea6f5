"""gsx compact."""

import sys
from pathlib import Path

from gsx.builtin import plugins
from gsx.cli.arguments import PLACES, Parser, positive, refuse_beyond, refuse_overrides, whole
from gsx.core.errors import InputError
from gsx.core.ranges import MOST_STEPS, Range
from gsx.engine.collector import loading
from gsx.formats.suffixes import META, READABLE, splat_file_at


def verb_compact(arguments: list[str]) -> int:
    """gsx compact RUN|FILE [KEY=VALUE ...] [--max-drop-db DB] [--steps N] [--to FOLDER]"""
    parser = Parser(
        prog="gsx compact",
        usage="%(prog)s RUN|FILE [KEY=VALUE ...] [options]",
        description="Make the smallest model that looks the same: primitives and bands of colour that the pictures do "
        "not need go, the rest learns on for a while. A run folder comes out, with splat files and a page that shows "
        "both. FILE: of any program, with the scene that judges it (scene=colmap scene.path=FOLDER).",
    )
    parser.add_argument("target", type=Path, metavar="RUN|FILE", help=f"run folder, or splat file: {READABLE}")
    parser.add_overrides("values in place of the run's own")
    parser.add_argument(
        "--max-drop-db",
        type=positive(float),
        default=0.1,
        metavar="DB",
        help="PSNR that may be lost, at any zoom (0.1)",
    )
    parser.add_argument("--steps", type=whole, metavar="N", help="of learning on, in each try (a tenth of the run's)")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="new run folder (RUN_compact)")
    given = parser.parse_intermixed_args(arguments)
    refuse_beyond("gsx compact --steps", given.steps or 0, Range(0, MOST_STEPS))
    refuse_overrides(
        "gsx compact", given.overrides, dict.fromkeys(PLACES, "--to FOLDER says where the smaller run goes")
    )
    if not given.target.exists():
        raise InputError(f"'{given.target}' does not exist: give a run folder or a splat file")
    with loading():
        from gsx.experiments.compact.compact import compact

    file = splat_file_at(given.target)
    to = given.to or compact_folder(file.resolve())
    page = compact(file, to, given.max_drop_db, given.steps, given.overrides, plugins())
    sys.stdout.write(f"{page}\n")
    return 0


def compact_folder(target: Path) -> Path:
    """Return the new folder next to a run or a splat file, named after it."""
    place = target.parent if target.name.lower() == META else target
    return place.with_name(f"{place.name.split('.')[0] if place.is_file() else place.name}_compact")
