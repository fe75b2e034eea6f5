"""Plans the runs of a table: all runs, those that are done, and those with a common beginning.

Runs of one scene, backbone and seed that differ in their augmenters alone are identical until the first of them makes
pseudo views. One of each such group, the one that goes on longest without (the run without any, where there is one), is
trained first and leaves its state wherever another of them sets out; the others branch from there (`runs.warm_start`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from gsx.core.errors import ConfigError, nearest
from gsx.core.ranges import LARGEST_SEED, Range
from gsx.core.training.augmenter import KnownStart
from gsx.engine.cache import content_key
from gsx.experiments.reports.page import counted
from gsx.experiments.run_folder.files import read_run
from gsx.experiments.run_folder.run_key import finished, place_of, scene_stamp, sorted_items, trained
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.warm_start import without_augmenters


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A table to be filled; values in conf/experiment."""

    name: str
    title: str
    published: str
    """The paper's table, a file of conf/published; empty: there is none."""
    datasets: list[str]
    """Names of conf/dataset; dataset=NAME on the command line replaces them."""
    baseline: str
    """Row that gains are over."""
    rows: dict[str, str]
    """By row a variant's name, or overrides with spaces between them."""
    quoted: dict[str, str] = field(default_factory=dict)
    """Reasons of rows that are not run."""
    overrides: list[str] = field(default_factory=list)
    """Overrides of every run."""
    seeds: Annotated[list[int], Range(0, LARGEST_SEED)] = field(default_factory=lambda: [0])
    only: list[str] = field(default_factory=list)
    """Rows that are run; empty: all."""
    scenes: list[str] = field(default_factory=list)
    """Scenes that are run; empty: all of the datasets."""
    dry: bool = False
    """Print the commands, and run nothing."""

    def __post_init__(self) -> None:
        for row in self.only:
            self.refuse_unless("only", row, list(self.rows))
        self.refuse_unless("baseline", self.baseline, [*self.rows, *self.quoted])
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"experiment.seeds is {list(self.seeds)}; give different ones, for example [0,1,2]")

    def refuse_unless(self, key: str, row: str, known: Sequence[str]) -> None:
        """Raises ValueError for a key's row unless it is one of these."""
        if row not in known:
            raise ValueError(
                f"experiment.{key}: '{row}' is no row of {self.name}; it has {', '.join(known)}.{nearest(row, known)}"
            )

    @property
    def chosen(self) -> dict[str, str]:
        """Returns variant or overrides of each row that is run."""
        return {row: variant for row, variant in self.rows.items() if not self.only or row in self.only}


def words_of(row: str) -> list[str]:
    """Returns the overrides that a row of `Experiment.rows` stands for."""
    return row.split() if "=" in row else [f"variant={row}"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Cell:
    """One run of a table."""

    row: str
    dataset: str
    scene: str
    """Folder name."""
    seed: int
    overrides: list[str]
    settings: Settings
    stamp: str
    """Stamp of its scene when the table was planned."""

    @property
    def config(self) -> dict[str, Any]:
        """Returns the resolved composition."""
        return self.settings.resolved

    @property
    def folder(self) -> Path:
        """Returns the run folder; other cells with the same composition share it."""
        return place_of(self.config, self.stamp, self.settings.idle)

    @property
    def finished(self) -> bool:
        """Returns whether its run is done."""
        return finished(read_run(self.folder), self.config, self.stamp, self.settings.idle)

    @property
    def begins(self) -> int:
        """Counts the steps in common with a run without augmenters; 0 where an augmenter does not foretell it."""
        iterations, options = self.settings.general.iterations, [a.options for a in self.settings.augmenters.values()]
        begins = [option.begins(iterations) if isinstance(option, KnownStart) else 0 for option in options]
        return min([iterations, *begins])

    @property
    def beginning(self) -> str:
        """Returns a key that runs share which can branch from each other."""
        return content_key(sorted_items(trained(without_augmenters(self.config), self.settings.idle)), self.stamp)


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan:
    """The runs of a table and their order."""

    experiment: Experiment
    datasets: dict[str, Any]
    """The datasets as composed, by name."""
    cells: list[Cell]
    done: int
    """Different runs that are finished."""
    phases: list[list[list[str]]]
    """Overrides of the runs to be started, phase by phase."""
    steps: int
    """Steps of the runs to be started."""
    shared: int
    """Steps among these that are shared with other runs."""


def cells_of(
    experiment: Experiment,
    datasets: dict[str, Any],
    words: Callable[[str], Sequence[str]],
    compose: Callable[[list[str]], Settings],
) -> Iterator[Cell]:
    """Yields every run of a table, in its order: scene by scene, row by row, seed by seed.

    `words`: returns the overrides of the command line that fit a row.

    Raises:
        ConfigError: a composition is wrong.
    """
    stamps: dict[str, str] = {}
    for name, dataset in datasets.items():
        for scene in dataset["scenes"]:
            if experiment.scenes and scene not in experiment.scenes:
                continue
            for row, what in experiment.chosen.items():
                for seed in experiment.seeds:
                    overrides = [f"dataset={name}", *words_of(what), *experiment.overrides, *words(what)]
                    overrides += [f"dataset.scene={scene}", f"seed={seed}", "reuse=true"]
                    settings = compose(overrides)
                    options = str(settings.resolved["scene"])  # folders may be large: read each once
                    stamps[options] = stamps.get(options) or scene_stamp(settings.resolved)
                    yield Cell(
                        row=row,
                        dataset=name,
                        scene=scene,
                        seed=seed,
                        overrides=overrides,
                        settings=settings,
                        stamp=stamps[options],
                    )


def planned(experiment: Experiment, datasets: dict[str, Any], cells: Sequence[Cell], together: bool = False) -> Plan:
    """Plans which cells are run, in which order; `together`: by a launcher that runs several at once.

    One after the other each group is run as a whole, so that few states need be kept at a time.
    """
    runs = {cell.folder: cell for cell in reversed(cells)}  # of cells with one run the first
    due = [cell for cell in cells if runs[cell.folder] is cell and not cell.finished]
    groups: dict[str, list[Cell]] = {}
    for cell in due:
        groups.setdefault(cell.beginning, []).append(cell)
    first: list[list[str]] = []
    second: list[list[str]] = []
    shared = 0
    for members in groups.values():
        leader = max(members, key=lambda cell: cell.begins)
        others = [cell for cell in members if cell is not leader]
        first.append(with_states(leader, others))
        (second if together else first).extend(with_states(cell, others) for cell in others)
        shared += sum(cell.begins for cell in others)
    return Plan(
        experiment=experiment,
        datasets=datasets,
        cells=list(cells),
        done=len(runs) - len(due),
        phases=[phase for phase in (first, second) if phase],
        steps=sum(cell.settings.general.iterations for cell in due),
        shared=shared,
    )


def with_states(cell: Cell, others: Sequence[Cell]) -> list[str]:
    """Returns a run's overrides, so that it leaves its state where others branch off."""
    steps = sorted({other.begins for other in others if 0 < other.begins < other.settings.general.iterations})
    if not steps:
        return [*cell.overrides, "init=scratch"]
    return [*cell.overrides, "init=warm_start", f"warm_start_at=[{','.join(map(str, steps))}]"]


def plan_lines(plan: Plan) -> list[str]:
    """Describes the plan in lines."""
    runs = sum(map(len, plan.phases))
    rows, seeds = len(plan.experiment.chosen), len(plan.experiment.seeds)
    scenes = len({(cell.dataset, cell.scene) for cell in plan.cells})
    size = f"{rows} rows, {counted(scenes, 'scene')}, {counted(seeds, 'seed')}"
    lines = [f"{plan.experiment.title}: {size}: {plan.done} runs finished, {runs} to train"]
    if plan.shared:
        lines.append(f"common beginnings are trained once: {plan.shared:,} of {plan.steps:,} steps are saved")
    return lines


def check_scenes(experiment: Experiment, datasets: dict[str, Any]) -> None:
    """Raises ConfigError for scenes that no dataset has."""
    known = [scene for dataset in datasets.values() for scene in dataset["scenes"]]
    for scene in experiment.scenes:
        if scene not in known:
            raise ConfigError(
                f"experiment.scenes: '{scene}' is no scene of {', '.join(datasets)}; there are {', '.join(known)}."
                f"{nearest(scene, known)}"
            )
    if not known:
        raise ConfigError(f"{', '.join(datasets)} has no scenes: name them, +dataset.scenes.FOLDER=NAME")
