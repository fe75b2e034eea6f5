"""gsx trade rasterizer."""

import argparse
import logging
import sys
from pathlib import Path

from gsx.builtin import plugins
from gsx.cli.arguments import Parser, new_folder, positive, whole
from gsx.core.errors import ConfigError, InputError, nearest

logger = logging.getLogger("gsx.cli")


def trade_arguments(arguments: list[str]) -> argparse.Namespace:
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
    given, unknown = parser.parse_known_intermixed_args(arguments)
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


def verb_trade(arguments: list[str]) -> int:
    """gsx trade rasterizer [RUN or FILE.ply] [KEY=VALUE ...] ..."""
    if arguments[:1] in (["--help"], ["-h"]):
        arguments = ["rasterizer", "--help"]
    if not arguments:
        raise InputError("gsx trade needs to know what to trade: gsx trade rasterizer [RUN or FILE.ply]")
    if arguments[0] != "rasterizer":
        remedy = "gsx trade rasterizer [RUN or FILE.ply] [KEY=VALUE ...]"
        raise ConfigError(
            f"'{arguments[0]}' is nothing gsx can trade.{nearest(arguments[0], ['rasterizer'])} Type {remedy}"
        )
    given = trade_arguments(arguments[1:])
    from gsx.experiments.trade.advice import advice_lines, table
    from gsx.experiments.trade.knobs import check_knobs
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
