"""The folder of a run: made for a new one, opened again, and gone on with."""

import logging
import shutil
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from gsx.core.data.scene import Scene
from gsx.core.errors import CheckpointError, ConfigError, InputError, command
from gsx.core.files import read_json, sync_folder, write_json
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
from gsx.experiments.runs.environment import environment
from gsx.experiments.runs.file_axes import start_in_scene
from gsx.experiments.runs.history import go_on
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.overrides import key_of
from gsx.experiments.runs.progress import read_curves
from gsx.experiments.runs.saved_settings import read_config, value_of, write_config
from gsx.experiments.runs.settings import Settings, named_code
from gsx.experiments.runs.start_file import starting_splats
from gsx.experiments.runs.tracking import build_trackers
from gsx.experiments.runs.verified import verified
from gsx.formats.origin import NO_ORIGIN, Origin
from gsx.formats.suffixes import SUFFIXES, suffix_of

logger = logging.getLogger(__name__)

OF_TRAINING = ("iterations", "length", "seed", "init", "axes", "reuse", "warm_start_at", "output", "folder")
"""How long a run is trained, from what, and where it goes: nothing of what it shows once it is there."""


def refuse_used(folder: str, remedy: str = "") -> None:
    """Raises InputError if the run folder exists and holds something; `remedy`: of verbs that do not train."""
    path = Path(folder)
    if folder and path.exists() and not path.is_dir():
        raise InputError(f"'{folder}' is a file, no folder for a run: choose another place")
    if folder and path.exists() and any(one.name != LOCK for one in path.iterdir()):
        remedy = remedy or f"choose another, or go on with `{command('resume', folder)}`"
        raise InputError(f"'{folder}' is not empty: {remedy}")


def new_folder(settings: Settings, scene: Scene) -> Path:
    """Makes the folder of a new run."""
    if settings.general.folder:
        folder = Path(settings.general.folder)
        folder.mkdir(parents=True, exist_ok=True)
        sync_folder(folder.parent)
        return folder
    folder = stamped_folder(Path(settings.general.output) / scene.name / settings.backbone.component.name)
    sync_folder(folder.parent)
    return folder


def stamped_folder(parent: Path) -> Path:
    """Makes a folder named by the time.

    Raises:
        InputError: no free name was found.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for suffix in ("", *(f"_{n}" for n in range(2, 1000))):
        with suppress(FileExistsError):  # another began in the same second
            (parent / (stamp + suffix)).mkdir(parents=True)
            return parent / (stamp + suffix)
    raise InputError(f"no free folder below {parent}: clean it up or set folder=NEW_FOLDER")


@gc_paused()
def start(settings: Settings, plugins: Plugins, claims: ExitStack | None = None) -> Run:
    """Loads the scene and builds a run in a new folder, with config.yaml and environment.json written.

    Of several processes the first does what concerns the folder, which is claimed as long as `claims` lasts.

    Raises:
        ConfigError, InputError: something is wrong; no folder was made.
    """
    ranks = current_ranks()
    choose_device(settings.general.device)  # an unknown one is refused now
    ranks.broadcast(lambda: refuse_used(settings.general.folder))
    refuse_uneven(settings.training.batch, ranks)
    load_lpips(settings.evaluation.lpips)  # wrong weights are refused now, not after training
    build_trackers(settings.trackers)  # the same: a missing package
    if settings.general.viewer:
        require("viewer=true", ("viser",), "gsx[viewer]")
    content = starting_splats(settings)
    scene = ranks.rank0_first(lambda: verified(load_scene(settings)))
    start, doubts = start_in_scene(settings, scene, content)
    run = build(settings, scene, Path(), training=True, start=start)
    run.folder = ranks.broadcast(lambda: begun(run, settings, plugins, claims, doubts))
    if not ranks.first and checkpoint.sidecars(run.folder / "checkpoints"):  # of an earlier run
        checkpoint.restore(run, training=True)
    return run


def begun(run: Run, settings: Settings, plugins: Plugins, claims: ExitStack | None, doubts: Sequence[str] = ()) -> Path:
    """Makes the folder of a new run, with its first files; with `init=warm_start` it is at the state of another run."""
    run.folder = new_folder(settings, run.scene)
    if claims is not None:
        claims.enter_context(claimed(run.folder))
        refuse_used(settings.general.folder)  # by another process that was faster
    try:
        write_config(run.folder / "config.yaml", settings.resolved)
        facts = environment(run, plugins, settings.idle) | ({"start": doubts} if doubts else {})
        write_json(run.folder / "environment.json", facts)
        if settings.general.init == "warm_start":
            warm_start.adopt(run, warm_start.warm_start_folder(run, settings.idle, plugins.versions))
            run.progress.curves = read_curves(run.folder)
    except OSError:
        shutil.rmtree(run.folder, ignore_errors=True)
        raise
    return run.folder


def refuse_other(folder: Path) -> None:
    """Raises InputError for a path that is no run."""
    if folder.is_file():
        name = "" if suffix_of(folder) else f". If it holds splats, let its name end in one of {', '.join(SUFFIXES)}"
        raise InputError(f"{folder} is a file and no run folder: give a folder that `gsx` made{name}")
    if not (folder / "config.yaml").is_file():
        raise InputError(f"{folder} is no run folder (it has no config.yaml): give a folder that `gsx` made")


def refuse_training(folder: Path, overrides: Sequence[str]) -> None:
    """Raises ConfigError for an override that changes how or where a run is trained, and no figure of it."""
    for word in overrides:
        if key_of(word) in OF_TRAINING:
            longer = f"; {command('resume', folder, word)} trains on" if key_of(word) == "iterations" else ""
            raise ConfigError(
                f"'{word}' is for training, and changes nothing of what {folder} shows: leave it out{longer}"
            )


def refuse_code(folder: Path, settings: Settings, overrides: Sequence[str]) -> None:
    """Raises InputError for a folder that names code to be run, unless the command line names the same."""
    words = [word.partition("=") for word in overrides]
    for key, code in named_code(settings).items():
        if code not in [str(value_of(value)) for name, _, value in words if name.startswith(f"{key}.")]:
            raise InputError(
                f"{folder / 'config.yaml'} runs code, {key}: '{code}', which would have all your rights: look at it "
                f"first, then `{command('resume', folder, '--trust')}`"
            )


def open_run(
    folder: Path, plugins: Plugins, overrides: Sequence[str] = (), training: bool = False, trusted: bool = False
) -> tuple[Run, Settings]:
    """Returns a run as its newest checkpoint left it; `training`: it goes on; `trusted`: it may run code that it names.

    Raises:
        InputError: the folder is no run, or names code and is not trusted.
        CheckpointError: there is no usable checkpoint.
    """
    refuse_other(folder)
    settings = read_config(folder / "config.yaml", plugins, overrides)
    if training and not trusted:
        refuse_code(folder, settings, overrides)
    return restored(settings, folder, training), settings


def trained_origin(folder: Path) -> Origin | None:
    """Returns the origin of positions in a run's checkpoints.

    None: no checkpoint can be read; `checkpoint.restore` says why.
    """
    for sidecar in reversed(checkpoint.sidecars(folder / "checkpoints")):
        with suppress(OSError, ValueError, AttributeError, TypeError):
            x, y, z = map(float, read_json(sidecar).get("origin", NO_ORIGIN))
            return x, y, z
    return None


def restored(settings: Settings, folder: Path, training: bool = False) -> Run:
    """Returns the run of a folder, by these settings, as its newest checkpoint left it; see `open_run`."""
    origin = trained_origin(folder)
    checked = verified if training else (lambda scene: scene)
    scene = current_ranks().rank0_first(lambda: checked(load_scene(settings, origin)))
    run = build(settings, scene, folder, training, begins=False)
    checkpoint.restore(run, training)
    focal = read_run(folder).environment.get("training_focal")
    if run.raster.training_focal and is_number(focal):  # the scene may be looked at in another size
        run.raster = run.backbone.raster = replace(run.raster, training_focal=float(focal))
    run.progress.curves = [line for line in read_curves(folder) if line["step"] <= run.step]
    recall_accounts(run.augmenters, run.progress.curves)
    return run


def resume_or_start(settings: Settings, plugins: Plugins, stamp: str, claims: ExitStack) -> Run | None:
    """Returns the run of a composition as far as it has come; None: it is finished. `stamp`: of its scene.

    What was evaluated by other settings is evaluated anew. The folder's name must be claimed (`claimed_name`); the
    folder is, as long as `claims` lasts.

    Raises:
        ConfigError, InputError: something is wrong; no folder was made.
    """
    folder = place_of(settings.resolved, stamp, settings.idle)
    files = read_run(folder)
    if finished(files, settings.resolved, stamp, settings.idle):
        lost = f", {', '.join(files.lost)} lost since" if files.lost else ""
        logger.info("finished earlier%s%s: %s", by_another(files), lost, folder)
        return None
    at_hand = replace(settings, general=replace(settings.general, folder=str(folder), reuse=False))
    try:
        with ExitStack() as claim:
            if folder.is_dir():
                claim.enter_context(claimed(folder))
            run = continued(folder, files, settings, stamp)
            claims.push(claim.pop_all())
    except CheckpointError as error:
        set_aside(folder, str(error))
        return start(at_hand, plugins, claims)
    logger.info("going on with %s at step %d", folder, run.step)
    go_on(run, settings, plugins, changed=True)
    write_config(folder / "config.yaml", settings.resolved)
    return run


def continued(folder: Path, files: RunFiles, settings: Settings, stamp: str) -> Run:
    """Returns the run of a folder that is named by its composition.

    Raises:
        CheckpointError: there is nothing in it to go on with.
    """
    if not checkpoint.sidecars(folder / "checkpoints"):
        raise CheckpointError(f"{folder} holds no checkpoint")
    scene = trained_on(files) if files.environment else stamp  # the name of the folder tells it as well
    if composition_key(files.config, scene, settings.idle) != folder.name:
        raise CheckpointError(f"{folder} was trained on by another composition than the one it is named by")
    return restored(settings, folder, training=True)


def by_another(files: RunFiles) -> str:
    """Returns words for what another revision of the source has trained; none for what this one has."""
    revision = other_revision(files, this := source_revision())
    return f" by another revision of gsx's source ({revision}, this is {this})" if revision else ""


def set_aside(folder: Path, reason: str) -> None:
    """Makes room for a run in a folder without a usable checkpoint; one with results is kept beside it."""
    if not folder.exists():
        return
    results = [folder / "evaluation.json", folder / "point_cloud.ply", *checkpoint.sidecars(folder / "checkpoints")]
    if not any(path.exists() for path in results):
        shutil.rmtree(folder)
        return
    kept = next(p for n in range(1, 1000) if not (p := folder.parent / f".{folder.name}_set_aside_{n}").exists())
    folder.rename(kept)
    logger.warning("%s; kept as %s, training anew", reason, kept)


def as_trained(run: Run) -> RasterSettings:
    """Returns the rules of a run with path=auto as its training decided it, so that times are those of one path."""
    path = read_run(run.folder).environment.get("rasterizer")
    return replace(run.raster, path=path) if run.raster.path == "auto" and path == "compiled" else run.raster
