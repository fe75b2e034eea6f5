"""Photographs that stay as they were taken when the pose of their view is said to be another."""

from dataclasses import dataclass, replace

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import DerivedSource, ImageSource, View
from gsx.core.shapes import Bool, UInt8


@dataclass(frozen=True, eq=False, kw_only=True)
class Taken(DerivedSource):
    """A source that is asked for what was seen from one pose, whatever a view says."""

    taken: Camera
    """Its pose is that of the photograph."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return what was photographed."""
        return super().image(camera.with_pose_of(self.taken))

    def max_zoom(self, camera: Camera) -> float:
        """Return the source's largest zoom from there."""
        return super().max_zoom(camera.with_pose_of(self.taken))

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Return which pixels of the photograph count."""
        return super().counted(camera.with_pose_of(self.taken))


def as_taken(view: View) -> ImageSource:
    """Return the source for views of other poses: a file does not know its pose, and what is computed does."""
    fixed = view.file is not None or isinstance(view.source, Taken)
    return view.source if fixed else Taken(source=view.source, taken=view.camera)


def posed(view: View, camera: Camera) -> View:
    """The view with the pose of a camera; its photograph stays."""
    return replace(view, camera=view.camera.with_pose_of(camera), source=as_taken(view))
