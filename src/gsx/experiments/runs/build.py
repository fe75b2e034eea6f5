"""From settings to a run in memory: device, backbone, augmenters."""

import os
from pathlib import Path
from typing import Any

import torch

from gsx.core.cache import cache_root
from gsx.core.data.scene import Scene
from gsx.core.errors import ConfigError
from gsx.core.rasterizer.prepare import decide
from gsx.core.training.augmenter import Augmenter, AugmenterContext, Replacing
from gsx.core.training.backbone import Backbone, BackboneContext, Planned
from gsx.core.training.distributed import placed, ranks_here, refuse_uneven
from gsx.core.training.regenerator import Regenerator
from gsx.core.training.run import Run, Sampler
from gsx.experiments.runs.settings import Settings


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
    replacing = [(name, a) for name, a in zip(settings.augmenters, out, strict=True) if isinstance(a, Replacing)]
    shares = {name: augmenter.share() for name, augmenter in replacing}
    if sum(shares.values()) >= 1:
        listed = ", ".join(f"{name} {share:g}" for name, share in shares.items())
        raise ConfigError(f"augmenters take the whole loss of the photographs ({listed}): lower their weights")
    return out


def plan_of(run: Run) -> dict[str, Any]:
    """The rescaled schedules of the backbone and of the augmenters."""
    names = run.config.get("augmenter") or {}
    own = run.backbone.plan() if isinstance(run.backbone, Planned) else {}
    return own | {name: a.plan() for name, a in zip(names, run.augmenters, strict=True)}
