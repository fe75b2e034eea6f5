"""A table from its command line to its files: plans it, runs what is missing, gathers and writes."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsx.core.errors import ConfigError, InputError, command, first_line, nearest
from gsx.core.files import remove_partial, replace_text
from gsx.core.plugins import Plugins
from gsx.engine.cache import content_key, in_use
from gsx.experiments.reports.overview import write_overview
from gsx.experiments.run_folder.claims import claimed_name, left_behind
from gsx.experiments.run_folder.files import part, reported
from gsx.experiments.run_folder.run_key import NAMES, WHERE, comparable, sorted_items, used_regenerators, without
from gsx.experiments.runs.compose import Compositions
from gsx.experiments.runs.job import finish_leftovers
from gsx.experiments.runs.multirun import launch_jobs
from gsx.experiments.runs.overrides import key_of, parse_overrides, refuse_absent_slurm
from gsx.experiments.runs.typed import typed
from gsx.experiments.tables.datasets import missing
from gsx.experiments.tables.plan import Cell, Experiment, Plan, cells_of, check_scenes, plan_lines, planned, words_of
from gsx.experiments.tables.published import read_table
from gsx.experiments.tables.table import Table, table_of
from gsx.experiments.tables.table_text import as_csv, as_latex, as_markdown, as_text

logger = logging.getLogger(__name__)

PARTS = ("regenerator", "augmenter", "backbone")
"""Groups whose keys not every row has."""
TAKEN = {
    "seed": "experiment.seeds=[0,1,2]",
    "variant": "experiment.only=[ROW,...] chooses rows",
    "dataset.scene": "experiment.scenes=[NAME,...] chooses scenes",
    "reuse": "leave it out",
    "minutes": "budget=quick or iterations=N shortens all runs alike",
    "seconds": "budget=quick or iterations=N shortens all runs alike",
    "init": "leave it out",
    "warm_start_at": "leave it out",
    "folder": "output=FOLDER",
}
"""Remedies by key that a table sets for each run."""
OWN = ("experiment", "dataset", "hydra")
"""Keys of the command line that are not passed to every run as they are."""


def is_below_dataset(word: str) -> bool:
    """Returns whether an override changes something of the dataset instead of choosing one."""
    return word.lstrip("+~").startswith("dataset.")


def is_table(overrides: Sequence[str]) -> bool:
    """Returns whether a command line names a table."""
    return any(word.lstrip("+").startswith("experiment=") for word in overrides)


def with_plus(words: Sequence[str]) -> list[str]:
    """Returns words with `+` before the choice of a table, which the configuration has no default of."""
    return [f"+{word.lstrip('+')}" if is_table([word]) else word for word in words]


def run_table(overrides: Sequence[str], plugins: Plugins, job: Callable[[Any], Any]) -> tuple[str, int]:
    """Runs what is missing of a table; returns its text and the exit code: 2 if figures are missing.

    `job` carries out one composition.

    Raises:
        ConfigError: an experiment, dataset or override is wrong; nothing was run.
    """
    overrides = with_plus(overrides)
    logger.info("composing the runs of %s ...", " ".join(word for word in overrides if is_table([word])))
    common = [word for word in overrides if key_of(word) not in OWN or is_below_dataset(word)]
    launching = [word for word in overrides if key_of(word) == "hydra"]
    with in_use(), Compositions(plugins) as compositions:  # its runs begin with states of each other
        refuse_overrides(common)
        chosen = [word for word in overrides if key_of(word) == "experiment"]
        experiment = experiment_of([*chosen, *launching], compositions)
        datasets = datasets_of(experiment, overrides, compositions)
        check_scenes(experiment, datasets)
        fitting = fitting_words(experiment, list(datasets), common, compositions)
        cells = list(cells_of(experiment, datasets, fitting.__getitem__, compositions.settings))
        plain = experiment_of([word for word in chosen if is_table([word])], compositions)
        foreign = protocol_of(plain, cells, compositions)
        published = read_table(experiment.published) if experiment.published else None
        places = {(cell.dataset, cell.scene): Path(cell.settings.general.data_root) for cell in cells}
        reasons = {(name, scene): missing(datasets[name], scene, root) for (name, scene), root in places.items()}
        lacking = {place: reason for place, reason in reasons.items() if reason}
        due = [cell for cell in cells if (cell.dataset, cell.scene) not in lacking]
        plan = planned(experiment, datasets, due, together=any("launcher=" in word for word in launching))
        folder = folder_of(plan, plain, cells[0].config, common)
        log_plan(plan, lacking)
        if experiment.dry:
            return "".join(f"{command(*job)}\n" for phase in plan.phases for job in phase), 0
        refuse_absent_slurm(launching)
        tidy(folder, due)
        for number, phase in enumerate(plan.phases):
            launched(compositions, launching, folder / "launched" / str(number), phase, job)
    table = table_of(experiment, datasets, cells, published, lacking, foreign)
    write_table(table, folder, [cell.folder for cell in cells if cell.folder.is_dir()])
    return f"{as_text(table)}\n{folder / 'table.md'}\n", 0 if set(table.states) == {"ok"} else 2


def tidy(folder: Path, cells: Sequence[Cell]) -> None:
    """Finishes what killed processes left of runs that are not started again, and of the table's folder."""
    if folder.is_dir():
        remove_partial(folder)
    for run in dict.fromkeys(cell.folder for cell in cells if cell.finished):
        if left_behind(run) or not reported(run):
            with suppress(InputError), claimed_name(run):  # who is at work there does so himself
                finish_leftovers(run)


def launched(
    compositions: Compositions,
    overrides: Sequence[str],
    folder: Path,
    jobs: Sequence[Sequence[str]],
    job: Callable[[Any], Any],
) -> None:
    """Runs a phase. A launcher that fails, for one killed process perhaps, does not end the table."""
    try:
        launch_jobs(overrides, folder, jobs, job)
    except Exception as error:
        logger.warning(
            "the launcher failed (%s: %s): give the same command again for the missing runs",
            type(error).__name__,
            first_line(error),
        )


def experiment_of(overrides: Sequence[str], compositions: Compositions) -> Experiment:
    """Composes the table that these overrides choose and change."""
    experiment: Experiment = typed(Experiment, compositions.node(overrides, "experiment"), "experiment")
    return experiment


def fitting_words(
    experiment: Experiment, datasets: Sequence[str], overrides: Sequence[str], compositions: Compositions
) -> dict[str, list[str]]:
    """Returns the overrides for each row: those of a component (PARTS) only where the row has such a key.

    Raises:
        ConfigError: no row has it.
    """
    particular = [word for word in overrides if key_of(word) in PARTS and "." in word.partition("=")[0]]
    others = [word for word in overrides if word not in particular]
    rows = set(experiment.chosen.values())
    known = {row: compositions.keys([f"dataset={datasets[0]}", *words_of(row), *others]) for row in rows if particular}
    every = sorted({key for keys in known.values() for key in keys})
    for word in particular:
        if not word.startswith(("+", "~")) and (key := word.partition("=")[0]) not in every:
            raise ConfigError(f"'{key}' is no configuration key of any row.{nearest(key, every)}")

    def fits(word: str, row: str) -> bool:
        return word not in particular or word.startswith(("+", "~")) or word.partition("=")[0] in known[row]

    return {row: [word for word in overrides if fits(word, row)] for row in rows}


def refuse_overrides(overrides: Sequence[str]) -> None:
    """Raises ConfigError for overrides that a table sets for each run, or has rows, scenes and seeds for."""
    for override in parse_overrides(overrides):
        if override.is_sweep_override():
            remedy = "experiment.seeds=[0,1,2]" if override.key_or_group == "seed" else "another table"
            raise ConfigError(f"'{override.input_line}' asks for several values, which a table does not take: {remedy}")
    for word in overrides:
        key = word.lstrip("+~").partition("=")[0]
        if key in TAKEN or word.startswith("~dataset"):
            remedy = TAKEN.get(key, "experiment.scenes=[NAME,...] chooses scenes")
            raise ConfigError(f"'{word}' is not for tables, whose runs have it of their own: {remedy}")


def datasets_of(experiment: Experiment, overrides: Sequence[str], compositions: Compositions) -> dict[str, Any]:
    """Composes the datasets of a table by name: that of the command line, or the paper's."""
    chosen = [word.partition("=")[2] for word in overrides if word.startswith("dataset=")]
    below = [word for word in overrides if is_below_dataset(word)]
    names = chosen[-1:] or experiment.datasets
    return {name: compositions.node([f"dataset={name}", *below], "dataset") for name in names}


def protocol_of(experiment: Experiment, cells: Sequence[Cell], compositions: Compositions) -> list[str]:
    """Lists how the rows differ from the paper's, by one scene of each; names rows that the paper does not have."""
    home, by_row = experiment.datasets[0], {cell.row: cell for cell in reversed(cells)}
    added = [f"{row} is no row of its table" for row in by_row if row not in experiment.rows]
    of_rows = [cell for row, cell in by_row.items() if row in experiment.rows]

    def published(cell: Cell) -> dict[str, Any]:
        name = cell.dataset if cell.dataset in experiment.datasets else home
        words = words_of(experiment.rows[cell.row])
        return compositions.settings([f"dataset={name}", *words, *experiment.overrides]).resolved

    return added + protocol_differences([(cell.config, published(cell), cell.settings.idle) for cell in of_rows])


def folder_of(plan: Plan, plain: Experiment, config: dict[str, Any], common: Sequence[str]) -> Path:
    """Returns the folder of a table; other overrides than the published ones make another folder."""
    names = [plan.experiment.name, *plan.datasets, config["budget"]["name"]]
    others = [word for word in common if key_of(word) not in ("budget", "output", "data_root")]
    changed = others or plan.experiment != plain
    key = [content_key(others, sorted_items(vars(plan.experiment)))[:6]] if changed else []
    return Path(config["output"]) / "experiments" / "_".join([*names, *key])


def log_plan(plan: Plan, lacking: dict[tuple[str, str], str]) -> None:
    """Logs what is run, and which scenes are missing."""
    for line in plan_lines(plan):
        logger.info("%s", line)
    for reason in dict.fromkeys(lacking.values()):
        logger.warning("not run: %s (`gsx datasets` says where to get it)", reason)


def write_table(table: Table, folder: Path, runs: Sequence[Path]) -> None:
    """Writes table.csv, table.md, table.tex and the overview of the runs."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("table.csv", as_csv(table)), ("table.md", as_markdown(table)), ("table.tex", as_latex(table))):
        replace_text(folder / name, text)
    if runs:
        write_overview(folder, list(dict.fromkeys(runs)))


PLACES = ("model", "revision", "variant", "dtype", "tiling")
"""Keys of regenerators that say where a model comes from and how it fits into memory."""
LISTED_KEYS = 12
"""Differences from the paper's protocol that are listed."""


def protocol_differences(compared: Sequence[tuple[dict[str, Any], dict[str, Any], frozenset[str]]]) -> list[str]:
    """Lists the keys in which compositions differ, with both values, those of most rows first.

    `compared`: (as run, as published, keys without effect) of each row.
    """
    found: dict[str, list[tuple[str, str]]] = {}
    for own, paper, idle in compared:
        for key, value, published in differing(own, paper, idle):
            found.setdefault(key, []).append((value, published))
    lines = []
    for key in sorted(found, key=lambda key: -len(found[key])):
        ours, theirs = (", ".join(dict.fromkeys(values)) for values in zip(*found[key], strict=True))
        lines.append(f"{key}={ours} (paper: {theirs})")
    more = [f"and {len(lines) - LISTED_KEYS} more"] if len(lines) > LISTED_KEYS else []
    return lines[:LISTED_KEYS] + more


def differing(own: dict[str, Any], paper: dict[str, Any], idle: frozenset[str]) -> Iterator[tuple[str, str, str]]:
    """Yields keys whose values differ, with ours and the paper's; of another component only its name."""
    mine, theirs = (comparable(protocol_settings(config, idle)) for config in (own, paper))
    others = {key.removesuffix(".name") for key in mine if key.endswith(".name") and mine[key] != theirs.get(key)}
    for key in dict.fromkeys([*mine, *theirs]):
        inside = any(key.startswith(f"{other}.") and key != f"{other}.name" for other in others)
        if mine.get(key) != theirs.get(key) and not inside:
            yield key, str(mine.get(key, "absent")), str(theirs.get(key, "absent"))


def protocol_settings(config: dict[str, Any], idle: frozenset[str]) -> dict[str, Any]:
    """Returns the protocol of a composition: all but where it runs, its seed and its zooms."""
    known = without(config, idle)
    kept = {key: value for key, value in known.items() if key not in (*WHERE, *NAMES, "seed")}
    kept["dataset"] = part(known, "dataset").get("title")
    kept["eval"] = without(part(known, "eval"), ("zoom", "tile_pixels"))
    kept["metrics"] = {key: part(part(known, "metrics"), "lpips").get(key) for key in ("net", "input_range")}
    return kept | {"regenerator": placeless(used_regenerators(known))}


def placeless(node: Any) -> Any:
    """Removes from regenerators where their models come from and how they fit into memory."""
    if not isinstance(node, dict):
        return node
    return {key: placeless(value) for key, value in node.items() if key not in PLACES}
