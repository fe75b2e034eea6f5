"""Training views at each step: scale, corrected pose and mask; corrections of renders to match their photos."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.shapes import Float
from gsx.core.training.finer_raster import FinerRaster, finer_raster, render_scale
from gsx.core.training.module import Modules, TrainingModule


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingViews:
    """Training views of a scene, changed by the modules of a run."""

    scene: Scene
    modules: Modules = field(default_factory=dict)

    def without(self, module: TrainingModule) -> "TrainingViews":
        """Returns the views without the changes of one module."""
        others = {name: other for name, other in self.modules.items() if other is not module}
        return replace(self, modules=others)

    @property
    def full_size(self) -> Sequence[View]:
        """Training views at the photos' own resolution, with corrected poses and masks."""
        return self.at(None)

    def at(self, step: int | None) -> Sequence[View]:
        """Returns the training views of a step; None: `full_size`."""
        views: Sequence[View] = self.scene.train
        for module in self.modules.values():
            views = module.transform_views(views, step)
        return views

    def match_photo(
        self,
        image: Float[Tensor, "3 H W"],
        photo: Float[Tensor, "3 H W"] | None,
        view: View,
        window: Window | None = None,
        *,
        learning: bool = False,
    ) -> Float[Tensor, "3 H W"]:
        """Applies the modules' corrections to a render, so that it can be compared with the photo.

        For the arguments see `TrainingModule.transform_render`.
        """
        for module in reversed([*self.modules.values()]):
            image = module.transform_render(image, view, photo, window, learning)
        return image

    def raster_scale(self, step: int) -> int:
        """Returns the factor by which renders of a step are finer than the photos."""
        return math.prod(module.raster_scale(step) for module in self.modules.values())

    def raster_for(self, step: int) -> Callable[[Camera], FinerRaster]:
        """Returns a function from a camera to its raster at a step."""
        scene, scale = self.scene, self.raster_scale(step)
        return lambda camera: finer_raster(camera, scene.reduction, render_scale(camera, scene.train, scale))

    def raster_cameras(self, step: int) -> list[Camera]:
        """Returns the cameras of the training renders of a step."""
        scale = self.raster_scale(step)
        return [view.camera.zoom(scale) for view in self.at(step)]

    def changes_after(self, step: int) -> bool:
        """Returns whether the next step renders other cameras."""
        finer = self.raster_scale(step) != self.raster_scale(step + 1)
        return step > 0 and (finer or self.at(step) is not self.at(step + 1))
