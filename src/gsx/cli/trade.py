"""gsx trade rasterizer, gsx trade training."""

import argparse
import logging
import sys
from pathlib import Path
from typing import Any

from gsx.builtin import plugins
from gsx.cli.arguments import (
    PLACES,
    Parser,
    different_numbers,
    new_folder,
    not_negative,
    positive,
    refuse_beyond,
    refuse_taken,
    whole,
)
from gsx.core.errors import ConfigError, InputError, nearest
from gsx.core.ranges import Range
from gsx.engine.collector import loading
from gsx.formats.suffixes import READABLE, splat_file_at

logger = logging.getLogger("gsx.cli")

MOST_VIEWS = 100
"""Pictures that settings of the rasterizer are measured on: a float64 truth of each is made first."""
USAGE = "gsx trade rasterizer [RUN or FILE] [KEY=VALUE ...] or gsx trade training [KEY=VALUE ...]"


def trade_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of gsx trade; `target` is a path or None, `overrides` what has an equals sign.

    Raises:
        ConfigError: a word means nothing here.
    """
    parser = Parser(
        prog="gsx trade rasterizer",
        usage="%(prog)s [RUN or FILE] [KEY=VALUE ...] [options]",
        description="Try the rasterizer's settings on a model: time each, compare with a float64 truth, recommend "
        "some. Without a model the built-in scene stands in; KEY=VALUE changes the settings to start from. FILE: "
        f"{READABLE}.",
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
    if given.views:
        refuse_beyond(f"{parser.prog} --views", given.views, Range(1, MOST_VIEWS))
    targets = [word for word in given.words if "=" not in word or Path(word).exists()]
    given.overrides = [word for word in given.words if word not in targets]
    if len(targets) > 1:
        raise InputError(f"gsx trade rasterizer takes one run or one splat file, got {' and '.join(targets)}")
    given.target = splat_file_at(Path(targets[0])) if targets else None
    return given


def training_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of gsx trade training; `overrides` is the composition as given.

    Raises:
        ConfigError: a word means nothing here.
    """
    parser = Parser(
        prog="gsx trade training",
        usage="%(prog)s [KEY=VALUE ...] [options]",
        description="Train a composition, and with it what could be had instead: fewer primitives or steps, other "
        "resolutions, filters, colours, levels, pseudo details (conf/trade). Compare, and answer a wish.",
    )
    parser.add_overrides("the composition to start from")
    add = parser.add_argument
    add("--budget-mb", type=positive(float), metavar="MB", help="wish: a splat file of at most so many 10^6 bytes")
    add("--max-drop-db", type=not_negative, metavar="DB", help="wish: at most so much lost at any zoom")
    add("--target-seconds", type=positive(float), metavar="S", help="wish: training takes at most so long")
    add("--settings", default="settings", metavar="NAME", help="what is tried: conf/trade/NAME.yaml, also a plugin's")
    add("--trades", metavar="A,B,...", help="only these of it, for example primitives,steps (all)")
    add("--seeds", type=different_numbers, default=[0], metavar="A,B,...", help="of the runs of each setting (0)")
    add("--combinations", type=whole, default=2, metavar="N", help="most combinations of good settings to try (2)")
    add("--to", type=Path, default=Path("trade"), metavar="FOLDER", help="for trade.html, trade.json, runs (./trade)")
    given = parser.parse_intermixed_args(arguments)
    if given.trades == "":
        raise ConfigError("--trades names none: give some, or leave it out for all of them")
    remedies = dict.fromkeys(PLACES, "runs go below --to FOLDER") | {"seed": "--seeds A,B,... says which"}
    refuse_taken("gsx trade training", given.overrides, remedies)
    return given


def verb_trade(arguments: list[str]) -> int:
    """gsx trade rasterizer [RUN or FILE] [KEY=VALUE ...] ..., gsx trade training [KEY=VALUE ...] ..."""
    verbs = {"rasterizer": trade_rasterizer, "training": trade_training}
    if arguments[:1] in (["--help"], ["-h"]):
        both = "rasterizer: how fast against how exact. training: what it costs against what it brings."
        Parser(prog="gsx trade", usage=USAGE, description=f"{both} Each has a --help of its own.").parse_args(["-h"])
    if not arguments:
        raise InputError(f"gsx trade needs to know what to trade: {USAGE}")
    if arguments[0] not in verbs:
        raise ConfigError(
            f"'{arguments[0]}' is nothing gsx can trade.{nearest(arguments[0], list(verbs))} Type {USAGE}"
        )
    return verbs[arguments[0]](arguments[1:])


def trade_training(arguments: list[str]) -> int:
    """gsx trade training [KEY=VALUE ...] ..."""
    given = training_arguments(arguments)
    with loading():
        from gsx.experiments.runs.build import choose_device
        from gsx.experiments.runs.compose import Compositions
        from gsx.experiments.runs.job import train
        from gsx.experiments.trade.machine import machine
        from gsx.experiments.trade.training.measure import Trial, known, measured
        from gsx.experiments.trade.training.page import write_trade
        from gsx.experiments.trade.training.settings import settings_of
        from gsx.experiments.trade.training.wishes import Wish, advice, advice_lines, table

    loaded, wanted = plugins(), given.trades.split(",") if given.trades is not None else []
    with Compositions(loaded) as compositions:
        settings = settings_of(compositions.node([f"+trade={given.settings}"], "trade"), wanted)
        device = choose_device(compositions.settings(given.overrides).general.device)

    def job(composed: Any) -> Path:
        folders = list[Path]()
        if train(composed, loaded, folders):
            raise KeyboardInterrupt("the same command goes on from here")
        return folders[0]

    folder = new_folder(given.to)
    trial = Trial(given=given.overrides, seeds=given.seeds, folder=folder, job=job, plugins=loaded)
    rows = measured(trial, settings, given.combinations)
    wish = Wish(budget_mb=given.budget_mb, max_drop_db=given.max_drop_db, target_seconds=given.target_seconds)
    first = known(rows)[0]
    told = advice_lines(advice(rows, wish, first.zooms()[-1]), first, given.overrides)
    page = write_trade(rows, wish, given.overrides, machine(device), folder)
    sys.stdout.write("\n".join(["", *table(rows), "", *told]) + f"\n{page}\n")
    return 0


def trade_rasterizer(arguments: list[str]) -> int:
    """gsx trade rasterizer [RUN or FILE] [KEY=VALUE ...] ..."""
    given = trade_arguments(arguments)
    with loading():
        from gsx.experiments.trade.rasterizer.advice import advice_lines, table
        from gsx.experiments.trade.rasterizer.knobs import check_knobs
        from gsx.experiments.trade.rasterizer.measure import sweep, usable_paths
        from gsx.experiments.trade.rasterizer.page import write_trade
        from gsx.experiments.trade.rasterizer.subject import open_subject

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
