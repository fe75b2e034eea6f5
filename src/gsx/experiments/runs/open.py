"""Run folders: created for a new run, opened again, continued."""

import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from gsx.core.data.scene import Scene
from gsx.core.errors import CheckpointError, ConfigError, InputError, command
from gsx.core.files import read_json, remove_partial, sync_folder, write_json
from gsx.core.packages import require
from gsx.core.plugins import Plugins
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.augmenter import recall_accounts
from gsx.core.training.run import Run
from gsx.engine.cache import source_revision
from gsx.engine.collector import gc_paused
from gsx.engine.joined_ranks import current_ranks
from gsx.experiments.evaluation.lpips import load_lpips
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.run_folder.claims import LOCK, claimed
from gsx.experiments.run_folder.files import RunFiles, read_run
from gsx.experiments.run_folder.run_key import composition_key, finished, other_revision, place_of, trained_on
from gsx.experiments.run_folder.shapes import is_number
from gsx.experiments.runs import warm_start
from gsx.experiments.runs.build import build, choose_device, refuse_uneven
from gsx.experiments.runs.early_compiling import compiling_before
from gsx.experiments.runs.environment import environment
from gsx.experiments.runs.file_axes import start_in_scene
from gsx.experiments.runs.history import record_changes
from gsx.experiments.runs.load_scene import load_scene, refuse_absent_scene
from gsx.experiments.runs.overrides import key_of
from gsx.experiments.runs.progress import read_curves
from gsx.experiments.runs.rasterizer_path import warm
from gsx.experiments.runs.saved_settings import read_config, value_of, write_config
from gsx.experiments.runs.settings import COMPETITOR, SEVERAL, Settings, named_code
from gsx.experiments.runs.start_file import starting_splats
from gsx.experiments.runs.tracking import build_trackers
from gsx.experiments.runs.verified import verified
from gsx.formats.origin import NO_ORIGIN, Origin
from gsx.formats.suffixes import SUFFIXES, suffix_of

logger = logging.getLogger(__name__)

OF_TRAINING = (
    *("iterations", "length", "minutes", "seconds", "seed"),
    *("init", "axes", "reuse", "warm_start_at", "output", "folder"),
)
"""Keys that change how and where a run is trained, and no figure of a trained run."""


def refuse_used(folder: str, remedy: str = "") -> None:
    """Raise InputError if the run folder exists and is not empty; `remedy`: for verbs that do not train."""
    path = Path(folder)
    if folder and path.exists() and not path.is_dir():
        raise InputError(f"'{folder}' is a file, not a folder for a run: choose another place")
    if folder and path.exists() and any(one.name != LOCK for one in path.iterdir()):
        remedy = remedy or f"choose another, or continue it with `{command('resume', folder)}`"
        raise InputError(f"'{folder}' is not empty: {remedy}")


def new_folder(settings: Settings, scene: Scene) -> Path:
    """Make the folder of a new run."""
    if settings.general.folder:
        folder = Path(settings.general.folder)
        folder.mkdir(parents=True, exist_ok=True)
    else:
        folder = stamped_folder(Path(settings.general.output) / scene.name / settings.backbone.component.name)
    sync_folder(folder.parent)
    return folder


def stamped_folder(parent: Path) -> Path:
    """Make a folder named by the time."""
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for suffix in ("", *(f"_{n}" for n in range(2, 1000))):
        with suppress(FileExistsError):  # another began in the same second
            (parent / (stamp + suffix)).mkdir(parents=True)
            return parent / (stamp + suffix)
    raise InputError(f"no free folder below {parent}: clean it up or set folder=NEW_FOLDER")


def refuse_early(settings: Settings) -> None:
    """Raise ConfigError or InputError for settings that cannot train, before the scene is loaded."""
    ranks = current_ranks()
    choose_device(settings.general.device)
    refuse_absent_scene(settings)
    ranks.broadcast(lambda: refuse_used(settings.general.folder))
    refuse_uneven(settings.training.batch, ranks)
    load_lpips(settings.evaluation.lpips)  # refuses wrong weights now, not after training
    build_trackers(settings.trackers)  # the same for a missing package
    if settings.general.viewer:
        require("viewer=true", ("viser",), "gsx[viewer]")


@gc_paused()
def start(settings: Settings, plugins: Plugins, claims: ExitStack | None = None) -> Run:
    """Load the scene and build a run in a new folder, with config.yaml and environment.json.

    Rank 0 makes the folder and claims it until `claims` closes. Until then a second process may compile.

    Raises:
        ConfigError, InputError: a setting or the scene is wrong; no folder was made.
    """
    ranks = current_ranks()
    refuse_early(settings)
    content = starting_splats(settings)
    if claims is not None:
        claims.enter_context(compiling_before(settings))
    scene = ranks.rank0_first(lambda: verified(load_scene(settings)))
    start, doubts = start_in_scene(settings, scene, content)
    run = build(settings, scene, Path(), training=True, start=start)
    run.folder = ranks.broadcast(lambda: make_folder(run, settings, plugins, claims, doubts))
    if not ranks.first and checkpoint.sidecars(run.folder / "checkpoints"):  # of an earlier run
        checkpoint.restore(run, training=True)
    return run


def make_folder(
    run: Run, settings: Settings, plugins: Plugins, claims: ExitStack | None, doubts: Sequence[str]
) -> Path:
    """Make the folder of a new run with its first files; with `init=warm_start` bring the run to a kept state."""
    run.folder = new_folder(settings, run.scene)
    if claims is not None:
        claims.enter_context(claimed(run.folder))
        refuse_used(settings.general.folder)  # another process may have been faster
    try:
        write_config(run.folder / "config.yaml", settings.resolved)
        facts = environment(run, plugins, settings.idle) | ({"start": doubts} if doubts else {})
        if settings.time_plan:
            facts["minutes"] = settings.time_plan | {"repeat": list(settings.repeat)}
        write_json(run.folder / "environment.json", facts)
        if settings.general.init == "warm_start":
            warm_start.adopt(run, warm_start.warm_start_folder(run, settings.idle, plugins.versions))
            run.progress.curves = read_curves(run.folder)
    except OSError:
        shutil.rmtree(run.folder, ignore_errors=True)
        raise
    return run.folder


def refuse_other(folder: Path) -> None:
    """Raise InputError for a path that is not a run folder."""
    if folder.is_file():
        name = "" if suffix_of(folder) else f". If it holds splats, let its name end in one of {', '.join(SUFFIXES)}"
        raise InputError(f"{folder} is a file, not a run folder: give a folder that `gsx` made{name}")
    if not folder.exists():
        raise InputError(f"'{folder}' does not exist: give a run folder")
    if not (folder / "config.yaml").is_file():
        raise InputError(f"{folder} is not a run folder (it has no config.yaml): give a folder that `gsx` made")


def refuse_training(folder: Path, overrides: Sequence[str]) -> None:
    """Raise ConfigError for an override of OF_TRAINING."""
    for word in overrides:
        if key_of(word) in OF_TRAINING:
            longer = f"; {command('resume', folder, word)} trains on" if key_of(word) == "iterations" else ""
            raise ConfigError(f"'{word}' is for training and does not change what {folder} shows: leave it out{longer}")


def refuse_code(folder: Path, settings: Settings, overrides: Sequence[str], evaluating: bool = False) -> None:
    """Raise InputError for a folder that names code to run, unless the command line names the same.

    evaluating: only code that an evaluation runs.
    """
    words = [word.partition("=") for word in overrides]
    for key, code in named_code(settings).items():
        if evaluating and key != COMPETITOR:
            continue
        if code not in [str(value_of(value)) for name, _, value in words if name.startswith(f"{key}.")]:
            remedy = f"check it first, then use `{command('resume', folder, '--trust')}`"
            if evaluating:
                remedy = f"leave it out by `{command('eval', folder, f'{COMPETITOR}=null')}`, or choose it again there"
            raise InputError(f"{folder / 'config.yaml'} runs code with your permissions, {key}: '{code}': {remedy}")


def open_run(
    folder: Path,
    plugins: Plugins,
    overrides: Sequence[str] = (),
    training: bool = False,
    trusted: bool = False,
    evaluating: bool = False,
) -> tuple[Run, Settings]:
    """Return a run at its newest checkpoint, and its settings.

    training: it will be trained. trusted: it may run code that its settings name. evaluating: it will be evaluated.
    Otherwise the plugins of augmenters, regenerators and trackers need not be installed.

    Raises:
        InputError: the folder is not a run, or names code and is not trusted.
        CheckpointError: there is no usable checkpoint.
    """
    refuse_other(folder)
    spare = () if training else SEVERAL if evaluating else (*SEVERAL, COMPETITOR)
    settings = read_config(folder / "config.yaml", plugins, overrides, spare)
    if training and not trusted:
        refuse_code(folder, settings, overrides)
    return restored(settings, folder, training), settings


@contextmanager
def reopened(folder: Path, plugins: Plugins, overrides: Sequence[str]) -> Iterator[tuple[Run, Settings]]:
    """Claim a run folder and open its run to measure it again, drawn by the rasterizer path of its training.

    Raises:
        ConfigError, InputError: an override is wrong, the folder is not a run, or another process uses it.
        CheckpointError: there is no usable checkpoint.
    """
    refuse_other(folder)
    refuse_training(folder, overrides)
    with claimed(folder):
        remove_partial(folder)
        run, settings = open_run(folder, plugins, overrides, evaluating=True)
        run.raster = as_trained(run)
        warm(run)
        yield run, settings


def as_trained(run: Run) -> RasterSettings:
    """Return the rasterizer settings of a run with path=auto as its training chose it: times are then comparable."""
    path = read_run(run.folder).environment.get("rasterizer")
    return replace(run.raster, path=path) if run.raster.path == "auto" and path == "compiled" else run.raster


def trained_origin(folder: Path) -> Origin | None:
    """Return the origin of positions in a run's checkpoints; None if no checkpoint can be read."""
    for sidecar in reversed(checkpoint.sidecars(folder / "checkpoints")):
        with suppress(OSError, ValueError, AttributeError, TypeError):
            x, y, z = map(float, read_json(sidecar).get("origin", NO_ORIGIN))
            return x, y, z
    return None


def restored(settings: Settings, folder: Path, training: bool = False) -> Run:
    """Build the run of a folder by these settings and restore its newest checkpoint; see `open_run`."""
    origin = trained_origin(folder)
    checked = verified if training else (lambda scene: scene)
    scene = current_ranks().rank0_first(lambda: checked(load_scene(settings, origin)))
    run = build(settings, scene, folder, training, begins=False)
    checkpoint.restore(run, training)
    focal = read_run(folder).environment.get("training_focal")
    if run.raster.training_focal and is_number(focal):  # the scene may be loaded in another size
        run.raster = run.backbone.raster = replace(run.raster, training_focal=float(focal))
    run.progress.curves = [line for line in read_curves(folder) if line["step"] <= run.step]
    recall_accounts(run.augmenters, run.progress.curves)
    return run


def resume_or_start(settings: Settings, plugins: Plugins, stamp: str, claims: ExitStack) -> Run | None:
    """Return the run of a composition at its last step; None if it is finished. `stamp`: of its scene.

    A run that was evaluated by other settings is evaluated anew. The caller holds the folder's name (`claimed_name`);
    the folder is claimed until `claims` closes.

    Raises:
        ConfigError, InputError: a setting or the scene is wrong; no folder was made.
    """
    folder = place_of(settings.resolved, stamp, settings.idle)
    files = read_run(folder)
    if finished(files, settings.resolved, stamp, settings.idle):
        lost = f", {', '.join(files.lost)} lost since" if files.lost else ""
        revision = other_revision(files, this := source_revision())
        other = f" by another revision of gsx's source ({revision}, this is {this})" if revision else ""
        logger.info("finished earlier%s%s: %s", other, lost, folder)
        return None
    try:
        with ExitStack() as claim:
            if folder.is_dir():
                claim.enter_context(claimed(folder))
            run = continued(folder, files, settings, stamp)
            claims.push(claim.pop_all())
    except CheckpointError as error:
        set_aside(folder, str(error))
        general = replace(settings.general, folder=str(folder), reuse=False)
        return start(replace(settings, general=general), plugins, claims)
    logger.info("continuing %s at step %d", folder, run.step)
    record_changes(run, settings, plugins, changed=True)
    write_config(folder / "config.yaml", settings.resolved)
    return run


def continued(folder: Path, files: RunFiles, settings: Settings, stamp: str) -> Run:
    """Return the run of a folder that is named by its composition; raise CheckpointError if it has no checkpoint."""
    if not checkpoint.sidecars(folder / "checkpoints"):
        raise CheckpointError(f"{folder} holds no checkpoint")
    scene = trained_on(files) if files.environment else stamp  # the folder's name depends on the stamp as well
    if composition_key(files.config, scene, settings.idle) != folder.name:
        raise CheckpointError(f"{folder} holds the run of another composition than its name says")
    return restored(settings, folder, training=True)


def set_aside(folder: Path, reason: str) -> None:
    """Remove a folder without a usable checkpoint; rename it instead if it holds results."""
    if not folder.exists():
        return
    results = [folder / "evaluation.json", folder / "point_cloud.ply", *checkpoint.sidecars(folder / "checkpoints")]
    if not any(path.exists() for path in results):
        shutil.rmtree(folder)
        return
    kept = next(p for n in range(1, 1000) if not (p := folder.parent / f".{folder.name}_set_aside_{n}").exists())
    folder.rename(kept)
    logger.warning("%s; kept as %s, training anew", reason, kept)
