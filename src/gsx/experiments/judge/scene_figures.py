"""Methods on one scene, measured by one protocol."""

import logging
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsx.core.data.scene import Scene, View
from gsx.core.errors import ConfigError, InputError
from gsx.core.plugins import Plugins
from gsx.core.training.regenerator import RegeneratorContext
from gsx.experiments.evaluation.competitor import Competitor, competitor_for, refuse_learning
from gsx.experiments.evaluation.eval_options import protocol_of
from gsx.experiments.evaluation.lpips import load_lpips
from gsx.experiments.evaluation.perceptual import MetricSettings, load_metrics
from gsx.experiments.judge.crops import Crops
from gsx.experiments.judge.matching import Matcher
from gsx.experiments.judge.measure import Measured, Measurement, Protocol, own_truth_psnr
from gsx.experiments.judge.methods import Entry, Method, Model, PictureFolder
from gsx.experiments.judge.models import is_model, opened_model
from gsx.experiments.judge.view_names import bare, names_of_views, read_order
from gsx.experiments.reports.page import counted
from gsx.experiments.runs.build import choose_device, prepare_process
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene, with_small_cache
from gsx.experiments.runs.progress import Countdown
from gsx.experiments.runs.settings import Settings
from gsx.formats.suffixes import READABLE

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A scene, by the settings that choose it."""

    overrides: tuple[str, ...]
    own: int = 0
    """Number of leading overrides that are of a prepared folder."""
    name: str = ""
    """Replaces `{scene}` in paths; empty: the scene's own."""
    prepared_zooms: tuple[float, ...] = ()
    """Zooms for which a scene was prepared; models are measured at them unless pictures have others."""
    aliases: Mapping[str, str] | None = None
    """Names of pictures by view, as `gsx prepare` lists them."""
    prepared: str = ""
    """Folder of `gsx prepare`; empty: there is none."""


@dataclass(frozen=True, kw_only=True)
class Choices:
    """Options beyond settings."""

    order: Path | None = None
    """List of the views of numbered pictures."""
    depth: Path | None = None
    """Run or splat file whose depth says what pictures of files show."""
    partial: bool = False
    """True: measure the views that all methods have."""


def measure_scene(
    subject: Subject, entries: Sequence[Entry], choices: Choices, plugins: Plugins, folder: Path, stem: str
) -> dict[str, Any]:
    """Measures methods on a scene and writes crops into a folder; returns the results.

    stem: begins the names of crops.

    Raises:
        ConfigError, InputError: a setting, the scene or a method cannot be measured.
    """
    settings = with_small_cache(compose(subject.overrides, plugins))
    if settings.evaluation.right_halves:
        raise ConfigError(
            f"gsx judge compares pictures as they are: leave out eval.colours={settings.evaluation.colours} eval.poses="
            f"{settings.evaluation.poses}, which `gsx eval` has"
        )
    prepare_process(choose_device(settings.general.device), training=False)
    scene = load_scene(settings)
    if not scene.test:
        raise ConfigError("gsx judge compares with test views: choose another split than scene.split=none")
    refuse_other_views(subject, scene)
    methods = methods_of(subject, entries, choices, settings, plugins, scene)
    zooms = zooms_of(subject, methods, settings.evaluation.zoom)
    refuse_unmeasurable(methods, zooms, scene)
    scene = with_shared_views(scene, methods, zooms) if choices.partial else scene
    for method in methods:
        log_notes(method, zooms, scene)
    with tempfile.TemporaryDirectory() as work:
        how = protocol_for(settings, scene, zooms, Path(work))
        measurement, crops = Measurement(scene, how, methods, zooms), Crops(folder, scene, stem)
        logger.info("measuring %d test views of %s at %s", len(scene.test), scene.name, listed(zooms))
        found = measurement.run(crops.receive, Countdown("measuring", measurement.work()).advance)
    return {
        "scene": scene.name,
        "named": subject.name or scene.name,
        "settings": list(subject.overrides),
        "protocol": protocol_of(scene, settings.evaluation, how.lpips.name if how.lpips else "n/a (no weights)"),
        **how.perceptual.provenance,
        **({"competitor": how.competitor.provenance()} if how.competitor else {}),
        "methods": [result_of(one, scene) for one in found],
        "pictures": crops.index(),
    }


def refuse_other_views(subject: Subject, scene: Scene) -> None:
    """Raises InputError if a scene no longer has the test views that it was prepared with."""
    now = {view.name for view in scene.test}
    before = set(subject.aliases or now)
    if before != now:
        name = sorted(before ^ now)[0]
        change = "holds out" if name in now else "no longer holds out"
        raise InputError(
            f"'{subject.prepared}' was prepared with other test views: the scene {change} '{name}': prepare it again"
        )


def methods_of(
    subject: Subject,
    entries: Sequence[Entry],
    choices: Choices,
    settings: Settings,
    plugins: Plugins,
    scene: Scene,
) -> list[Method]:
    """Opens models and matches pictures with views, by words METHOD=PATH."""
    own = [replace(one, path=place_for(one.path, subject.name or scene.name)) for one in entries]

    def model(entry: Entry) -> Model:
        return opened_model(entry, subject.overrides, settings, plugins, scene)

    if choices.depth and not is_model(choices.depth):
        raise InputError(
            f"--depth {choices.depth} is neither a run folder nor a splat file ({READABLE}): give one of these"
        )
    depth = model(Entry(name="--depth", path=choices.depth)) if choices.depth else None
    names = names_of_views(scene.test, {view: bare(file) for view, file in (subject.aliases or {}).items()})
    order = None if choices.order is None else ordered_views(choices.order, names)
    zooms = [*settings.evaluation.zoom, *subject.prepared_zooms]
    matcher = Matcher(scene.test, names, zooms, order, choices.partial)

    def method(entry: Entry) -> Method:
        return model(entry) if is_model(entry.path) else PictureFolder(entry, scene, matcher, depth)

    return [method(entry) for entry in own]


def place_for(path: Path, scene: str) -> Path:
    """Returns a path with `{scene}` replaced; InputError: it does not exist, or is another kind of file."""
    place = Path(str(path).replace("{scene}", scene))
    if not place.exists():
        raise InputError(f"'{place}' does not exist: give a folder of pictures, a splat file or a run folder")
    if not place.is_dir() and not is_model(place):
        raise InputError(f"'{place}' is no splat file ({READABLE}): give a folder of pictures, or a run folder")
    return place


def ordered_views(path: Path, names: Mapping[str, View]) -> list[View]:
    """Returns the views that a list names; InputError: it names another, or one twice."""
    listed = read_order(path)
    unknown = [name for name in listed if bare(name) not in names]
    if unknown:
        raise InputError(f"--order {path}: '{unknown[0]}' is no test view; the first is '{next(iter(names))}'")
    views = [names[bare(name)] for name in listed]
    twice = next((name for name, view in zip(listed, views, strict=True) if views.count(view) > 1), "")
    if twice:
        raise InputError(f"--order {path} names '{twice}' twice: name the view of each picture once, in their order")
    return views


def zooms_of(subject: Subject, methods: Sequence[Method], chosen: Sequence[float]) -> list[float]:
    """Returns the zooms to measure: those that `eval.zoom` sets, else of the pictures, else of the prepared scene."""
    own = subject.overrides[subject.own :]
    if any(word.startswith("eval.zoom=") for word in own):
        return sorted(set(chosen))
    found = {factor for method in methods for factor in method.factors() or ()}
    return sorted(found or subject.prepared_zooms or chosen)


def refuse_unmeasurable(methods: Sequence[Method], zooms: Sequence[float], scene: Scene) -> None:
    """Raises InputError if no method has a picture, and no photo allows one, at any of the zooms."""
    cameras = (method.camera(view, zoom) for method in methods for zoom in zooms for view in scene.test)
    if all(camera is None for camera in cameras):
        raise InputError(
            f"no method has a picture at {listed(zooms)}: choose other zooms by eval.zoom, or leave it out"
        )


def with_shared_views(scene: Scene, methods: Sequence[Method], zooms: Sequence[float]) -> Scene:
    """Returns the scene with the test views that all methods have, at each zoom that they have; InputError: none."""

    def lacks(method: Method, view: View) -> bool:
        return any(method.camera(view, factor) is None for factor in set(method.factors() or zooms) & set(zooms))

    lacking = {method: [view for view in scene.test if lacks(method, view)] for method in methods}
    for method, views in lacking.items():
        if views:
            method.notes.append(f"has no pictures of {counted(len(views), 'test view')}, such as '{views[0].name}'")
    views = [view for view in scene.test if not any(view in one for one in lacking.values())]
    if not views:
        raise InputError("no test view has pictures of all methods: compare them one by one")
    if len(views) < len(scene.test):
        logger.warning("%d of %d test views have pictures of all methods and are measured", len(views), len(scene.test))
    return replace(scene, test=views)


def log_notes(method: Method, zooms: Sequence[float], scene: Scene) -> None:
    """Completes the notes of a method and logs them."""
    if (factors := method.factors()) is not None:
        missing = [factor for factor in zooms if factor not in factors]
        unused = [factor for factor in factors if factor not in zooms]
        method.notes += [f"there are no pictures at {listed(missing)}"] if missing else []
        method.notes += [f"pictures at {listed(unused)} are not measured"] if unused else []
    for factor, level in own_truth_psnr(method, scene).items():
        method.notes.append(
            f"the photos that it compared with at x{factor} differ from those of this protocol: {level:.2f} dB"
        )
    for note in method.notes:
        logger.info("%s: %s", method.entry, note)


def listed(zooms: Sequence[float]) -> str:
    """Formats zooms."""
    return ", ".join(f"x{factor:g}" for factor in zooms)


def protocol_for(settings: Settings, scene: Scene, zooms: Sequence[float], folder: Path) -> Protocol:
    """Loads metrics and the upscaler that renders compete with."""
    options, device = settings.evaluation, choose_device(settings.general.device)
    metrics = MetricSettings(
        input_range=options.lpips.input_range, pixels=options.perceptual_pixels, device=device, photos=scene.train
    )
    return Protocol(
        options=options,
        perceptual=load_metrics(options.perceptual, metrics),
        lpips=load_lpips(options.lpips),
        competitor=competitor_on(settings, scene, zooms, folder),
        backend=settings.raster.backend.on(device.type),
    )


def competitor_on(settings: Settings, scene: Scene, zooms: Sequence[float], folder: Path) -> Competitor | None:
    """Returns the upscaler of x1 pictures; None: there is none, or it reaches none of the zooms."""
    if (chosen := settings.competitor) is None:
        return None
    component = chosen.component
    context = RegeneratorContext(
        views=scene.train,
        reduction=scene.reduction,
        render=lambda camera: refuse_learning(component.name)(0)[0],
        held_out=refuse_learning(component.name),
        step=0,
        seed=0,
        device=choose_device(settings.general.device),
        folder=folder,
    )
    return competitor_for(scene, component.name, lambda: component.factory(chosen.options), zooms, context)


def result_of(measured: Measured, scene: Scene) -> dict[str, Any]:
    """Returns the results of one method."""
    entry, zooms, notes = measured.method.entry, measured.means(), list(measured.method.notes)
    if zooms and min(figures["psnr"] for figures in zooms.values()) == math.inf:
        notes.append("these are the photos themselves: all pixels are equal")
    return {
        "name": entry.name,
        "repetition": entry.repetition,
        "path": str(entry.path),
        **measured.method.facts(),
        "notes": notes,
        "zoom": zooms,
        "views": measured.views,
    }
