"""What a run went on with: what differs from its beginning is told, recorded, and refused where it makes another run.

environment.json holds how the run began, and under `history` what had changed each time that it went on. Where it is
gone, it is written anew.
"""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any

from gsx.core.errors import InputError, command
from gsx.core.files import read_json, remove_partial, write_json
from gsx.core.options import flattened
from gsx.core.plugins import Plugins
from gsx.core.training.run import Run
from gsx.experiments.run_folder.files import RunFiles, part, read_run
from gsx.experiments.run_folder.run_key import composition_key, trained
from gsx.experiments.runs.environment import environment
from gsx.experiments.runs.saved_settings import read_config
from gsx.experiments.runs.settings import Settings

logger = logging.getLogger(__name__)

COMPARED = (
    *("gsx", "python", "platform", "threads", "rasterizer", "source", "device", "processes", "packages", "plugins"),
    "options",
)
"""Entries of environment.json that may change between the parts of a run; the bits of its results may, too."""
FACTS = "environment.json"
CAMERAS, EDITED = "cameras (poses, intrinsics, sizes)", "options (config.yaml was edited)"
"""What says which run it is, in words."""


UNKNOWN = "unknown"
"""The source that began a run whose environment.json is gone."""


def circumstances(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The comparable entries of an environment.json, by dotted key, as they were last."""
    last = flattened({key: facts[key] for key in COMPARED if key in facts})
    last |= {f"scene.{key}": value for key, value in part(dict(facts), "scene").items() if key in ("stamp", "cameras")}
    if "source" in last:  # of all revisions that trained parts of it
        last["source"] = str(last["source"]).split("+")[-1]
    for entry in facts.get("history", []):
        last |= {key: now for key, (_, now) in part(entry, "changed").items()}
    return last


def go_on(run: Run, settings: Settings, plugins: Plugins, changed: bool = False) -> None:
    """Tell and record what a run that goes on finds changed; its folder still has the config.yaml it was left with.

    What its former process left half-written is removed.

    Raises:
        InputError: it would be another run, and nobody said that it is meant to be `changed`.
    """
    remove_partial(run.folder)
    files = read_run(run.folder)
    if not files.environment:
        write_anew(run, settings, plugins, files.problems.get(FACTS, f"{FACTS} is missing"))
        return
    before, now = circumstances(files.environment), circumstances(environment(run, plugins, settings.idle))
    differing = {key: pair for key, pair in changes(before, now).items() if can_be_compared(key, before, now)}
    known = known_options(files.environment)
    edited = bool(known) and composition_key(files.config, "", settings.idle) not in known
    others = [options_told(files, settings, plugins, "source" in differing)] if edited else []
    if not changed:
        refuse_another(run, [*([CAMERAS] if "scene.cameras" in differing else []), *others])
    for words in others:
        logger.warning("the run goes on with other %s", words)
    asked = changes(trained(files.config, settings.idle), trained(run.config, settings.idle)) if files.config else {}
    for key, (then, value) in (differing | asked).items():
        if key != "options":
            logger.warning("%s", told(key, then, value))
    record(run, files.environment, differing | asked)


def can_be_compared(key: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether an entry is known of both times; plugins come and go, where they are known at all."""
    if key.startswith("plugins."):
        return any(other.startswith("plugins.") for other in before)
    return key in before and key in now


def known_options(facts: Mapping[str, Any]) -> set[str]:
    """Digests of all options that the run has had: config.yaml may lag behind a history that was written before it."""
    ways = [part(entry, "changed").get("options", []) for entry in facts.get("history", [])]
    return {str(digest) for digest in (facts.get("options"), *(one for way in ways for one in way)) if digest}


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """(before, now) of what has another value, by dotted key; None where there is no such entry."""
    then, later = flattened(before), flattened(now)
    keys = dict.fromkeys([*then, *later])
    return {key: (then.get(key), later.get(key)) for key in keys if then.get(key) != later.get(key)}


def options_told(files: RunFiles, settings: Settings, plugins: Plugins, other_source: bool) -> str:
    """Options that are not those of the run, in words: by another source they may be the same, and read otherwise."""
    if not other_source:
        return EDITED
    read = read_config(files.folder / "config.yaml", plugins).resolved
    otherwise = ", ".join(changes(trained(files.config, settings.idle), trained(read, settings.idle)))
    named = f"; this one reads otherwise: {otherwise}" if otherwise else ""
    return f"options (config.yaml was edited, or another revision of gsx's source told them apart otherwise{named})"


def write_anew(run: Run, settings: Settings, plugins: Plugins, problem: str) -> None:
    """Tell and record that nobody knows what the run began with; what is there of a damaged file is kept beside it.

    Raises:
        OSError: the file is there, and cannot be read now.
    """
    path = run.folder / FACTS
    with suppress(FileNotFoundError, ValueError):
        read_json(path)
    if path.exists():
        path.replace(next(p for n in range(1, 1000) if not (p := path.with_suffix(f".damaged_{n}")).exists()))
    logger.warning(
        "%s, %s: whether the run goes on with the scene, options and versions that it began with is not known; that "
        "file is written anew",
        run.folder,
        problem,
    )
    facts = environment(run, plugins, settings.idle)
    facts["source"] = f"{UNKNOWN}+{facts['source']}"
    write_json(path, facts | {"history": [entry_of(run, {FACTS: (problem, "written anew")})]})


def refuse_another(run: Run, names: Sequence[str]) -> None:
    """Raise InputError if something that defines a run differs."""
    if names:
        raise InputError(
            f"{run.folder} was trained to step {run.step} with other {' and '.join(names)}: restore them, or go on all "
            f"the same with {command('resume', run.folder, '--changed')}"
        )


def told(key: str, before: Any, now: Any) -> str:
    """A change in words."""
    if key == "scene.stamp":
        return "files of the scene are not those that the run began with"
    if key == "scene.cameras":
        return "cameras of the scene are not those that the run began with"
    if key == "source":
        return f"the run was begun by another revision of gsx's source ({before}, this is {now})"
    return f"the run goes on with {key}={now}, before it was {before}"


def record(run: Run, facts: dict[str, Any], differing: Mapping[str, tuple[Any, Any]]) -> None:
    """Add to the history in environment.json, and this revision to those that trained the run."""
    if not differing:
        return
    source = str(facts.get("source", ""))
    if "source" in differing:
        source = "+".join(filter(None, [source, differing["source"][1]]))
    history = [*facts.get("history", []), entry_of(run, differing)]
    write_json(run.folder / FACTS, facts | {"source": source, "history": history})


def entry_of(run: Run, differing: Mapping[str, tuple[Any, Any]]) -> dict[str, Any]:
    """What has changed now, for the history."""
    return {
        "step": run.step,
        "at": datetime.now().isoformat(sep=" ", timespec="seconds"),
        "changed": {key: list(values) for key, values in differing.items()},
    }
