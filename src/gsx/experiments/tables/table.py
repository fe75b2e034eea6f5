"""Figures of a table from the folders of its runs, compared with those of the paper."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsx.core.files import read_json
from gsx.engine.cache import source_revision
from gsx.experiments.evaluation.remarks import NOT_MEASURED, incidents_of, measures_nothing
from gsx.experiments.reports.baselines import spread
from gsx.experiments.run_folder.files import (
    RunFiles,
    detail_share,
    gain_of,
    has_figures,
    over_upscaled,
    part,
    perceptual_figure,
    perceptual_names,
    read_run,
    state_of,
)
from gsx.experiments.run_folder.run_key import other_revision
from gsx.experiments.run_folder.shapes import is_number
from gsx.experiments.runs.warm_start import BRANCH
from gsx.experiments.tables.plan import Cell, Experiment
from gsx.experiments.tables.published import Published

MEASURES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "PSNR": lambda e: e.get("psnr"),
    "SSIM": lambda e: e.get("ssim"),
    "LPIPS": lambda e: e.get("lpips"),
    "kGS": lambda e: e["visible_primitives"] / 1000 if is_number(e.get("visible_primitives")) else None,
    "MB": lambda e: e.get("megabytes"),
    "s": lambda e: e.get("train_seconds"),
}
"""By metric, from an evaluation or one of its groups; Mem is the size of the model file, as the paper has it; s: of
training."""
ZOOM_MEASURES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "PSNR": lambda entry: entry.get("psnr"),
    "over enlarged": gain_of,
    "over upscaled": over_upscaled,
    "detail": detail_share,
}
"""By the name of `NAME xK`, from the figures at a zoom; detail: explained, above the training Nyquist frequency."""


@dataclass(frozen=True, kw_only=True)
class Scope:
    """Runs that a figure is a mean over: the scenes of a dataset, one of them, or a group of views in all."""

    title: str
    """As in the paper's table."""
    dataset: str
    scenes: list[str]
    group: str = ""
    paper: str = ""
    """Scope of the paper's figures to compare with; empty: there are none."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One cell of a table."""

    row: str
    scope: str
    metric: str
    ours: float | None
    spread: float | None
    """Half of the range over the seeds; None with a single one."""
    seeds: int
    whole: tuple[str, ...]
    """Scenes with a figure for every seed."""
    of_scenes: int
    paper: float | None
    difference: float | None
    gain: float | None = None
    """Over the baseline's row."""
    gain_spread: float | None = None
    """Half of the range of the gain, each seed against the same seed."""
    paper_gain: float | None = None
    problem: str = ""
    """Why there is no figure."""
    remarks: tuple[str, ...] = ()
    """Remarks on its runs."""
    by_seed: tuple[float, ...] = ()
    """Means over the scenes, seed by seed."""

    @property
    def scenes(self) -> int:
        """Counts the scenes that the figure is a mean over."""
        return len(self.whole)


@dataclass(frozen=True, eq=False, kw_only=True)
class Table:
    """A finished table."""

    experiment: Experiment
    figures: list[Figure]
    scopes: list[Scope]
    metrics: list[str]
    foreign: list[str]
    """Differences from the paper's protocol."""
    notes: list[str]
    seconds: float
    """Seconds of training."""
    saved: float
    """Seconds of training that runs shared by branching."""
    states: dict[str, int] = field(default_factory=dict)
    """Runs by state."""

    def at(self, row: str, scope: str, metric: str) -> Figure:
        """Returns the figure of a row, scope and metric."""
        return next(f for f in self.figures if (f.row, f.scope, f.metric) == (row, scope, metric))


def scopes_of(datasets: dict[str, Any], scenes: Sequence[str], published: Published | None) -> list[Scope]:
    """Lists the scopes: those of the paper's table where its datasets are run, else each dataset as a whole."""
    wholes = [
        Scope(title=dataset["title"], dataset=name, scenes=chosen_scenes(dataset, scenes))
        for name, dataset in datasets.items()
        if chosen_scenes(dataset, scenes)
    ]
    known = [scope for title in (published.scopes if published else []) if (scope := matching(title, datasets, scenes))]
    if published and not known:
        known = [Scope(title=s.title, dataset=s.dataset, scenes=s.scenes, paper=published.scopes[0]) for s in wholes]
    singles = [
        Scope(title=datasets[s.dataset]["scenes"][scene], dataset=s.dataset, scenes=[scene])
        for s in wholes
        for scene in s.scenes
        if len(s.scenes) > 1
    ]
    listed = {(tuple(scope.scenes), scope.group) for scope in known}
    return known + [scope for scope in [*wholes, *singles] if (tuple(scope.scenes), "") not in listed]


def chosen_scenes(dataset: dict[str, Any], scenes: Sequence[str]) -> list[str]:
    """Lists the scenes of a dataset that are run."""
    return [scene for scene in dataset["scenes"] if not scenes or scene in scenes]


def matching(title: str, datasets: dict[str, Any], scenes: Sequence[str]) -> Scope | None:
    """Returns the scope of that title in the paper, if it is among those that are run."""
    for name, dataset in datasets.items():
        chosen = chosen_scenes(dataset, scenes)
        some = "" if len(chosen) == len(dataset["scenes"]) else f" ({len(chosen)} of {len(dataset['scenes'])} scenes)"
        if title in (dataset["title"], f"{dataset['title']} (Average)"):
            return Scope(title=title + some, dataset=name, scenes=chosen, paper="" if some else title)
        if title.startswith("Scale-"):
            paper = "" if some else title
            return Scope(title=title + some, dataset=name, scenes=chosen, group=title.lower(), paper=paper)
        for scene in chosen:
            if dataset["scenes"][scene] == title:
                return Scope(title=title, dataset=name, scenes=[scene], paper=title)
    return None


def table_of(
    experiment: Experiment,
    datasets: dict[str, Any],
    cells: Sequence[Cell],
    published: Published | None,
    lacking: dict[tuple[str, str], str],
    foreign: list[str],
) -> Table:
    """Gathers the table from its runs; `lacking`: reasons why scenes cannot be run, by dataset and scene."""
    files = {cell.folder: read_run(cell.folder) for cell in cells}
    scopes = scopes_of(datasets, experiment.scenes, published)
    zooms = sorted({z for run in files.values() for z in part(run.evaluation, "zoom") if float(z) > 1}, key=float)
    zoomed = [f"{name} x{zoom}" for name in (*ZOOM_MEASURES, *perceptual(files)) for zoom in zooms]
    known = [name for name in zoomed if any(zoom_figure(run.evaluation, name) is not None for run in files.values())]
    metrics = [*(published.metrics if published else ["PSNR", "SSIM", "LPIPS", "s"]), *perceptual(files), *known]
    figures = [
        figure(row, scope, metric, [c for c in cells if c.row == row], files, published, lacking)
        for scope in scopes
        for row in rows_of(experiment)
        for metric in metrics
    ]
    return Table(
        experiment=experiment,
        figures=with_gains(figures, experiment.baseline),
        scopes=scopes,
        metrics=metrics,
        foreign=foreign,
        notes=notes_of(experiment, cells, files, published),
        seconds=sum(seconds_of(run) for run in files.values()),
        saved=sum(saved_by(folder) for folder in files),
        states=counted(files, cells, lacking),
    )


def perceptual(files: dict[Path, RunFiles]) -> list[str]:
    """Lists the perceptual metrics of which any run has figures."""
    return list(dict.fromkeys(name for run in files.values() for name in perceptual_names(run.evaluation)))


def rows_of(experiment: Experiment) -> list[str]:
    """Lists the rows of the table: quoted ones first."""
    return [*experiment.quoted, *experiment.chosen]


def figure(
    row: str,
    scope: Scope,
    metric: str,
    cells: Sequence[Cell],
    files: dict[Path, RunFiles],
    published: Published | None,
    lacking: dict[tuple[str, str], str],
) -> Figure:
    """Computes a cell: the mean over scenes of the mean over seeds, if all of them are done."""
    inside = [cell for cell in cells if cell.dataset == scope.dataset and cell.scene in scope.scenes]
    found = {(cell.scene, cell.seed): measured(files[cell.folder], metric, scope.group) for cell in inside}
    values = {place: value for place, value in found.items() if value is not None}
    seeds = sorted({cell.seed for cell in inside})
    whole = [scene for scene in scope.scenes if seeds and all((scene, seed) in values for seed in seeds)]
    complete = bool(whole) and len(whole) == len(scope.scenes)
    by_seed = [statistics.fmean(values[scene, seed] for scene in whole) for seed in seeds] if whole else []
    ours = statistics.fmean(by_seed) if by_seed else None
    paper = published.figures.get((row, scope.paper, metric)) if published else None
    return Figure(
        row=row,
        scope=scope.title,
        metric=metric,
        ours=ours,
        spread=spread(by_seed) if len(by_seed) > 1 else None,
        seeds=len(seeds),
        whole=tuple(whole),
        of_scenes=len(scope.scenes),
        paper=paper,
        difference=ours - paper if complete and ours is not None and paper is not None else None,
        problem="" if complete else problem_of(inside, files, lacking, metric),
        remarks=tuple(dict.fromkeys(remark for cell in inside for remark in remarks_on(cell, files))),
        by_seed=tuple(by_seed),
    )


def remarks_on(cell: Cell, files: dict[Path, RunFiles]) -> list[str]:
    """Lists the remarks on a run, with its row and scene."""
    return [f"{cell.row}, {cell.scene}: {remark}" for remark in incidents_of(files[cell.folder].evaluation)]


def measured(files: RunFiles, metric: str, group: str) -> float | None:
    """Returns a figure of a run that is done."""
    if not has_figures(files):
        return None
    if " x" in metric:
        value = None if group else zoom_figure(files.evaluation, metric)
    else:
        entry = part(part(files.evaluation, "groups"), group) if group else files.evaluation
        value = MEASURES[metric](entry) if metric in MEASURES else perceptual_figure(entry, metric)
    return value if is_number(value) else None


def zoom_figure(evaluation: dict[str, Any], metric: str) -> float | None:
    """Returns the figure of `NAME xK`, by ZOOM_MEASURES."""
    name, _, factor = metric.partition(" x")
    entry = part(part(evaluation, "zoom"), factor)
    value = ZOOM_MEASURES[name](entry) if name in ZOOM_MEASURES else perceptual_figure(entry, name)
    return value if is_number(value) else None


def problem_of(
    cells: Sequence[Cell], files: dict[Path, RunFiles], lacking: dict[tuple[str, str], str], metric: str
) -> str:
    """Returns why figures are missing, by the first run that lacks one."""
    for cell in cells:
        if (reason := lacking.get((cell.dataset, cell.scene))) and not files[cell.folder].evaluation:
            return f"no data: {reason}"
        state, why = state_of(files[cell.folder])
        if not files[cell.folder].config:
            return "not run yet"
        if not has_figures(files[cell.folder]):
            return f"{state}: {why}"
        if measures_nothing(files[cell.folder].evaluation):
            return NOT_MEASURED
    remedy = ": give metrics.lpips.trunk=FILE and metrics.lpips.head=FILE" if metric == "LPIPS" else ""
    return f"{metric} is not measured{remedy}" if cells else "not run"


def with_gains(figures: Sequence[Figure], baseline: str) -> list[Figure]:
    """Adds to figures their gains over the baseline's row."""
    base = {(f.scope, f.metric): f for f in figures if f.row == baseline}

    def gain(f: Figure, value: float | None, other: float | None) -> float | None:
        return value - other if value is not None and other is not None and f.row != baseline else None

    out = []
    for f in figures:
        b = base.get((f.scope, f.metric))
        same = b is not None and f.whole == b.whole
        ours = gain(f, f.ours, b.ours) if b and same else None
        theirs = gain(f, f.paper, b.paper) if b else None
        gains = [value - other for value, other in zip(f.by_seed, b.by_seed, strict=True)] if b and same else []
        varied = spread(gains) if ours is not None and len(gains) > 1 else None
        out.append(replace(f, gain=ours, gain_spread=varied, paper_gain=theirs))
    return out


def seconds_of(files: RunFiles) -> float:
    """Returns the seconds of training that a run has taken itself."""
    seconds = files.evaluation.get("train_seconds")
    if not is_number(seconds):
        seconds = files.lines[-1].get("seconds", 0.0) if files.lines else 0.0
    return max(0.0, float(seconds) - saved_by(files.folder))


def saved_by(folder: Path) -> float:
    """Returns the seconds of training that a run saved by branching from another."""
    try:
        return float(read_json(folder / BRANCH)["seconds"])
    except (OSError, ValueError, KeyError):
        return 0.0


def counted(files: dict[Path, RunFiles], cells: Sequence[Cell], lacking: dict[tuple[str, str], str]) -> dict[str, int]:
    """Counts runs by state."""
    counts: dict[str, int] = {}
    for folder, run in files.items():
        absent = any((cell.dataset, cell.scene) in lacking for cell in cells if cell.folder == folder)
        state = state_of(run)[0] if run.config else "without data" if absent else "not run"
        counts[state] = counts.get(state, 0) + 1
    return counts


def notes_of(
    experiment: Experiment, cells: Sequence[Cell], files: dict[Path, RunFiles], published: Published | None
) -> list[str]:
    """Lists the notes below the figures."""
    notes = [f"{row}: {reason}" for row, reason in experiment.quoted.items()]
    notes += dict.fromkeys(f"* {remark}" for cell in cells for remark in remarks_on(cell, files))
    notes += [f"corrected: {note}" for note in (published.notes if published else [])]
    shared: dict[Path, list[str]] = {}
    for cell in cells:
        if cell.row not in shared.setdefault(cell.folder, []):
            shared[cell.folder].append(cell.row)
    same = [" and ".join(rows) for rows in shared.values() if len(rows) > 1]
    notes += dict.fromkeys(f"{rows} are the same composition here" for rows in same)
    notes += of_other_revisions(cells, files)
    of_scenes: dict[str, None] = {}
    for cell in cells:
        listed = part(files[cell.folder].environment, "scene").get("notes")
        of_scenes |= dict.fromkeys(f"{cell.scene}: {note}" for note in (listed if isinstance(listed, list) else []))
    notes += of_scenes
    devices = {str(run.environment.get("device")) for run in files.values() if run.environment}
    if len(devices) > 1:
        notes.append(f"these runs were trained on different devices: {', '.join(sorted(devices))}")
    return notes


def of_other_revisions(cells: Sequence[Cell], files: dict[Path, RunFiles]) -> list[str]:
    """Names the rows with results of another revision of gsx's source, and in how many of their runs."""
    this = source_revision()
    revisions = {folder: other_revision(run, this) for folder, run in files.items() if run.evaluation}
    notes = []
    for revision in sorted({revision for revision in revisions.values() if revision}):
        shares = [share_of(row, revision, cells, revisions) for row in dict.fromkeys(cell.row for cell in cells)]
        rows = ", ".join(share for share in shares if share)
        notes.append(f"trained by another revision of gsx's source ({revision}, this is {this}): {rows}")
    return notes


def share_of(row: str, revision: str, cells: Sequence[Cell], revisions: dict[Path, str]) -> str:
    """Describes how many results of a row are of a revision; empty if none is. `revisions`: by folder."""
    of_row = [revisions[folder] for folder in {c.folder for c in cells if c.row == row} if folder in revisions]
    count = of_row.count(revision)
    return f"{row} ({count} of {len(of_row)} runs)" if count else ""
