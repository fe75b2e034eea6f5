"""A table from its command line to its files: plan, run what is missing, gather, write."""

import logging
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsx.core.cache import content_key
from gsx.core.config import Compositions, parse_overrides, typed
from gsx.core.errors import ConfigError
from gsx.core.files import replace_file
from gsx.core.overview import write_overview
from gsx.core.plugins import Plugins
from gsx.experiments.datasets import missing
from gsx.experiments.plan import Cell, Experiment, Plan, cells_of, check_scenes, planned, told
from gsx.experiments.published import read_table
from gsx.experiments.table import Table, protocol_differences, table_of
from gsx.experiments.table_text import as_csv, as_latex, as_markdown, as_text

logger = logging.getLogger(__name__)

OWN = ("experiment", "dataset", "hydra")
"""Keys of the command line that are not handed on to every run as they are."""


def key_of(word: str) -> str:
    """The key of an override, without what is below it."""
    return word.lstrip("+~").partition("=")[0].split(".")[0].split("/")[0].split("@")[0]


def is_below_dataset(word: str) -> bool:
    """Whether an override changes something of the dataset instead of choosing one."""
    return word.lstrip("+").startswith("dataset.")


def is_table(words: Sequence[str]) -> bool:
    """Whether a command line asks for a table."""
    return any(word.lstrip("+").startswith("experiment=") for word in words)


def run_table(words: Sequence[str], plugins: Plugins, job: Callable[[Any], Any]) -> tuple[str, int]:
    """Run what is missing of a table; returns its text and the exit code: 2 if figures are missing.

    `job` carries out one composition.

    Raises:
        ConfigError: an experiment, dataset or override is wrong; nothing was run.
    """
    words = [word.lstrip("+") if is_table([word]) else word for word in words]
    common = [word for word in words if key_of(word) not in OWN or is_below_dataset(word)]
    with Compositions(plugins) as compositions:
        refuse_sweeps(common)
        experiment: Experiment = typed(Experiment, compositions.node(words, "experiment"), "experiment")
        datasets = datasets_of(experiment, words, compositions)
        check_scenes(experiment, datasets)
        cells = list(cells_of(experiment, datasets, common, compositions.settings))
        foreign = protocol_of(experiment, cells, compositions)
        lacking = lacking_of(cells, datasets)
        plan = planned(experiment, datasets, [c for c in cells if (c.dataset, c.scene) not in lacking])
        folder = folder_of(plan, cells[0].config, common)
        tell(plan, lacking)
        if experiment.dry:
            return "".join(f"gsx {shlex.join(job)}\n" for phase in plan.phases for job in phase), 0
        for number, phase in enumerate(plan.phases):
            own = [word for word in words if key_of(word) == "hydra"]
            compositions.launch([*own, f"hydra.sweep.dir={folder / 'launched' / str(number)}"], phase, job)
    published = read_table(experiment.published) if experiment.published else None
    table = table_of(experiment, datasets, cells, published, lacking, foreign)
    write_table(table, folder, [cell.folder for cell in cells if cell.folder.is_dir()])
    return f"{as_text(table)}\n{folder / 'table.md'}\n", 0 if set(table.states) == {"ok"} else 2


def refuse_sweeps(words: Sequence[str]) -> None:
    """Raise ConfigError for words that ask for several values: a table has rows, scenes and seeds for that."""
    for override in parse_overrides(words):
        if override.is_sweep_override():
            remedy = "experiment.seeds=[0,1,2]" if override.key_or_group == "seed" else "another table"
            raise ConfigError(f"'{override.input_line}' asks for several values, which a table does not take: {remedy}")


def datasets_of(experiment: Experiment, words: Sequence[str], compositions: Compositions) -> dict[str, Any]:
    """The datasets of a table as composed, by name: that of the command line, or the paper's."""
    asked = [word.partition("=")[2] for word in words if word.startswith("dataset=")]
    below = [word for word in words if is_below_dataset(word)]
    names = asked[-1:] or experiment.datasets
    return {name: compositions.node([f"dataset={name}", *below], "dataset") for name in names}


def protocol_of(experiment: Experiment, cells: Sequence[Cell], compositions: Compositions) -> list[str]:
    """In what the rows differ from the paper's, by one scene of each."""
    home = experiment.datasets[0]
    of_rows = {cell.row: cell for cell in reversed(cells)}.values()

    def published(cell: Cell) -> dict[str, Any]:
        name = cell.dataset if cell.dataset in experiment.datasets else home
        variant = experiment.rows[cell.row]
        return compositions.settings([f"dataset={name}", f"variant={variant}", *experiment.overrides]).resolved

    return protocol_differences([(cell.config, published(cell)) for cell in of_rows])


def lacking_of(cells: Sequence[Cell], datasets: dict[str, Any]) -> dict[tuple[str, str], str]:
    """Why scenes cannot be trained, by dataset and scene."""
    places = {(cell.dataset, cell.scene): Path(cell.settings.general.data_root) for cell in cells}
    reasons = {(name, scene): missing(datasets[name], scene, root) for (name, scene), root in places.items()}
    return {place: reason for place, reason in reasons.items() if reason}


def folder_of(plan: Plan, config: dict[str, Any], common: Sequence[str]) -> Path:
    """Where a table is written: other overrides, another folder."""
    told = [plan.experiment.name, *plan.datasets, config["budget"]["name"]]
    choice = (list(common), plan.experiment.seeds, plan.experiment.only, plan.experiment.scenes)
    plain = choice == ([word for word in common if key_of(word) == "budget"], [0], [], [])
    return Path(config["output"]) / "experiments" / "_".join([*told, *([] if plain else [content_key(choice)[:6]])])


def tell(plan: Plan, lacking: dict[tuple[str, str], str]) -> None:
    """Say what is about to happen."""
    for line in told(plan):
        logger.info("%s", line)
    for reason in dict.fromkeys(lacking.values()):
        logger.warning("not run: %s (`gsx datasets` says where to get it)", reason)


def write_table(table: Table, folder: Path, runs: Sequence[Path]) -> None:
    """table.csv, table.md and table.tex, and the report over the runs."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("table.csv", as_csv(table)), ("table.md", as_markdown(table)), ("table.tex", as_latex(table))):
        replace_file(folder / name, text.encode())
    if runs:
        write_overview(folder, list(dict.fromkeys(runs)))
