"""Measures pictures and splats of any program on some scenes by some protocols: `gsx judge`."""

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from gsx import __version__
from gsx.core.errors import ConfigError, InputError, command
from gsx.core.files import replace_text, write_json
from gsx.core.plugins import Plugins
from gsx.engine.cache import source_revision
from gsx.experiments.judge.methods import Entry
from gsx.experiments.judge.page import as_csv, as_text, page_of
from gsx.experiments.judge.prepared_scenes import prepared_subject
from gsx.experiments.judge.scene_figures import Choices, Subject, measure_scene
from gsx.experiments.judge.summary import PLACE, baseline_of, named_methods, over_scenes, rows_of, view_rows
from gsx.experiments.prepare.whole_folder import refuse_occupied, whole_folder
from gsx.experiments.runs.compose import Compositions

logger = logging.getLogger(__name__)

FORMAT = 1
"""Version of comparison.json."""
PAGE, RESULTS, FIGURES, VIEWS, PICTURES = "comparison.html", "comparison.json", "figures.csv", "views.csv", "pictures"


def compare_methods(
    entries: Sequence[Entry],
    subjects: Sequence[Subject],
    choices: Choices,
    protocols: Sequence[str],
    against: str,
    to: Path | None,
    plugins: Plugins,
    words: Sequence[str],
) -> tuple[Path, list[str]]:
    """Measures methods on scenes; returns the page, and the table in lines.

    Args:
        entries: Methods; equal names are repetitions.
        subjects: Scenes.
        choices: Further options.
        protocols: Names of conf/protocol, in turn; empty: the settings as they are.
        against: Method that others are compared with; empty: the first.
        to: New folder; None: one below `outputs/comparisons`, named by the time.
        plugins: Loaded components.
        words: The command line, for the page.

    Raises:
        ConfigError, InputError: a setting, a scene or a method cannot be measured; nothing is written.
    """
    names = [entry.name for entry in entries]
    entries = [replace(entry, repetition=names[:number].count(entry.name)) for number, entry in enumerate(entries)]
    baseline = baseline_of(list(dict.fromkeys(names)), against)
    scenes = [subject.name for subject in subjects]
    if twice := next((name for name in scenes if name and scenes.count(name) > 1), ""):
        raise InputError(f"two of the prepared folders hold a scene called '{twice}': compare them one by one")
    place = Path("outputs") / "comparisons" / f"{datetime.now():%Y-%m-%d_%H-%M-%S}" if to is None else to
    refuse_occupied(place)
    with whole_folder(place) as folder:
        (folder / PICTURES).mkdir()
        results = []
        for number, (subject, name) in enumerate((s, p) for s in subjects for p in protocols or [""]):
            measured = subject
            if name:
                logger.info("protocol %s", name)
                measuring = measuring_words(subject.overrides, name, plugins)
                measured = replace(subject, overrides=(*subject.overrides, *measuring))
            found = measure_scene(measured, entries, choices, plugins, folder / PICTURES, f"{number}")
            results.append({"protocol_name": name, **found})
        lines = write_results(folder, results, baseline, words)
    return place / PAGE, lines


def measuring_words(overrides: Sequence[str], protocol: str, plugins: Plugins) -> list[str]:
    """Returns the settings by which a protocol measures, as far as the scene has them.

    Its settings of sizes and splits do not count: pictures have their size, and the scene its test views.

    Raises:
        ConfigError: there is no such protocol.
    """
    with Compositions(plugins) as compositions:
        measuring, known = compositions.protocol(protocol).measuring, compositions.keys(overrides)
    fitting = {key: value for key, value in measuring.items() if key in known and key != "eval.zoom"}
    return [f"{key}={json.dumps(value)}" for key, value in fitting.items()]


def subjects_of(folders: Sequence[Path], words: Sequence[str], overrides: Sequence[str]) -> list[Subject]:
    """Returns the scenes to measure: those of prepared folders, or the one of settings.

    words: settings that choose a scene; empty: none do.

    Raises:
        ConfigError: there is no scene, or prepared folders and another one.
    """
    if folders and words:
        raise ConfigError(
            f"gsx judge: '{words[0]}' does not go with a prepared folder, which has a scene: leave it out"
        )
    if folders:
        return [prepared_subject(folder, overrides) for folder in folders]
    if not words:
        raise ConfigError(
            "gsx judge needs the scene that the pictures show: give its FOLDER, a folder of gsx prepare, or scene=NAME"
        )
    return [Subject(overrides=(*words, *overrides))]


def write_results(folder: Path, results: Sequence[Mapping[str, Any]], baseline: str, words: Sequence[str]) -> list[str]:
    """Writes JSON, CSV and page; returns the table in lines."""
    rows = rows_of(results, baseline)
    means = over_scenes(rows, baseline)
    content = {
        "format": FORMAT,
        "gsx": __version__,
        "revision": source_revision(),
        "date": f"{datetime.now():%Y-%m-%d %H:%M}",
        "command": command("judge", *words),
        "methods": named_methods(results),
        "against": baseline,
        "rows": rows,
        "means": means,
        "results": results,
    }
    write_json(folder / RESULTS, content)
    replace_text(folder / FIGURES, as_csv([*rows, *means], PLACE))
    replace_text(folder / VIEWS, as_csv([*view_rows(results)], (*PLACE, "repetition", "view")))
    replace_text(folder / PAGE, page_of(content, rows, means))
    return as_text([*rows, *means], baseline)
