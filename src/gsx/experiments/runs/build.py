"""Construction of a run from settings: device, backbone, augmenters."""

import logging
import os
import platform
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch

from gsx.core.data.scene import Scene
from gsx.core.errors import ConfigError, InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.core.training.augmenter import Augmenter, AugmenterContext, Replacing
from gsx.core.training.backbone import Backbone, BackboneContext, Planned
from gsx.core.training.distributed import Ranks
from gsx.core.training.module import ModuleContext, Modules
from gsx.core.training.photo_cache import PhotoCache, room_for_photos
from gsx.core.training.regenerator import Regenerator
from gsx.core.training.run import Run
from gsx.core.training.sampler import Sampler
from gsx.core.training.training_views import TrainingViews
from gsx.engine.allocator import keep_freed_memory
from gsx.engine.cache import MANIFEST, cache_folder, content_key, make_folder
from gsx.engine.joined_ranks import current_ranks
from gsx.engine.machine import processor_kind
from gsx.engine.threads import watch_cores
from gsx.experiments.run_folder.general_options import splat_file
from gsx.experiments.runs.halves import NewBackbone, held_out_renders
from gsx.experiments.runs.rasterizer_path import decide
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_file import in_front_of, one_point, start_from

logger = logging.getLogger(__name__)


def choose_device(name: str) -> torch.device:
    """Return the device auto (a GPU if there is one), cpu or cuda; raise ConfigError for others and absent ones."""
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device is '{name}'; choose auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device is cuda, but torch finds no CUDA device: use device=cpu or device=auto")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")


def placed(device: torch.device) -> torch.device:
    """Return the device of this rank, its own GPU; raise ConfigError if there are fewer than ranks."""
    if device.type != "cuda" or current_ranks().size == 1:
        return device
    rank, count = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
    if rank >= count:
        raise ConfigError(f"process {rank} of this machine has no GPU, there are {count}: --nproc-per-node {count}")
    torch.cuda.set_device(rank)
    return torch.device("cuda", rank)


def refuse_uneven(batch: int, ranks: Ranks) -> None:
    """Raise ConfigError for a batch that the ranks cannot share."""
    if batch % ranks.size:
        raise ConfigError(
            f"training.batch is {batch}, and {ranks.size} processes share its views: give a multiple of {ranks.size}, "
            f"for example training.batch={-(-batch // ranks.size) * ranks.size}"
        )


def refuse_shared(modules: Modules, ranks: Ranks) -> None:
    """Raise ConfigError for a module that does not support so many processes."""
    for name, module in modules.items():
        if not module.supports(ranks.size):
            raise ConfigError(
                f"training.{name} works in one process, and {ranks.size} train together: switch it off "
                f"(training.{name}.{module.off}), or start gsx without torchrun"
            )


def prepare_process(device: torch.device, training: bool) -> None:
    """Set up memory, threads, convolutions and compiling for the whole process."""
    watch_cores()
    if training and device.type == "cpu":
        keep_freed_memory()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)  # of an earlier run in this process
        convolve_exactly()
    keep_compiled_code()


def convolve_exactly() -> None:
    """Make convolutions on a GPU deterministic and of full float32 (torch allows 10 bits)."""
    torch.backends.cudnn.conv.fp32_precision = "ieee"  # type: ignore[attr-defined]
    torch.backends.cudnn.deterministic = True


def keep_compiled_code() -> None:
    """Keep what torch compiles in the cache, by kind of processor: torch's own place is lost on restart.

    Compiling is also hastened, by variables that torch reads when it first compiles.

    Raises:
        InputError: there is no cache, for want of a home folder.
    """
    # torch would compile and load programs to find the vector registers: the system reports them
    os.environ.setdefault("TORCHINDUCTOR_VEC_ISA_OK", "1")
    # caching sizes and formats of each operation costs more than computing them again where sizes are symbols
    os.environ.setdefault("TORCH_FAKE_TENSOR_DISPATCH_CACHE", "0")
    folder = cache_folder("compiled", content_key(torch.__version__, platform.python_version(), processor_kind()))
    try:
        (make_folder(folder) / MANIFEST).touch()
    except (InputError, OSError) as error:
        logger.info("compiled code is not kept in the cache: %s", error)
    else:
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder))


def build(
    settings: Settings,
    scene: Scene,
    folder: Path,
    training: bool = False,
    start: Gaussians | None = None,
    begins: bool = True,
) -> Run:
    """Build a run in memory at step 0.

    training: with augmenters, and with the rasterizer path that suits training. start: content of the splat file of
    `init`. begins: the model starts from the scene or a file; otherwise a checkpoint will replace it.

    Raises:
        ConfigError: the backbone cannot start from a file.
    """
    general, ranks = settings.general, current_ranks()
    device = placed(choose_device(general.device))
    if training:
        refuse_uneven(settings.training.batch, ranks)
    prepare_process(device, training)
    torch.manual_seed(general.seed)
    generator = torch.Generator().manual_seed(general.seed)
    raster = decide(settings.raster, general.iterations, device) if training else settings.raster
    views = TrainingViews(scene=scene, modules=build_modules(settings, scene, device))
    if training:
        refuse_shared(views.modules, ranks)

    chosen = settings.backbone
    facts: dict[str, Any] = {"scene": scene, "iterations": general.iterations, "device": device}
    context = BackboneContext(**facts, raster=raster, generator=generator, views=views, ranks=ranks, begins=begins)

    def new_backbone(**changes: Any) -> Backbone:
        return chosen.component.factory(chosen.options, replace(context, **changes))

    if splat_file(general.init):
        stand_in = in_front_of(scene.train[0].camera)
        backbone = new_backbone(scene=replace(scene, points=one_point(stand_in)), begins=False)
        start_from(backbone, start or stand_in, chosen.component.name)
    else:
        backbone = new_backbone()
    return Run(
        config=settings.resolved,
        folder=folder,
        backbone=backbone,
        raster=backbone.raster,
        training=settings.training,
        views=views,
        iterations=general.iterations,
        photos=PhotoCache(device, room_for_photos(device) if training else 0),
        generator=generator,
        sampler=Sampler(len(scene.train), general.seed, batch=settings.training.batch),
        augmenters=build_augmenters(settings, scene, new_backbone) if training else {},
        ranks=ranks,
    )


def build_modules(settings: Settings, scene: Scene, device: torch.device) -> Modules:
    """Build the training modules of a run, in the order of their registration."""
    facts: dict[str, Any] = {"scene": scene, "device": device, "batch": settings.training.batch}
    return {
        name: chosen.component.factory(
            chosen.options, ModuleContext(name=name, iterations=settings.general.iterations, **facts)
        )
        for name, chosen in settings.modules.items()
    }


def build_augmenters(settings: Settings, scene: Scene, new_backbone: NewBackbone) -> dict[str, Augmenter]:
    """Build the augmenters of a run, in order; they share regenerators by role."""

    @cache
    def regenerator(role: str) -> Regenerator:
        if role not in settings.regenerators:
            raise ConfigError(f"no regenerator is chosen for '{role}': add regenerator/{role}=NAME")
        chosen = settings.regenerators[role]
        return chosen.component.factory(chosen.options)

    augmenters: dict[str, Augmenter] = {}
    for name, chosen in settings.augmenters.items():
        context = AugmenterContext(
            name=name,
            scene=scene,
            iterations=settings.general.iterations,
            seed=settings.general.seed,
            regenerator=regenerator,
            checks=settings.checks,
            held_out=lambda run, share, seed: held_out_renders(run, new_backbone, share, seed),
        )
        augmenters[name] = chosen.component.factory(chosen.options, context)
    shares = {name: augmenter.share() for name, augmenter in augmenters.items() if isinstance(augmenter, Replacing)}
    if sum(shares.values()) >= 1:
        listed = ", ".join(f"{name} {share:g}" for name, share in shares.items())
        raise ConfigError(f"augmenters replace the whole loss of the photos ({listed}): lower their weights")
    return augmenters


def plan_of(run: Run) -> dict[str, Any]:
    """Return the rescaled schedules of backbone, modules and augmenters by name."""
    plan = run.backbone.plan() if isinstance(run.backbone, Planned) else {}
    if not all(isinstance(part, Mapping) for part in plan.values()):
        plan = {run.config["backbone"]["name"]: plan}
    for module in run.modules.values():
        plan |= module.plan(run)
    return plan | {name: augmenter.plan() for name, augmenter in run.augmenters.items()}
