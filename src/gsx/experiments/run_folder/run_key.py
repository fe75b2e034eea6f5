"""Identity of a run: one name for one training, on any machine and in any folder."""

import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from gsx.core.files import expand_home
from gsx.core.options import fields_with, flattened
from gsx.engine.cache import content_key, file_stamp
from gsx.experiments.run_folder.files import RunFiles, part
from gsx.experiments.run_folder.general_options import GeneralOptions, splat_file
from gsx.experiments.run_folder.renamed import MOVED, REMOVED, moved, put
from gsx.experiments.run_folder.stamps import tree_stamp
from gsx.formats.axis_names import AUTO
from gsx.formats.suffixes import META

WHERE = (*sorted(fields_with("none", GeneralOptions)), "tracker")
"""Keys for place and manner of a run."""
NAMES = (*sorted(fields_with("label", GeneralOptions)), "budget", "dataset")
"""Keys that name the values of other keys."""
EVALUATION = ("eval", "metrics")
"""Keys that matter only after training."""
PICTURES = (".webp", ".png")
"""Suffixes of an unbundled SOG's pictures."""
NOT_COMPARED = "eval.competitor"
"""Node that changes no figure of the model: two runs may differ in it."""
UNCHANGED = {
    "scene.model": "auto",
    "scene.distances": "even",
    "scene.lens": "undistort",
    "scene.fisheye": 0.0,
    "scene.stereo": 0,
    "scene.depth_maps": False,
    "scene.depth_values": "depth",
    "scene.depth_fit": "affine",
    "scene.depth_unit": 0.0,
    "scene.rooms": 1,
    "scene.block": "",
    "scene.block_margin": 0.2,
    "scene.block_share": 0.25,
    "scene.similar": 10,
    "scene.near": 2,
    "scene.retry_pairs": 2000,
    "eval.rounding": "nearest",
    "eval.clamp": False,
    "eval.masks": "excluded",
    "backbone.density.passes": 1.0,
    "backbone.clone_split.density.passes": 1.0,
}
"""Keys newer than the first digests, with their neutral values, which do not count."""
WITHOUT_EFFECT: dict[str, dict[str, Any]] = {
    "training.deadline": {"seconds": 0.0, "steps": 0, "planned": [], "start": 0.2, "to": 0.8, "skip": []},
    "training.depth": {"when": "never"},
    "backbone.mcmc": {"primitives": 0},
    "training.appearance": {"when": "never"},
}
"""Nodes newer than the first digests, with values by which they change nothing and do not count."""
TRIAL = "training.trial"
"""Node newer than the first digests, which changes nothing where no correction is tested."""


def trained(config: dict[str, Any], idle: Collection[str]) -> dict[str, Any]:
    """Select the values that decide the training, except the scene's files (`scene_stamp`); `idle`: other keys."""
    counted = without(config, {*idle, *unchanged(config)})
    kept = {key: value for key, value in counted.items() if key not in (*WHERE, *NAMES, *EVALUATION)}
    start = {"init": "splat file"} | axes_of(config) if splat_file(config.get("init")) else {}
    return kept | {"regenerator": used_regenerators(kept)} | start


def unchanged(config: dict[str, Any]) -> list[str]:
    """List the keys and nodes of a composition that have their values of UNCHANGED and WITHOUT_EFFECT."""
    values = flattened(config)
    nodes = [
        key
        for key, neutral in WITHOUT_EFFECT.items()
        if all(values.get(f"{key}.{name}", ...) == value for name, value in neutral.items())
    ]
    tested = any(key.endswith(".when") and value == "auto" for key, value in values.items())
    trial = [TRIAL] if not tested or not values.get(f"{TRIAL}.steps") else []
    return [*nodes, *trial, *(key for key, value in values.items() if UNCHANGED.get(key, ...) == value)]


def axes_of(config: dict[str, Any]) -> dict[str, Any]:
    """Select the axes of a composition's splat file, unless they are automatic."""
    axes = config.get("axes", AUTO)
    return {} if axes == AUTO else {"axes": axes}


def used_regenerators(config: dict[str, Any]) -> dict[str, Any]:
    """Select the regenerators of the augmenters' roles, or all if an augmenter does not name its role."""
    nodes = [node for node in part(config, "augmenter").values() if isinstance(node, dict)]
    roles = {node.get("role") for node in nodes}
    return {role: node for role, node in part(config, "regenerator").items() if roles & {role, None}}


def without(node: Any, keys: Collection[str], prefix: str = "") -> Any:
    """Copy a node without some dotted keys."""
    if not isinstance(node, dict):
        return node
    return {key: without(value, keys, f"{prefix}{key}.") for key, value in node.items() if f"{prefix}{key}" not in keys}


def scene_stamp(config: dict[str, Any]) -> str:
    """Return a digest of a composition's scene and splat file; empty without any, `absent: FOLDER` if missing."""
    of_folder, file = folder_stamp(config), splat_file(config.get("init"))
    if file is None or not file.is_file():
        return of_folder
    others = sorted(file.parent.iterdir()) if file.name.lower() == META else []
    pictures = [other for other in others if other.suffix.lower() in PICTURES]  # of an unbundled SOG
    return content_key(of_folder, (*file_stamp(file), *map(file_stamp, pictures)))


def folder_stamp(config: dict[str, Any]) -> str:
    """Return a digest of a scene's folder, and of files outside of it that an option of the scene names."""
    scene = part(config, "scene")
    if not scene.get("path"):
        return ""
    path = expand_home(str(scene["path"]))
    if not path.exists():
        return f"absent: {path}"
    folder = path if path.is_dir() else path.parent
    output = Path(str(config.get("output", "outputs")))
    stamps = [tree_stamp(place, output) for place in (folder, *outside(scene, folder))]
    return content_key("" if path.is_dir() else path.name, stamps)


def outside(scene: dict[str, Any], folder: Path) -> list[Path]:
    """List files and folders outside of the scene's folder that its options name."""
    values = [value for key, value in scene.items() if key != "path" and isinstance(value, str)]
    leading = [value for value in values if Path(value).is_absolute() or value.startswith("..")]
    return [folder / value for value in leading if (folder / value).exists()]


def trained_on(run: RunFiles) -> str:
    """Return the stamp of the scene at the start of the run."""
    return str(part(run.environment, "scene").get("stamp", ""))


def other_revision(run: RunFiles, this: str) -> str:
    """Return the revisions of gsx's source that trained a run; empty if it is `this` one, or unknown."""
    revision = str(run.environment.get("source") or "")
    return "" if revision == this else revision


def composition_key(config: dict[str, Any], stamp: str, idle: Collection[str]) -> str:
    """Return a short digest, equal for compositions that train the same on a scene of that stamp."""
    return content_key(sorted_items(by_older_keys(trained(config, idle))), stamp)


def by_older_keys(config: dict[str, Any]) -> dict[str, Any]:
    """Return a composition with the keys of the first digests, so that older runs keep their names."""
    config = moved(config, {new: old for old, new in MOVED.items()})
    for key, value in REMOVED.items():
        if value is not None and key.partition(".")[0] in config:
            put(config, key, value)
    return config


def sorted_items(value: Any) -> Any:
    """Sort the keys of mappings, except those of augmenters, whose order counts."""
    if isinstance(value, dict):
        return [
            (key, [(name, sorted_items(node)) for name, node in inner.items()])
            if key == "augmenter" and isinstance(inner, dict)
            else (key, sorted_items(inner))
            for key, inner in sorted(value.items(), key=lambda item: str(item[0]))
        ]
    return [sorted_items(inner) for inner in value] if isinstance(value, list | tuple) else value


def place_of(config: dict[str, Any], stamp: str, idle: Collection[str]) -> Path:
    """Return the folder of a composition with a scene of that stamp: <output>/<scene>/<backbone>/<digest>."""
    scene = part(config, "scene")
    name = Path(str(scene.get("path") or "")).name or str(scene.get("name"))
    backbone = str(part(config, "backbone").get("name"))
    output = Path(str(config.get("output", "outputs")))
    return output / re.sub(r"[^\w.-]", "_", name) / backbone / composition_key(config, stamp, idle)


def evaluation_settings(config: dict[str, Any]) -> dict[str, Any]:
    """Select the values that decide an evaluation; saved with it."""
    render = {"filter": part(config, "backbone").get("filter"), "pixel": part(config, "rasterizer").get("pixel")}
    return {key: config.get(key) for key in EVALUATION} | render


def finished(run: RunFiles, config: dict[str, Any], stamp: str, idle: Collection[str]) -> bool:
    """Return True if a run is trained to the end on that scene and evaluated by the same settings."""
    return (
        run.status.get("state") == "ok"
        and not run.unfinished
        and run.evaluation.get("step") == config["iterations"]
        and evaluated_alike(part(run.evaluation, "settings"), evaluation_settings(config))
        and composition_key(run.config, trained_on(run), idle) == composition_key(config, stamp, idle)
    )


def evaluated_alike(saved: dict[str, Any], now: dict[str, Any]) -> bool:
    """Return True if an evaluation was made by the settings of now.

    Keys of EVALUATION that are newer do not count, except those of UNCHANGED that have another value.
    """

    def counts(group: str, key: str, value: Any) -> bool:
        return key in part(saved, group) or UNCHANGED.get(f"{group}.{key}", value) != value

    groups = {group: {k: v for k, v in part(now, group).items() if counts(group, k, v)} for group in EVALUATION}
    return saved == now | groups


def comparable(config: dict[str, Any]) -> dict[str, Any]:
    """Select the values to compare runs by, by dotted key: all but place and manner."""
    kept = {key: value for key, value in config.items() if key not in (*WHERE, "length")}
    start = {"init": config["init"]} | axes_of(config) if splat_file(config.get("init")) else {}
    return flattened(without(kept | start, [*unchanged(config), NOT_COMPARED]))
