"""What a run went on with: what differs from its beginning is told, recorded, and refused where it makes another run.

environment.json holds how the run began, and under `history` what had changed each time that it went on.
"""

import logging
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from gsx.core.errors import InputError
from gsx.core.files import remove_partial, write_json
from gsx.core.options import flattened
from gsx.core.plugins import Plugins
from gsx.core.training.run import Run
from gsx.experiments.run_folder.files import part, read_run
from gsx.experiments.run_folder.run_key import composition_key, trained
from gsx.experiments.runs.environment import environment

logger = logging.getLogger(__name__)

COMPARED = (
    *("gsx", "python", "platform", "threads", "rasterizer", "source", "device", "processes", "packages", "plugins"),
    "options",
)
"""Entries of environment.json that may change between the parts of a run; the bits of its results may, too."""
DEFINING = {"scene.cameras": "cameras (poses, intrinsics, sizes)", "options": "options (config.yaml was edited)"}
"""Entries that say which run it is, in words."""


def circumstances(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The comparable entries of an environment.json, by dotted key, as they were last."""
    last = flattened({key: facts[key] for key in COMPARED if key in facts})
    last |= {f"scene.{key}": value for key, value in part(dict(facts), "scene").items() if key in ("stamp", "cameras")}
    if "source" in last:  # of all revisions that trained parts of it
        last["source"] = str(last["source"]).split("+")[-1]
    for entry in facts.get("history", []):
        last |= {key: now for key, (_, now) in part(entry, "changed").items()}
    return last


def go_on(run: Run, plugins: Plugins, changed: bool = False) -> None:
    """Tell and record what a run that goes on finds changed; its folder still has the config.yaml it was left with.

    What its former process left half-written is removed.

    Raises:
        InputError: it would be another run, and nobody said that it is meant to be `changed`.
    """
    remove_partial(run.folder)
    files = read_run(run.folder)
    if not files.environment:
        return
    before, now = circumstances(files.environment), circumstances(environment(run, plugins))
    differing = {key: pair for key, pair in changes(before, now).items() if can_be_compared(key, before, now)}
    known = known_options(files.environment)
    edited = known and composition_key(files.config, "", run.idle) not in known
    if not changed:
        others = ["options"] if edited and "source" not in differing else []  # another source may read it otherwise
        refuse_another(run, [*(key for key in differing if key != "options"), *others])
    asked = changes(trained(files.config, run.idle), trained(run.config, run.idle)) if files.config else {}
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


def refuse_another(run: Run, differing: Sequence[str]) -> None:
    """Raise InputError if what defines a run is among the entries that differ."""
    names = [words for key, words in DEFINING.items() if key in differing]
    if names:
        raise InputError(
            f"{run.folder} was trained to step {run.step} with other {' and '.join(names)}: restore them, or go on all "
            f"the same with gsx resume {run.folder} --changed"
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
    entry = {
        "step": run.step,
        "at": datetime.now().isoformat(sep=" ", timespec="seconds"),
        "changed": {key: list(values) for key, values in differing.items()},
    }
    write_json(
        run.folder / "environment.json", facts | {"source": source, "history": [*facts.get("history", []), entry]}
    )
