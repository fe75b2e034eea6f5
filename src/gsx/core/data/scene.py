"""What every loader returns: views with truth at any resolution the data allow, points, extent, background."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.reduction import Reduction
from gsx.core.errors import InputError
from gsx.core.shapes import Bool, Float, UInt8


@runtime_checkable
class ImageSource(Protocol):
    """Where the truth of one view comes from: a photograph, whose file `path` names, or an analytic scene."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return the truth as `camera` sees it: the view's camera at any zoom, or a crop of that."""
        ...

    def max_zoom(self, camera: Camera) -> float:
        """Return the largest zoom of `camera` for which there is truth (1.0: only as it is; inf: any)."""
        ...


@runtime_checkable
class Masked(Protocol):
    """A source of which some pixels may not count."""

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Return which pixels of `image(camera)` count; None: all."""
        ...


@runtime_checkable
class CutOut(Protocol):
    """A source of pictures that may be transparent where they show nothing of the scene."""

    def transparent(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Return which pixels of `image(camera)` show the background alone; None: unknown."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class DerivedSource:
    """The picture, file and mask of another source; subclasses change some of them."""

    source: ImageSource

    @property
    def path(self) -> Path | None:
        """The file that the other source reads, if any."""
        return file_of(self.source)

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Return the other source's picture."""
        return self.source.image(camera)

    def max_zoom(self, camera: Camera) -> float:
        """Return the other source's largest zoom."""
        return self.source.max_zoom(camera)

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Return which pixels of the other source count; None: all."""
        return self.source.counted(camera) if isinstance(self.source, Masked) else None


def file_of(source: ImageSource) -> Path | None:
    """Return the file that a source reads, its `path`; None: it computes its pictures."""
    path = getattr(source, "path", None)
    return None if path is None else Path(path)


@dataclass(frozen=True, eq=False)
class View:
    """A camera and the image it took. Images are decoded when asked for and kept as uint8."""

    name: str
    camera: Camera
    source: ImageSource
    group: str = ""
    """Name of the group the view is reported under, for example a BungeeNeRF scale; empty: none."""

    @property
    def file(self) -> Path | None:
        """The photograph's file; None: the picture is computed."""
        return file_of(self.source)

    def image(self) -> Float[Tensor, "3 H W"]:
        """Return the truth at the camera's resolution, display values in [0, 1]."""
        return self.picture().float() / 255.0

    def picture(self) -> UInt8[Tensor, "3 H W"]:
        """Return the truth at the camera's resolution, 8 bits; InputError: the source gives another kind of picture."""
        image, (width, height) = self.source.image(self.camera), self.camera.size
        if image.dtype != torch.uint8 or image.shape != (3, height, width):
            raise InputError(
                f"the picture of view '{self.name}' is {image.dtype} {list(image.shape)}, and its camera takes "
                f"torch.uint8 {[3, height, width]}: its source is to return that"
            )
        return image

    def counted(self) -> Bool[Tensor, "H W"] | None:
        """Return which pixels count in losses and figures, being part of the scene; None: all."""
        return self.source.counted(self.camera) if isinstance(self.source, Masked) else None

    def transparent(self) -> Bool[Tensor, "H W"] | None:
        """Return which pixels show nothing of the scene, by the picture's alpha; None: unknown."""
        return self.source.transparent(self.camera) if isinstance(self.source, CutOut) else None

    def zoom(self, factor: float) -> "View | None":
        """Return the view sampled `factor` times as finely, or None where the data hold no such truth."""
        if factor > self.source.max_zoom(self.camera):
            return None
        return replace(self, camera=self.camera.zoom(factor))


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points that initialise a backbone."""

    positions: Float[Tensor, "P 3"]
    """World coordinates, float32; of loaders, float64 where they lie far from (0, 0, 0) (`gsx.scenes.origin`)."""
    colours: UInt8[Tensor, "P 3"]
    """Display RGB."""

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A scene ready for training."""

    name: str
    train: Sequence[View]
    test: Sequence[View]
    points: PointCloud
    background: Float[Tensor, "3"]
    """Display colour behind the scene, in [0, 1]."""
    extent: float
    """1.1 x the largest distance of a training camera from their mean (3D-GS, getNerfppNorm)."""
    reduction: Reduction = Reduction()
    """How its pictures come from finer ones: photographs by their resize rule. The default: box averages."""
    notes: Sequence[str] = ()
    """What a user should know of how it was loaded: skipped images, undistortion, fallbacks. Logged at start."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Subtracted from positions of cameras and points; add it for coordinates of the scene's files."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Format, folder, resize rule, split rule: goes into the evaluation protocol. JSON-serialisable."""


def extent_of(cameras: Sequence[Camera]) -> float:
    """Return 1.1 x the largest distance of a camera centre from the mean centre (3D-GS, getNerfppNorm)."""
    centres = torch.stack([camera.centre.double() for camera in cameras])
    return 1.1 * float((centres - centres.mean(0)).norm(dim=1).max())
