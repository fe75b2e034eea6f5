"""Writes a scene for other programs: `gsx prepare`."""

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsx import __version__
from gsx.core.data.images import write_image
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.core.files import finite, replace_text, write_json
from gsx.core.plugins import Plugins
from gsx.core.shapes import UInt8
from gsx.experiments.evaluation.eval_options import EvalOptions, protocol_of
from gsx.experiments.evaluation.lpips import load_lpips
from gsx.experiments.prepare.colmap_files import write_model
from gsx.experiments.prepare.content import Prepared, content_of, cost_of, doubts_about
from gsx.experiments.prepare.picture_names import every_eighth_is_test
from gsx.experiments.prepare.readme import readme_of
from gsx.experiments.prepare.transforms_file import write_transforms
from gsx.experiments.prepare.whole_folder import MANIFEST, is_prepared, refuse_inside, refuse_occupied, whole_folder
from gsx.experiments.prepare.zoom_cameras import Zoomed, write_zoom, zoom_name
from gsx.experiments.runs.compose import Compositions, compose
from gsx.experiments.runs.load_scene import load_scene, with_small_cache
from gsx.experiments.runs.overrides import word_of
from gsx.experiments.runs.progress import Countdown
from gsx.experiments.runs.settings import Settings, settings_from

logger = logging.getLogger(__name__)

FORMAT = 1
"""Version of the folder's layout."""
README, NAMES = "README.txt", "test_views.txt"

Advance = Callable[[float, str], None]
"""Callback after each picture: its cost in units of a training picture, and its name."""


def prepare(
    words: Sequence[str], to: Path, plugins: Plugins, with_test: bool = False, with_truth: bool = False
) -> Path:
    """Write the scene of a composition for other programs; return the folder.

    A folder that was prepared with the same settings stays as it is.

    Args:
        words: Overrides, as for training.
        to: Folder to write.
        plugins: Loaded components.
        with_test: Put test photos into `images/` as well.
        with_truth: Write test photos at each zoom to `truth/xK/`.

    Raises:
        ConfigError: a setting is wrong.
        InputError: the scene cannot be loaded, `to` holds something else, or a zoom has no truth.
    """
    refuse_occupied(to, prepared=True)
    settings = with_small_cache(compose(words, plugins))
    refuse_inside(to, getattr(settings.scene.options, "path", ""))
    scene = load_scene(settings)
    if any(view.camera.lens is not None for view in [*scene.train, *scene.test]):
        raise ConfigError("gsx prepare writes pinhole cameras: leave scene.lens=native out")
    for note in scene.notes:
        logger.info("note: %s", note)
    content = content_of(scene, settings.evaluation.zoom, with_test, with_truth)
    repeated = repeating_words(settings, plugins)
    manifest = json.loads(json.dumps(finite(manifest_of(content, settings.evaluation, repeated)), default=str))
    if is_prepared(to, manifest):
        logger.info("%s was prepared with these settings before: it stays as it is", to)
        return to
    for doubt in doubts_about(content):
        logger.warning("%s", doubt)
    with whole_folder(to) as folder:
        write_folder(folder, content, manifest, Countdown("preparing", content.work()).advance)
    logger.info("prepared %d training and %d test views of scene %s", len(scene.train), len(scene.test), scene.name)
    return to


def manifest_of(content: Prepared, options: EvalOptions, words: Sequence[str]) -> dict[str, Any]:
    """Return the content of prepared.json; `words`: overrides that load the same scene and evaluation."""
    scene, lpips, zoomed = content.scene, load_lpips(options.lpips), content.zoomed.items()
    test: list[dict[str, Any]] = [{"name": picture.name, "file": picture.file} for picture in content.test]
    for one in test:
        finer = {zoom: views[one["file"]] for zoom, views in zoomed if one["file"] in views}
        one["sizes"] = {f"{zoom:g}": list(view.camera.size) for zoom, view in finer.items()}
    return {
        "format": FORMAT,
        "gsx": __version__,
        "scene": scene.name,
        "overrides": list(words),
        "zooms": list(content.zoomed),
        "with_test": content.with_test,
        "with_truth": content.with_truth,
        "every_8th_is_test": every_eighth_is_test(content.train, content.test),
        "filter": scene.reduction.filter,
        "light": scene.reduction.light,
        "background": scene.background.tolist(),
        "masks": content.masked,
        "protocol": protocol_of(scene, options, lpips.name if lpips else "n/a (no weights)"),
        "train": [{"name": picture.name, "file": f"images/{picture.file}"} for picture in content.train],
        "test": test,
    }


def write_folder(folder: Path, content: Prepared, manifest: dict[str, Any], advance: Advance) -> None:
    """Write all files; the manifest is the last one."""
    scene, points, origin = content.scene, content.scene.points, content.scene.origin
    write_photos(folder, content, advance)
    write_model(folder / "sparse" / "0", [(p.file, p.camera) for p in content.pictures], points, origin)
    everything = [(picture.file, picture.camera) for picture in [*content.train, *content.test]]
    write_model(folder / "all_views" / "sparse" / "0", everything, points, origin)
    held_out = content.test if content.with_test else []
    write_transforms(folder, content.pictures, held_out, points, origin, content.masked)
    for factor, views in content.zoomed.items():
        write_zoom(folder, scene, factor, views)
        if content.with_truth:
            write_truth(folder / "truth" / zoom_name(factor), factor, views, advance)
    replace_text(folder / NAMES, "".join(f"{picture.file}\n" for picture in content.test))
    replace_text(folder / README, readme_of(content.scene.name, manifest))
    write_json(folder / MANIFEST, manifest)


def write_photos(folder: Path, content: Prepared, advance: Advance) -> None:
    """Write photos as gsx trains on them, and their masks: white pixels count."""
    (folder / "images").mkdir()
    if content.masked:
        (folder / "masks").mkdir()
    for picture in content.pictures:
        write_image(folder / "images" / picture.file, picture.view.picture())
        if content.masked:
            write_image(folder / "masks" / picture.file, mask_of(picture.view))
        advance(1, picture.file)


def mask_of(view: View) -> UInt8[Tensor, "1 H W"]:
    """Return the mask of a view as a grey picture, uint8 [1, H, W]; white: it counts."""
    counted = view.counted()
    width, height = view.camera.size
    counted = torch.ones(height, width) if counted is None else counted
    return (counted[None] * 255).byte()


def write_truth(folder: Path, factor: float, views: Zoomed, advance: Advance) -> None:
    """Write the test photos at a zoom."""
    folder.mkdir(parents=True)
    for file, view in views.items():
        write_image(folder / file, view.picture())
        advance(cost_of(view, factor), f"{file} {zoom_name(factor)}")


KEPT = ("scene", "eval", "metrics")
"""Groups that decide photos and figures."""


def repeating_words(settings: Settings, plugins: Plugins) -> list[str]:
    """Return overrides with the scene's format, and all values of scene and evaluation that are no defaults."""
    scene = f"scene={settings.scene.component.name}"
    with Compositions(plugins) as compositions:
        defaults = settings_from(compositions.composed([scene]), plugins).resolved
    groups = {group: differing(settings.resolved[group], defaults[group], group) for group in KEPT}
    seed = [f"seed={settings.general.seed}"] if settings.general.seed != defaults["seed"] else []
    return [scene, *(word for words in groups.values() for word in words), *seed]


def differing(values: Mapping[str, Any], defaults: Mapping[str, Any], place: str) -> Iterator[str]:
    """Yield an override by Hydra's grammar for each value below a dotted key that is not the default."""
    for key, value in values.items():
        default = defaults.get(key)
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            yield from differing(value, default, f"{place}.{key}")
        elif value != default:
            whole = f"{place}.{key}"
            yield word_of(whole, value) if isinstance(value, str) else f"{whole}={json.dumps(value)}"
