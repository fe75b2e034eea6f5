"""How training views are seen and rendered at each step: coarsely at first, then as they are, at last more finely; by
which poses, without which parts, and what their photographs would show of a render.

What a view shows at a fraction of its size is learnt in a fraction of the time (DashGaussian, Chen et al. 2025).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.coarser import coarser
from gsx.core.data.scene import Scene, View
from gsx.core.data.window import Window
from gsx.core.shapes import Float
from gsx.core.training.finer_raster import FinerRaster, raster_at
from gsx.modules.bilateral_grid import WHOLE
from gsx.modules.blur import Blur
from gsx.modules.distractors import Distractors
from gsx.modules.exposure import Exposures, saturated
from gsx.modules.poses import Poses


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingViews:
    """Of the training views of a scene, step by step."""

    scene: Scene
    coarse: int = 1
    """The first pictures are so many times as coarse: a power of two, halved in equal times."""
    coarse_until: int = 0
    """Last step that sees pictures which are coarser than the photographs."""
    supersample: int = 1
    """Renders are so many times as fine as photographs, and reduced as these were (`core.training.finer_raster`)."""
    finer_after: int = 0
    """Last step before that."""
    coarse_views: dict[int, Sequence[View]] = field(default_factory=dict)
    """Those that were asked for, by how many times as coarse they are."""
    poses: Poses = field(default_factory=Poses)
    """Where photographs were taken: where their views say, unless that is corrected."""
    distractors: Distractors = field(default_factory=Distractors)
    """Parts of photographs that do not count: none unless they are found."""
    exposures: Exposures = field(default_factory=Exposures)
    """Of the photographs: all alike unless they are found to differ."""
    blur: Blur = field(default_factory=Blur)
    """Movements of their cameras: none unless they are found."""

    def coarse_at(self, step: int) -> int:
        """How many times as coarse as the photographs the pictures of a step are."""
        if step > self.coarse_until or self.coarse == 1:
            return 1
        halvings = math.log2(self.coarse) * (max(1, step) - 1) / self.coarse_until
        return self.coarse >> math.floor(halvings)

    def supersample_at(self, step: int) -> int:
        """How many times as fine as photographs they are rendered at a step."""
        return self.supersample if step > self.finer_after else 1

    @property
    def full_size(self) -> Sequence[View]:
        """Training views at the photos' own resolution, with corrected poses and masks."""
        return self.distractors.views(self.poses.views(self.scene.train))

    def at(self, step: int) -> Sequence[View]:
        """The training views, as a step sees them, by the poses of the moment, without distractors."""
        times = self.coarse_at(step)
        if times == 1:
            return self.distractors.views(self.poses.views(self.scene.train))
        if times not in self.coarse_views:
            self.coarse_views[times] = [coarser(view, self.scene.reduction, times) for view in self.scene.train]
        return self.distractors.views(self.poses.views(self.coarse_views[times]))

    def as_photographed(
        self, image: Float[Tensor, "3 H W"], view: View, window: Window | None = None, *, learning: bool = False
    ) -> Float[Tensor, "3 H W"]:
        """A render of a training view, or of a window of it, as its photograph shows it: by a camera that moved, at its
        exposure. learning: the view is one of the step under way."""
        edges = WHOLE if window is None else window.shares(*view.camera.size)
        return self.exposures.applied(self.blur.applied(image, view), view.name, learning, edges)

    def match_photo(
        self,
        image: Float[Tensor, "3 H W"],
        photograph: Float[Tensor, "3 H W"],
        view: View,
        window: Window | None = None,
        *,
        learning: bool = False,
    ) -> Float[Tensor, "3 H W"]:
        """A render as its photograph would show it; where that is saturated, more is no error."""
        return saturated(self.as_photographed(image, view, window, learning=learning), photograph, self.exposures)

    def rendered_cameras(self, step: int) -> list[Camera]:
        """Those that a step renders training views by."""
        times = self.supersample_at(step)
        return [view.camera.zoom(times) for view in self.at(step)]

    def raster_for(self, step: int) -> Callable[[Camera], FinerRaster]:
        """How pictures come about at a step."""
        supersample = self.supersample_at(step)
        return lambda camera: raster_at(camera, self.scene, supersample)

    def changes_after(self, step: int) -> bool:
        """Whether the next step renders at another resolution."""
        finer = self.supersample_at(step) != self.supersample_at(step + 1)
        return step > 0 and (finer or self.coarse_at(step) != self.coarse_at(step + 1))
