"""Changes between the parts of a run: logged, recorded, and refused if they make it another run.

environment.json holds the circumstances of the start and, under `history`, the changes at each continuation.
"""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import chain
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
"""Names of what identifies a run."""
UNKNOWN = "unknown"
"""Source that started a run whose environment.json is lost."""


def record_changes(run: Run, settings: Settings, plugins: Plugins, changed: bool = False) -> None:
    """Log and record changes since the run stopped, and remove half-written files; config.yaml is still the old one.

    Raises:
        InputError: cameras or options are those of another run, and `changed` does not allow that.
    """
    remove_partial(run.folder)
    files, facts = read_run(run.folder), environment(run, plugins, settings.idle)
    if not files.environment:
        write_anew(run, facts, files.problems.get(FACTS, f"{FACTS} is missing"))
        return
    before, now = circumstances(files.environment), circumstances(facts)
    plugins_known = any(key.startswith("plugins.") for key in before)  # then one of them may be new
    differences = {
        key: pair
        for key, pair in changes(before, now).items()
        if (plugins_known if key.startswith("plugins.") else key in before and key in now)
    }
    # all digests of the run's options: a crash may leave config.yaml older than the history
    pairs = [part(entry, "changed").get("options", []) for entry in files.environment.get("history", [])]
    known = {str(digest) for digest in (files.environment.get("options"), *chain(*pairs)) if digest}
    edited = bool(known) and composition_key(files.config, "", settings.idle) not in known
    others = [other_options(files, settings, plugins, "source" in differences)] if edited else []
    if not changed:
        refuse_another(run, [*([CAMERAS] if "scene.cameras" in differences else []), *others])
    for words in others:
        logger.warning("continuing with other %s", words)
    if files.config:
        differences |= changes(trained(files.config, settings.idle), trained(run.config, settings.idle))
    for key, (then, value) in differences.items():
        if key != "options":
            logger.warning("%s", in_words(key, then, value))
    record(run, files.environment, differences)


def circumstances(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the latest comparable entries of an environment.json by dotted key."""
    last = flattened({key: facts[key] for key in COMPARED if key in facts})
    last |= {f"scene.{key}": value for key, value in part(dict(facts), "scene").items() if key in ("stamp", "cameras")}
    if "source" in last:  # all revisions that trained parts of it, joined by +
        last["source"] = str(last["source"]).split("+")[-1]
    for entry in facts.get("history", []):
        last |= {key: now for key, (_, now) in part(entry, "changed").items()}
    return last


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return (before, now) of each changed value by dotted key; None where there is no such entry."""
    then, later = flattened(before), flattened(now)
    keys = dict.fromkeys([*then, *later])
    return {key: (then.get(key), later.get(key)) for key in keys if then.get(key) != later.get(key)}


def other_options(files: RunFiles, settings: Settings, plugins: Plugins, other_source: bool) -> str:
    """Name the options that changed; another revision of the source may read the same file differently."""
    if not other_source:
        return EDITED
    read = read_config(files.folder / "config.yaml", plugins).resolved
    keys = ", ".join(changes(trained(files.config, settings.idle), trained(read, settings.idle)))
    named = f"; this one reads differently: {keys}" if keys else ""
    return f"options (config.yaml was edited, or another revision of gsx's source reads it differently{named})"


def write_anew(run: Run, facts: dict[str, Any], problem: str) -> None:
    """Write a lost environment.json anew, log that the start is unknown, and keep a damaged file next to it."""
    path = run.folder / FACTS
    with suppress(FileNotFoundError, ValueError):
        read_json(path)
    if path.exists():
        path.replace(next(p for n in range(1, 1000) if not (p := path.with_suffix(f".damaged_{n}")).exists()))
    logger.warning(
        "%s, %s: cannot check whether scene, options and versions are those of the start; the file is written anew",
        *(run.folder, problem),
    )
    history = {"history": [entry_of(run, {FACTS: (problem, "written anew")})]}
    write_json(path, facts | {"source": f"{UNKNOWN}+{facts['source']}"} | history)


def refuse_another(run: Run, names: Sequence[str]) -> None:
    """Raise InputError if something that identifies a run differs."""
    if names:
        raise InputError(
            f"{run.folder} was trained to step {run.step} with other {' and '.join(names)}: restore them, or continue "
            f"anyway with {command('resume', run.folder, '--changed')}"
        )


def in_words(key: str, before: Any, now: Any) -> str:
    """Describe a change."""
    scene = {"scene.stamp": "files", "scene.cameras": "cameras"}
    if key in scene:
        return f"{scene[key]} of the scene have changed since the run started"
    if key == "source":
        return f"the run was started by another revision of gsx's source ({before}, this is {now})"
    return f"continuing with {key}={now}, before it was {before}"


def record(run: Run, facts: dict[str, Any], differences: Mapping[str, tuple[Any, Any]]) -> None:
    """Add changes to the history in environment.json, and this revision to its `source`."""
    if not differences:
        return
    source = str(facts.get("source", ""))
    if "source" in differences:
        source = "+".join(filter(None, [source, differences["source"][1]]))
    history = [*facts.get("history", []), entry_of(run, differences)]
    write_json(run.folder / FACTS, facts | {"source": source, "history": history})


def entry_of(run: Run, differences: Mapping[str, tuple[Any, Any]]) -> dict[str, Any]:
    """Return changes as an entry of the history."""
    return {
        "step": run.step,
        "at": datetime.now().isoformat(sep=" ", timespec="seconds"),
        "changed": {key: list(values) for key, values in differences.items()},
    }
