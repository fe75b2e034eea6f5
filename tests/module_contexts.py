"""Training modules on their own: built on a small scene, as a run would build them."""

from typing import Any, TypeVar

import torch
from small_scene import small_scene, spread

from gsx.core.data.scene import Scene
from gsx.core.training.module import ModuleContext, Modules, TrainingModule
from gsx.modules.coarse_to_fine import CoarseToFine, CoarseToFineOptions

Module = TypeVar("Module", bound=TrainingModule)


def build_module(
    factory: type[Module], options: Any, iterations: int = 1000, views: int = 4, scene: Scene | None = None
) -> Module:
    """A module of a run of so many steps on a scene with so many training views."""
    context = ModuleContext(
        name=factory.__name__.lower(),
        scene=scene or small_scene(spread(5), views=views),
        iterations=iterations,
        device=torch.device("cpu"),
    )
    return factory(options, context)


def coarse_modules(scene: Scene, factor: int, last: int) -> Modules:
    """Coarse views up to a step."""
    options = CoarseToFineOptions(factor=factor, until=last / 1000)
    return {"coarse_to_fine": build_module(CoarseToFine, options, scene=scene)}
