"""One run from settings to report: build, train, evaluate, write. Also opens finished runs again."""

import logging
import math
import os
import platform
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from gsx import __version__
from gsx.core.cache import cache_root, source_revision
from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene, View
from gsx.core.device import device_name
from gsx.core.errors import CheckpointError, ConfigError, Disagreement, InputError, TrainingError, nearest
from gsx.core.evaluation.evaluator import Evaluator
from gsx.core.files import write_json
from gsx.core.gaussians.splat_files import read_gaussians, splats_of, write_columns, write_gaussians
from gsx.core.plugins import Plugins, hookimpl
from gsx.core.quality.lpips import load_lpips
from gsx.core.quality.metrics import psnr
from gsx.core.rasterizer import RasterSettings, rasterize_tiled
from gsx.core.rasterizer.prepare import decide, path_of, warm
from gsx.core.run_folder import checkpoint
from gsx.core.run_folder.files import RunFiles, read_run
from gsx.core.run_folder.run_key import (
    composition_key,
    finished,
    judging,
    other_revision,
    place_of,
    scene_stamp,
    trained_on,
)
from gsx.core.training.augmenter import Augmenter, AugmenterContext
from gsx.core.training.backbone import Backbone, BackboneContext
from gsx.core.training.distributed import placed, ranks_here, refuse_uneven
from gsx.core.training.guard import Agreement, Guard
from gsx.core.training.regenerator import Regenerator
from gsx.core.training.remarks import CapNotice, remarks_of
from gsx.core.training.render import render
from gsx.core.training.run import Run, Sampler, Step
from gsx.core.training.trainer import train
from gsx.experiments.reports.pictures import Pictures, file_names
from gsx.experiments.reports.report import write_report
from gsx.experiments.runs import warm_start as trunk
from gsx.experiments.runs.config import Settings, read_config, write_config
from gsx.experiments.runs.orbit import orbit_cameras, write_animation
from gsx.experiments.runs.progress import Countdown, MetricsLog, Progress, read_curves
from gsx.experiments.runs.pseudo_pictures import write_pseudo_pictures
from gsx.experiments.runs.tracking import build_trackers, telling_of_failure

logger = logging.getLogger(__name__)

HIDDEN_SHARE, LARGEST_EXTENT = 0.02, 1e3
"""If near planes hide more of the points, or cameras stand farther apart, units are not those that 3D-GS expects."""
PACKAGES = ("torch", "numpy", "hydra-core", "omegaconf", "pycolmap", "OpenImageIO", "kornia", "pluggy", "safetensors")


class Checkpointer:
    """Listener: saves every `training.checkpoint_every` steps and when training ends, complete or not."""

    @hookimpl
    def gsx_step_finished(self, run: Run, step: Step) -> None:
        """Save when due."""
        if run.step % run.training.checkpoint_every == 0 and not run.complete:
            checkpoint.save(run)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Save the last state."""
        checkpoint.save(run)


def choose_device(name: str) -> torch.device:
    """auto: a GPU where there is one.

    Raises:
        ConfigError: the name is unknown or the device absent.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device is '{name}'; choose auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device is cuda, but this torch finds no CUDA device: use device=cpu or device=auto")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")


def refuse_used(folder: str) -> None:
    """Raise InputError if the run folder asked for exists and holds something."""
    if folder and Path(folder).exists() and (not Path(folder).is_dir() or any(Path(folder).iterdir())):
        raise InputError(f"folder={folder} is not empty: choose another, or go on with `gsx resume {folder}`")


def new_folder(settings: Settings, scene: Scene) -> Path:
    """A fresh run folder.

    Raises:
        InputError: no free name was found.
    """
    if settings.general.folder:
        folder = Path(settings.general.folder)
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    parent = Path(settings.general.output) / scene.name / settings.backbone.component.name
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for suffix in ("", *(f"_{n}" for n in range(2, 1000))):
        try:
            (parent / (stamp + suffix)).mkdir(parents=True)
            return parent / (stamp + suffix)
        except FileExistsError:  # another run began in the same second
            continue
    raise InputError(f"no free run folder below {parent}: clean it up or set folder=NEW_FOLDER")


def build(settings: Settings, scene: Scene, folder: Path, training: bool = False) -> Run:
    """Everything of a run in memory, at step 0; `training`: it is to go on, with augmenters, and by the path of the
    rasterizer that suits training. Looking at a run needs none of what its regenerators need."""
    general, ranks = settings.general, ranks_here()
    device = placed(choose_device(general.device))
    if training:
        refuse_uneven(settings.training.batch, ranks)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)  # of an earlier run in this process
    torch.manual_seed(general.seed)
    generator = torch.Generator().manual_seed(general.seed)
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(cache_root() / "compiled"))  # torch's own is lost on restart
    raster = decide(settings.raster, general.iterations, device) if training else settings.raster

    def anew(scene: Scene, iterations: int, generator: torch.Generator) -> Backbone:
        context = BackboneContext(scene=scene, iterations=iterations, device=device, raster=raster, generator=generator)
        return settings.backbone.component.factory(settings.backbone.options, context)

    backbone = anew(scene, general.iterations, generator)
    return Run(
        config=settings.resolved,
        folder=folder,
        scene=scene,
        backbone=backbone,
        raster=backbone.raster,
        training=settings.training,
        iterations=general.iterations,
        device=device,
        generator=generator,
        sampler=Sampler(len(scene.train), general.seed, batch=settings.training.batch),
        anew=anew,
        augmenters=build_augmenters(settings, scene) if training else [],
        ranks=ranks,
    )


def build_augmenters(settings: Settings, scene: Scene) -> list[Augmenter]:
    """The augmenters of a run, in order; they share regenerators by role."""
    built: dict[str, Regenerator] = {}

    def regenerator(role: str) -> Regenerator:
        if role not in settings.regenerators:
            raise ConfigError(f"no regenerator is chosen for '{role}': add regenerator/{role}=NAME")
        if role not in built:
            chosen = settings.regenerators[role]
            built[role] = chosen.component.factory(chosen.options)
        return built[role]

    out = []
    for name, chosen in settings.augmenters.items():
        context = AugmenterContext(
            name=name,
            scene=scene,
            iterations=settings.general.iterations,
            seed=settings.general.seed,
            regenerator=regenerator,
        )
        out.append(chosen.component.factory(chosen.options, context))
    shares = {name: float(a.plan().get("share", 0)) for name, a in zip(settings.augmenters, out, strict=True)}
    if sum(shares.values()) >= 1:
        listed = ", ".join(f"{name} {share:g}" for name, share in shares.items())
        raise ConfigError(f"augmenters take the whole loss of the photographs ({listed}): lower their weights")
    return out


def plan_of(run: Run) -> dict[str, Any]:
    """The rescaled schedules of the backbone and of the augmenters."""
    names = run.config.get("augmenter") or {}
    return run.backbone.plan() | {name: a.plan() for name, a in zip(names, run.augmenters, strict=True)}


def environment(run: Run, plugins: Plugins) -> dict[str, Any]:
    """Machine, versions and the rescaled schedule, for environment.json."""
    return {
        "gsx": __version__,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "rasterizer": path_of(run.raster, run.device),
        "source": source_revision(),
        "device": device_name(run.device),
        "processes": run.ranks.size,
        "packages": {name: installed_version(name) for name in PACKAGES},
        "plugins": plugins.versions,
        "plan": plan_of(run),
        "scene": {
            "stamp": scene_stamp(run.config),
            "train_views": len(run.scene.train),
            "test_views": len(run.scene.test),
            "points": len(run.scene.points),
            "extent": run.scene.extent,
            "notes": list(run.scene.notes),
        },
    }


def installed_version(package: str) -> str:
    """Version of an installed distribution."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def announce(run: Run, plugins: Plugins) -> None:
    """Say what is about to be trained, and by which schedule."""
    scene = run.scene
    (width, height), points = scene.train[0].camera.size, f"{len(scene.points):,}"
    views = f"{len(scene.train)} training and {len(scene.test)} test views of {width}x{height} px"
    logger.info("scene %s: %s, %s points, extent %.3g", scene.name, views, points, scene.extent)
    for note in scene.notes:
        logger.info("note: %s", note)
    for failure in plugins.failures:
        logger.warning("plugin %s did not load: %s", failure.plugin, failure.reason)
    for name, part in plan_of(run).items():
        logger.info("plan of %s: %s", name, ", ".join(f"{key} {in_words(value)}" for key, value in part.items()))
    logger.info(
        "seed %s, %d threads, %s; run folder %s", run.config["seed"], torch.get_num_threads(), run.device, run.folder
    )


def in_words(value: float | list[float]) -> str:
    """A number of the plan, or several."""
    return " ".join(f"{v:.6g}" for v in value) or "none" if isinstance(value, list) else f"{value:.6g}"


def load_scene(settings: Settings) -> Scene:
    """The scene, with views to evaluate on.

    Raises:
        InputError: it cannot be loaded, the split leaves no test views, or cameras and points are all in one place.
    """
    loaded = settings.scene.component.factory(settings.scene.options)
    scene = warned_of_units(measured(in_units(loaded, getattr(settings.scene.options, "unit", 1.0))))
    if not scene.test:
        raise InputError(f"scene '{scene.name}' has no test views to evaluate on: choose another scene.split")
    if not scene.extent > 0:
        raise InputError(
            f"all {len(scene.train)} training cameras of scene '{scene.name}' stand at one place, and no points lie "
            "elsewhere, which gives no depth and no scale: use photos from different places"
        )
    return scene


def start(settings: Settings, plugins: Plugins) -> Run:
    """Load the scene and build a run in a new folder, with config.yaml and environment.json written.

    Of several processes the first does what concerns the folder.

    Raises:
        ConfigError, InputError: something is wrong; no folder was made.
    """
    ranks = ranks_here()
    if settings.general.iterations < 1:
        raise ConfigError(f"iterations is {settings.general.iterations}; give at least 1")
    choose_device(settings.general.device)
    ranks.broadcast(lambda: refuse_used(settings.general.folder))
    refuse_uneven(settings.training.batch, ranks)
    load_lpips(settings.evaluation.lpips)  # wrong weights are refused now, not after training
    build_trackers(settings.trackers)  # the same: a missing package
    run = build(settings, ranks.rank0_first(lambda: load_scene(settings)), Path(), training=True)
    run.folder = ranks.broadcast(lambda: begun(run, settings, plugins))
    if not ranks.first and checkpoint.sidecars(run.folder / "checkpoints"):  # of a trunk
        checkpoint.restore(run)
    return run


def begun(run: Run, settings: Settings, plugins: Plugins) -> Path:
    """The folder of a new run, with what is known before its first step; `init=trunk`: at a state it branches from."""
    run.folder = new_folder(settings, run.scene)
    try:
        write_config(run.folder / "config.yaml", settings.resolved)
        write_json(run.folder / "environment.json", environment(run, plugins))
        if settings.general.init == "trunk":
            run.trunk = trunk.trunk_folder(run, plugins.versions)
            trunk.adopt(run, run.trunk)
            run.curves = read_curves(run.folder)
    except OSError:
        shutil.rmtree(run.folder, ignore_errors=True)
        raise
    return run.folder


def open_run(
    folder: Path, plugins: Plugins, overrides: Sequence[str] = (), training: bool = False
) -> tuple[Run, Settings]:
    """A run as its newest checkpoint left it; `training`: it is about to go on.

    Raises:
        InputError: the folder is no run.
        CheckpointError: there is no usable checkpoint.
    """
    if not (folder / "config.yaml").is_file():
        raise InputError(f"{folder} is no run folder (it has no config.yaml): give a folder that `gsx` made")
    settings = read_config(folder / "config.yaml", plugins, overrides)
    return restored(settings, folder, training), settings


def restored(settings: Settings, folder: Path, training: bool = False) -> Run:
    """The run of a folder, by these settings, as its newest checkpoint left it; see `open_run`."""
    run = build(settings, ranks_here().rank0_first(lambda: load_scene(settings)), folder, training)
    checkpoint.restore(run)
    run.curves = [line for line in read_curves(folder) if line["step"] <= run.step]
    return run


def resume_or_start(settings: Settings, plugins: Plugins, stamp: str) -> tuple[Path, Run | None]:
    """The folder of a composition, and its run as far as it has come; no run if there is nothing left to do.

    `stamp`: of its scene.

    What was finished is not done again, what was interrupted goes on where it stopped, and what was judged otherwise is
    judged anew. To be called with the folder `claimed`.

    Raises:
        ConfigError, InputError: something is wrong; no folder was made.
    """
    folder = place_of(settings.resolved, stamp)
    files = read_run(folder)
    if finished(files, settings.resolved, stamp):
        logger.info("finished earlier%s: %s", by_another(files), folder)
        return folder, None
    at_hand = replace(settings, general=replace(settings.general, folder=str(folder), reuse=False))
    try:
        if not checkpoint.sidecars(folder / "checkpoints"):
            raise CheckpointError(f"{folder} holds no checkpoint")
        if composition_key(files.config, trained_on(files)) != folder.name:
            raise CheckpointError(f"{folder} was trained on by another composition than the one it is named by")
        run = restored(settings, folder, training=True)
    except CheckpointError as error:
        set_aside(folder, str(error))
        return folder, start(at_hand, plugins)
    logger.info("going on with %s at step %d", folder, run.step)
    write_config(folder / "config.yaml", settings.resolved)
    if settings.general.init == "trunk":
        run.trunk = trunk.trunk_folder(run, plugins.versions)
    return folder, run


def by_another(files: RunFiles) -> str:
    """Words for what another revision of the source has trained; none for what this one has."""
    revision = other_revision(files, this := source_revision())
    return f" by another revision of gsx's source ({revision}, this is {this})" if revision else ""


def say_what_changed(run: Run) -> None:
    """Warn of a run that goes on with other files or another revision of the source than it began with.

    environment.json then names this revision, too.
    """
    files = read_run(run.folder)
    if trained_on(files) not in ("", scene_stamp(run.config)):
        logger.warning("files of scene %s are not those that the run began with", run.scene.name)
    revisions = str(files.environment.get("source", "")).split("+")
    if files.environment and revisions[-1] != source_revision():
        logger.warning("the run was begun%s", by_another(files))
        write_json(
            run.folder / "environment.json", files.environment | {"source": "+".join([*revisions, source_revision()])}
        )


def set_aside(folder: Path, reason: str) -> None:
    """Make room for a run in a folder without a checkpoint that it could use; what has results is kept beside it."""
    if not folder.exists():
        return
    results = [folder / "evaluation.json", folder / "point_cloud.ply", *checkpoint.sidecars(folder / "checkpoints")]
    if not any(path.exists() for path in results):
        shutil.rmtree(folder)
        return
    kept = next(p for n in range(1, 1000) if not (p := folder.parent / f".{folder.name}_set_aside_{n}").exists())
    folder.rename(kept)
    logger.warning("%s; kept as %s, training anew", reason, kept)


def in_units(scene: Scene, unit: float) -> Scene:
    """The scene with positions of cameras and points multiplied by `unit`.

    Raises:
        ConfigError: `unit` is not a positive number.
    """
    if not 0 < unit < math.inf:
        raise ConfigError(f"scene.unit is {unit}; give a positive number")
    if unit == 1:
        return scene
    return replace(
        scene,
        train=[rescaled(view, unit) for view in scene.train],
        test=[rescaled(view, unit) for view in scene.test],
        points=replace(scene.points, positions=scene.points.positions * unit),
        extent=scene.extent * unit,
        notes=[*scene.notes, f"positions are multiplied by scene.unit={unit:g}"],
    )


def rescaled(view: View, unit: float) -> View:
    """The view with its camera's position multiplied by `unit`."""
    return replace(view, camera=replace(view.camera, translation=view.camera.translation * unit))


def measured(scene: Scene) -> Scene:
    """The scene; one whose training cameras stand in one place takes its extent from the points' median distance."""
    if scene.extent > 0 or len(scene.points) == 0:
        return scene
    distance = offsets_from(scene.points.positions, scene.train[0].camera.centre).norm(dim=1)
    extent = 1.1 * float(distance.median())
    note = f"all training cameras stand at one place: the extent {extent:.3g} is 1.1 x the points' median distance"
    return replace(scene, extent=extent, notes=[*scene.notes, note])


def hidden_share(scene: Scene) -> float:
    """Share of the points in front of training cameras that their near planes hide."""
    front = hidden = 0
    for view in scene.train:
        depth = view.camera.project(scene.points.positions)[1]
        front += int((depth > 0).sum())
        hidden += int(((depth > 0) & (depth <= view.camera.near)).sum())
    return hidden / max(1, front)


def warned_of_units(scene: Scene) -> Scene:
    """The scene, with a note if its units are far from those that published constants expect."""
    share = hidden_share(scene)
    if share <= HIDDEN_SHARE and scene.extent <= LARGEST_EXTENT:
        return scene
    odd = f"the extent is {scene.extent:.3g} scene units, and near planes hide {share:.0%} of the points before cameras"
    better = 10.0 ** -math.floor(math.log10(scene.extent)) if scene.extent > 0 else 1.0
    return replace(
        scene, notes=[*scene.notes, f"{odd}: published constants expect a few units, try scene.unit={better:g}"]
    )


def status(run: Run, state: str, reason: str = "") -> None:
    """Record how the run stands, for reports over many runs."""
    write_json(run.folder / "status.json", {"state": state, "reason": reason, "step": run.step})


def execute(run: Run, settings: Settings, plugins: Plugins) -> None:
    """Train from the current step on; when complete, evaluate and report. Interrupted runs keep a checkpoint.

    All ranks but the first only train.
    """
    if not run.ranks.first:
        follow(run, plugins)
        return
    trackers = build_trackers(settings.trackers)
    if not run.complete:
        say_what_changed(run)
    announce(run, plugins)
    warm(run.raster, run.device)
    status(run, "running")
    log = MetricsLog(settings.evaluation)
    listeners: list[object] = [
        Guard(),
        Agreement(),
        CapNotice(),
        log,
        *trackers,
        Checkpointer(),
        Progress(),
    ]  # trackers read the log
    if run.trunk is not None:
        general = settings.general
        listeners.append(trunk.TrunkKeeper(run.trunk, general.trunk_gb * 1e9, general.trunk_at))
    try:
        with plugins.listening(listeners), telling_of_failure(run, plugins):
            train(run, plugins)
            if run.complete:
                finish(run, settings, plugins)
    except TrainingError as error:
        if not isinstance(error, Disagreement):
            checkpoint.save(run)
        status(run, "failed", str(error))
        raise
    except BaseException as error:
        status(run, "failed", f"{type(error).__name__}: {error}")
        raise
    finally:
        log.close()
    if not run.complete:
        status(run, "interrupted")
        write_report(run.folder)


def follow(run: Run, plugins: Plugins) -> None:
    """Train as another process does, and write nothing."""
    warm(run.raster, run.device)
    with plugins.listening([Guard(), Agreement()]):
        train(run, plugins)


def as_trained(run: Run) -> RasterSettings:
    """The rules a run is drawn by, with path=auto as its training decided it, so that times are those of one path."""
    path = read_run(run.folder).environment.get("rasterizer")
    return replace(run.raster, path=path) if run.raster.path == "auto" and path == "compiled" else run.raster


def finish(run: Run, settings: Settings, plugins: Plugins) -> dict[str, Any]:
    """Evaluate, export, draw and report a trained run."""
    evaluation = evaluate(run, settings)
    plugins.emit.gsx_evaluated(run=run, evaluation=evaluation)
    write_report(run.folder)
    export(run, run.folder / "point_cloud.ply")
    status(run, "ok")
    plugins.emit.gsx_run_finished(run=run)
    return evaluation


def evaluate(run: Run, settings: Settings) -> dict[str, Any]:
    """Write evaluation.json and the pictures of a run."""
    options, begun = settings.evaluation, time.perf_counter()
    logger.info("evaluating %d test views at zoom %s", len(run.scene.test), options.zoom)
    evaluator, pictures = Evaluator(run, options), Pictures(run.folder / "renders", run.step)
    evaluation = evaluator.evaluate(pictures, Countdown("evaluating", evaluator.work()).advance)
    pictures.write_index()
    write_pseudo_pictures(run, options)
    evaluation |= {"evaluate_seconds": time.perf_counter() - begun, "judged": judging(settings.resolved)}
    tell_of_paths(read_run(run.folder).evaluation, evaluation)
    write_json(run.folder / "evaluation.json", evaluation)
    for line in [*summary(evaluation), *remedies(run, evaluation, options.remedy)]:
        logger.info("%s", line)
    return evaluation


def tell_of_paths(before: dict[str, Any], now: dict[str, Any]) -> None:
    """Say so if another path of the rasterizer has drawn what was timed in an earlier evaluation."""
    path = before.get("render_path")
    if path and path != now["render_path"]:
        logger.warning(
            "renders/s are now by the %s path; the evaluation before had %.1f by the %s path, which are not comparable",
            now["render_path"], before["render_fps"], path,
        )  # fmt: skip


def summary(evaluation: dict[str, Any]) -> list[str]:
    """The result in a few lines."""
    e, path = evaluation, evaluation["render_path"]
    lpips = "n/a (no weights)" if e["lpips"] is None else f"{e['lpips']:.4f}"
    memory = "n/a" if e["peak_memory_mb"] is None else f"{e['peak_memory_mb']:,.0f} MB"
    lines = [
        f"held-out PSNR {e['psnr']:.2f} dB, SSIM ({e['protocol']['ssim']}) {e['ssim']:.4f}, LPIPS {lpips}",
        f"{e['primitives']:,} primitives, {e['megabytes']:.1f} MB, {e['render_fps']:.1f} renders/s ({path}), "
        f"{e['train_seconds']:.0f} s of training, {e['evaluate_seconds']:.0f} s of evaluation, "
        f"peak memory {memory}",
    ]
    return lines + [zoom_line(factor, result) for factor, result in e["zoom"].items()] + remarks_of(e)


def remedies(run: Run, evaluation: dict[str, Any], remedy: str) -> list[str]:
    """What to try where a render zoomed in loses to the enlarged one, and is not yet compensated for dilation."""
    lost = [
        factor for factor, e in evaluation["zoom"].items() if float(factor) > 1 and e.get("beats_enlarged") is False
    ]
    if not lost or not remedy or run.raster.compensate:
        return []
    return [f"a model that is filtered for zooming in: the same command with {remedy}"]


def zoom_line(factor: str, result: dict[str, Any]) -> str:
    """One zoom figure with its verdict."""
    if "unavailable" in result:
        return f"zoom x{factor}: n/a, {result['unavailable']}"
    if factor == "1":
        return f"zoom x1: {result['psnr']:.2f} dB"
    resized = "enlarged" if float(factor) > 1 else "reduced"
    verdict = "wins against" if result["beats_enlarged"] else "loses to"
    return (
        f"zoom x{factor}: {result['psnr']:.2f} dB, {verdict} the {resized} x1 render ({result['enlarged_psnr']:.2f} dB)"
    )


def export(run: Run, path: Path, camera: Camera | None = None) -> None:
    """Write the backbone's splat file, or what it draws for one camera as a standard one.

    The comments hold the conventions that a viewer must know.
    """
    comments = [
        f"gsx {__version__}, step {run.step}, scene {run.scene.name}, in its units times {unit_of(run):g}",
        f"screen dilation {run.raster.dilation} px^2, {'with' if run.raster.compensate else 'no'} opacity compensation",
        *run.backbone.export_notes(),
        *([f"SplatRenderMode: {render_mode(run.raster)}"] if camera is not None or run.backbone.standard_file else []),
        "quaternions w x y z; scales ln; opacity logit; f_rest channel-major",
    ]
    if camera is None:
        write_columns(path, run.backbone.file(), comments)
    else:
        write_gaussians(path, run.backbone.explicit(camera, run.model_step), comments)


def render_mode(raster: RasterSettings) -> str:
    """What viewers are to do about their screen dilation: `mip` compensates opacities for it, `default` does not.

    Values of the comment SplatRenderMode, which Brush writes and SuperSplat reads (spec B6 of splat formats).
    """
    return "mip" if raster.compensate else "default"


def unit_of(run: Run) -> float:
    """What the scene's positions were multiplied by."""
    return float(run.config["scene"].get("unit", 1.0))


def view_named(run: Run, name: str) -> View:
    """A training or test view by name.

    Raises:
        InputError: there is none; the nearest name is given.
    """
    views = {view.name: view for view in [*run.scene.test, *run.scene.train]}
    if name not in views:
        raise InputError(f"'{name}' is no view of scene '{run.scene.name}'.{nearest(name, list(views))}")
    return views[name]


def render_test_views(run: Run, settings: Settings, folder: Path, zoom: float) -> None:
    """Write every test view at `zoom` times the training resolution as PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    for view, name in zip(run.scene.test, file_names([view.name for view in run.scene.test]), strict=True):
        picture = render(run, view.camera.zoom(zoom), settings.evaluation.tile_pixels)
        write_image(folder / f"{name}.png", picture.image)


def render_orbit(run: Run, settings: Settings, path: Path, frames: int, fps: float, zoom: float) -> None:
    """Animate a closed path around the scene."""
    pixels = settings.evaluation.tile_pixels
    cameras = (camera.zoom(zoom) for camera in orbit_cameras(run.scene, frames))
    write_animation(path, (render(run, camera, pixels).image for camera in cameras), fps)


def reimport_psnr(run: Run, settings: Settings, path: Path, views: Sequence[View]) -> str:
    """PSNR between the model and its exported standard file, both rendered from up to five views."""
    gaussians, pixels = read_gaussians(path), settings.evaluation.tile_pixels
    figures = []
    for view in views[:5]:
        splats = splats_of(gaussians, view.camera.centre)
        again = rasterize_tiled(splats, view.camera, run.raster, background=run.background.cpu(), pixels=pixels)
        figures.append(psnr(again.image.clamp(0, 1), render(run, view.camera, pixels).image))
    return f"{min(figures):.1f} dB at worst over {len(figures)} views (inf: identical)"
