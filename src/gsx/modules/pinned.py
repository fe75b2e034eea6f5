"""Photographs that stay as they were taken when the pose of their view is said to be another."""

from dataclasses import dataclass, replace

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import FromFile, ImageSource, Masked, View
from gsx.core.shapes import Bool, UInt8


@dataclass(frozen=True, eq=False, kw_only=True)
class Taken:
    """A source that is asked for what was seen from one pose, whatever a view says."""

    source: ImageSource
    taken: Camera
    """Its pose is that of the photograph."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """What was photographed."""
        return self.source.image(camera.with_pose_of(self.taken))

    def max_zoom(self, camera: Camera) -> float:
        """That of the source."""
        return self.source.max_zoom(camera.with_pose_of(self.taken))

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """That of the source."""
        return self.source.counted(camera.with_pose_of(self.taken)) if isinstance(self.source, Masked) else None


def as_taken(view: View) -> ImageSource:
    """The source of a view, for views of other poses: a file does not know its pose, and what is computed does."""
    fixed = isinstance(view.source, FromFile | Taken)
    return view.source if fixed else Taken(source=view.source, taken=view.camera)


def posed(view: View, camera: Camera) -> View:
    """The view with the pose of a camera; its photograph stays."""
    return replace(view, camera=view.camera.with_pose_of(camera), source=as_taken(view))
