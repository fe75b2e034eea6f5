"""Training views at each step: scale, corrected pose and mask, and how their photos would show a render."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.shapes import Float
from gsx.core.training.finer_raster import FinerRaster, raster_at
from gsx.core.training.module import Modules, TrainingModule


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingViews:
    """Training views of a scene, as the modules of a run change them."""

    scene: Scene
    modules: Modules = field(default_factory=dict)

    def without(self, module: TrainingModule) -> "TrainingViews":
        """Returns the views as all other modules change them."""
        others = {name: other for name, other in self.modules.items() if other is not module}
        return replace(self, modules=others)

    @property
    def full_size(self) -> Sequence[View]:
        """Training views at the photos' own resolution, with corrected poses and masks."""
        return self._transformed(None)

    def at(self, step: int) -> Sequence[View]:
        """Returns the training views as a step sees them."""
        return self._transformed(step)

    def _transformed(self, step: int | None) -> Sequence[View]:
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
        """Returns a render of a training view, or of a window of it, as its photo would show it.

        photo: what it is to be compared with; None: it is to be looked at. learning: a step is under way.
        """
        for module in reversed([*self.modules.values()]):
            image = module.transform_render(image, view, photo, window, learning)
        return image

    def raster_scale(self, step: int) -> int:
        """Returns how many times as fine as photos the renders of a step are."""
        return math.prod(module.raster_scale(step) for module in self.modules.values())

    def raster_for(self, step: int) -> Callable[[Camera], FinerRaster]:
        """Returns the raster of a camera, by the rules of a step."""
        scale = self.raster_scale(step)
        return lambda camera: raster_at(camera, self.scene, scale)

    def raster_cameras(self, step: int) -> list[Camera]:
        """Returns the cameras by which a step renders training views."""
        scale = self.raster_scale(step)
        return [view.camera.zoom(scale) for view in self.at(step)]

    def changes_after(self, step: int) -> bool:
        """Returns whether the step after this one renders other cameras."""
        finer = self.raster_scale(step) != self.raster_scale(step + 1)
        return step > 0 and (finer or self.at(step) is not self.at(step + 1))
