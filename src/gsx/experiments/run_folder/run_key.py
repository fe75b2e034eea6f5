"""Which run a composition is: one name for one training, wherever and however it is carried out."""

import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from gsx.core.files import at_home
from gsx.core.options import fields_with, flattened
from gsx.engine.cache import content_key, file_stamp
from gsx.experiments.run_folder.files import RunFiles, part
from gsx.experiments.run_folder.general_options import GeneralOptions, splat_file
from gsx.experiments.run_folder.renamed import MOVED, REMOVED, moved, put
from gsx.experiments.run_folder.stamps import tree_stamp
from gsx.formats.axis_names import AUTO
from gsx.formats.suffixes import META

WHERE = (*sorted(fields_with("none", GeneralOptions)), "tracker")
"""Keys that say where and how a run is carried out."""
NAMES = (*sorted(fields_with("label", GeneralOptions)), "budget", "dataset")
"""Keys that name what other keys hold."""
EVALUATION = ("eval", "metrics")
"""Keys of what is looked at when training is over."""
PICTURES = (".webp", ".png")
"""Suffixes of an unbundled SOG's pictures."""
UNCHANGED = {"scene.model": "auto"}
"""Keys that older gsx did not have, with the values that train the same: these do not count."""
NEWER = {"supersample": 0, "colours": "rendered", "poses": "given", "flight": True}
"""Keys of `eval` that older gsx did not have, as it looked at models."""


def trained(config: dict[str, Any], idle: Collection[str]) -> dict[str, Any]:
    """What of a resolved composition decides what is trained, beside what its scene holds (`scene_stamp`).

    `idle`: dotted keys that their options say to have no effect. The folder of a scene is among them: what lies there
    counts.
    """
    counted = without(config, {*idle, *unchanged(config)})
    kept = {key: value for key, value in counted.items() if key not in (*WHERE, *NAMES, *EVALUATION)}
    start = {"init": "splat file"} | given_axes(config) if splat_file(config.get("init")) else {}
    return kept | {"regenerator": asked_for(kept)} | start


def unchanged(config: dict[str, Any]) -> list[str]:
    """Return the dotted keys of a composition by which it trains as older gsx did, which lacked them."""
    return [key for key, value in flattened(config).items() if UNCHANGED.get(key, ...) == value]


def given_axes(config: dict[str, Any]) -> dict[str, Any]:
    """Return the axes that a composition names for its splat file; empty: none, as in those of older gsx."""
    axes = config.get("axes", AUTO)
    return {} if axes == AUTO else {"axes": axes}


def asked_for(config: dict[str, Any]) -> dict[str, Any]:
    """The regenerators that augmenters may ask for: those of their roles, or all where one does not name its role."""
    nodes = [node for node in part(config, "augmenter").values() if isinstance(node, dict)]
    roles = {node.get("role") for node in nodes}
    return {role: node for role, node in part(config, "regenerator").items() if roles & {role, None}}


def without(node: Any, keys: Collection[str], prefix: str = "") -> Any:
    """A node without some dotted keys."""
    if not isinstance(node, dict):
        return node
    return {key: without(value, keys, f"{prefix}{key}.") for key, value in node.items() if f"{prefix}{key}" not in keys}


def scene_stamp(config: dict[str, Any]) -> str:
    """What the scene of a composition holds: names, sizes and contents (of large files, times) of all in its folder,
    wherever that lies; and of the splat file that it begins with, if there is one.

    Empty for scenes without a folder; `absent: FOLDER` where it is not there. Files outside of the folder count if an
    option of the scene names them.
    """
    of_folder, file = folder_stamp(config), splat_file(config.get("init"))
    return content_key(of_folder, splat_stamp(file)) if file is not None and file.is_file() else of_folder


def splat_stamp(file: Path) -> tuple[Any, ...]:
    """Return the stamp of a splat file; of an unbundled SOG, those of its pictures as well."""
    others = sorted(file.parent.iterdir()) if file.name.lower() == META else []
    return *file_stamp(file), *(file_stamp(other) for other in others if other.suffix.lower() in PICTURES)


def folder_stamp(config: dict[str, Any]) -> str:
    """See `scene_stamp`."""
    scene = part(config, "scene")
    if not scene.get("path"):
        return ""
    path = at_home(str(scene["path"]))
    if not path.exists():
        return f"absent: {path}"
    folder = path if path.is_dir() else path.parent
    output = Path(str(config.get("output", "outputs")))
    stamps = [tree_stamp(place, output) for place in (folder, *outside(scene, folder))]
    return content_key("" if path.is_dir() else path.name, stamps)


def outside(scene: dict[str, Any], folder: Path) -> list[Path]:
    """Files and folders beyond the scene's own that its options name."""
    values = [value for key, value in scene.items() if key != "path" and isinstance(value, str)]
    leading = [value for value in values if Path(value).is_absolute() or value.startswith("..")]
    return [folder / value for value in leading if (folder / value).exists()]


def trained_on(files: RunFiles) -> str:
    """The stamp of the scene when the run began."""
    return str(part(files.environment, "scene").get("stamp", ""))


def other_revision(files: RunFiles, this: str) -> str:
    """The revision of gsx's source that trained a run, or several; empty if it is `this` one, or unknown."""
    revision = str(files.environment.get("source") or "")
    return "" if revision == this else revision


def composition_key(config: dict[str, Any], stamp: str, idle: Collection[str]) -> str:
    """A short digest: compositions that train the same have the same; `stamp`: of the scene (`scene_stamp`)."""
    return content_key(sorted_items(by_older_keys(trained(config, idle))), stamp)


def by_older_keys(config: dict[str, Any]) -> dict[str, Any]:
    """Returns a composition with the keys of the first digests, so that runs of before keep their names."""
    config = moved(config, {new: old for old, new in MOVED.items()})
    for key, value in REMOVED.items():
        if value is not None and key.partition(".")[0] in config:
            put(config, key, value)
    return config


def sorted_items(value: Any) -> Any:
    """A value whose text does not depend on the order in which mappings were written, but for that of augmenters."""
    if isinstance(value, dict):
        items = [(key, inner) for key, inner in value.items()]
        return [
            (key, [(name, sorted_items(node)) for name, node in inner.items()])
            if key == "augmenter" and isinstance(inner, dict)
            else (key, sorted_items(inner))
            for key, inner in sorted(items, key=lambda item: str(item[0]))
        ]
    return [sorted_items(inner) for inner in value] if isinstance(value, list | tuple) else value


def place_of(config: dict[str, Any], stamp: str, idle: Collection[str]) -> Path:
    """The folder of a composition with a scene of that stamp: <output>/<scene>/<backbone>/<digest>."""
    scene = part(config, "scene")
    name = Path(str(scene.get("path") or "")).name or str(scene.get("name"))
    backbone = str(part(config, "backbone").get("name"))
    output = Path(str(config.get("output", "outputs")))
    return output / re.sub(r"[^\w.-]", "_", name) / backbone / composition_key(config, stamp, idle)


def evaluation_settings(config: dict[str, Any]) -> dict[str, Any]:
    """How a composition is to be evaluated; saved with every evaluation (once as `judged`)."""
    looked_by = {"filter": part(config, "backbone").get("filter"), "pixel": part(config, "rasterizer").get("pixel")}
    return {key: config.get(key) for key in EVALUATION} | looked_by


def evaluated_as(files: RunFiles, config: dict[str, Any]) -> dict[str, Any]:
    """The settings that a run was evaluated by; older gsx does not tell filter and pixel, which were the run's own, nor
    settings that it did not have."""
    own = {key: evaluation_settings(config)[key] for key in ("filter", "pixel")}
    saved = part(files.evaluation, "settings" if "settings" in files.evaluation else "judged")
    looked = saved.get("eval")
    return own | saved | ({"eval": NEWER | looked} if isinstance(looked, dict) else {})


def finished(files: RunFiles, config: dict[str, Any], stamp: str, idle: Collection[str]) -> bool:
    """Whether a run folder holds all that a composition asks for: trained to the end, just so and on a scene of that
    stamp, and evaluated the same."""
    return (
        files.status.get("state") == "ok"
        and not files.unfinished
        and files.evaluation.get("step") == config["iterations"]
        and evaluated_as(files, config) == evaluation_settings(config)
        and composition_key(files.config, trained_on(files), idle) == composition_key(config, stamp, idle)
    )


def comparable(config: dict[str, Any]) -> dict[str, Any]:
    """Values by dotted key that runs may be compared by: not those that say where a run ran."""
    kept = {key: value for key, value in config.items() if key not in (*WHERE, "length")}
    start = {"init": config["init"]} | given_axes(config) if splat_file(config.get("init")) else {}
    return flattened(without(kept | start, unchanged(config)))
