"""Scenes as loaders return them: views with images at several resolutions, points, extent, background."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, centres_of
from gsx.core.data.reduction import Reduction
from gsx.core.errors import InputError
from gsx.core.shapes import Bool, Float, UInt8


@runtime_checkable
class ImageSource(Protocol):
    """Source of a view's images: a photo, with its file `path`, or an analytic scene."""

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Returns the image for a camera: the view's camera at any zoom up to `max_zoom`, or a crop of it."""

    def max_zoom(self, camera: Camera) -> float:
        """Returns the largest zoom of a camera with an image (1: none finer; inf: any)."""


@runtime_checkable
class Masked(Protocol):
    """A source with masked pixels."""

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Marks the unmasked pixels of `image(camera)`; None: all."""


@runtime_checkable
class CutOut(Protocol):
    """A source with alpha, transparent where only background is visible."""

    def transparent(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Marks the pixels of `image(camera)` that show only background; None: unknown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DerivedSource:
    """Image, file and mask of another source; subclasses change some of them."""

    source: ImageSource

    @property
    def path(self) -> Path | None:
        """File of the other source, if any."""
        return file_of(self.source)

    def image(self, camera: Camera) -> UInt8[Tensor, "3 H W"]:
        """Returns the other source's image."""
        return self.source.image(camera)

    def max_zoom(self, camera: Camera) -> float:
        """Returns the other source's largest zoom."""
        return self.source.max_zoom(camera)

    def counted(self, camera: Camera) -> Bool[Tensor, "H W"] | None:
        """Marks the other source's unmasked pixels; None: all."""
        return self.source.counted(camera) if isinstance(self.source, Masked) else None


def file_of(source: ImageSource) -> Path | None:
    """Returns the file of a source; None: its images are computed."""
    path = getattr(source, "path", None)
    return None if path is None else Path(path)


@dataclass(frozen=True, eq=False, kw_only=True)
class Depths:
    """Measured depths at places of a view."""

    pixels: Float[Tensor, "K 2"]
    """Places, px of the view's camera."""
    z: Float[Tensor, "K"]
    """Camera z, scene units."""
    weights: Float[Tensor, "K"]


@dataclass(frozen=True, eq=False)
class View:
    """Camera with its image; images are decoded on demand, as uint8."""

    name: str
    camera: Camera
    source: ImageSource
    group: str = ""
    """Group in reports, such as a BungeeNeRF scale; empty: none."""
    sparse: Depths | None = None
    """Depths of the points of structure from motion that it observes; None: unknown."""
    depth_map: Callable[[], Float[Tensor, "H W"] | None] | None = None
    """Reads camera z at its pixels, scene units, 0 where unknown, or None: unusable; None: there is no map."""

    @property
    def file(self) -> Path | None:
        """File of the photo; None: the image is computed."""
        return file_of(self.source)

    def image(self) -> Float[Tensor, "3 H W"]:
        """Returns the image at the camera's resolution, display values in [0, 1]."""
        return self.picture().float() / 255.0

    def picture(self) -> UInt8[Tensor, "3 H W"]:
        """Returns the 8-bit image at the camera's resolution; InputError: its dtype or shape is another."""
        image, (width, height) = self.source.image(self.camera), self.camera.size
        if image.dtype != torch.uint8 or image.shape != (3, height, width):
            raise InputError(
                f"the picture of view '{self.name}' is {image.dtype} {list(image.shape)}, but its camera needs "
                f"torch.uint8 {[3, height, width]}: correct its source"
            )
        return image

    def counted(self) -> Bool[Tensor, "H W"] | None:
        """Marks the pixels that count in losses and metrics; None: all."""
        return self.source.counted(self.camera) if isinstance(self.source, Masked) else None

    def transparent(self) -> Bool[Tensor, "H W"] | None:
        """Marks the pixels that show only background, by the image's alpha; None: unknown."""
        return self.source.transparent(self.camera) if isinstance(self.source, CutOut) else None

    def zoom(self, factor: float) -> "View | None":
        """Returns the view at `factor` times its resolution; None: there is no such image."""
        if factor > self.source.max_zoom(self.camera):
            return None
        return replace(self, camera=self.camera.zoom(factor), sparse=None, depth_map=None)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Initial points of a backbone."""

    positions: Float[Tensor, "P 3"]
    """World coordinates, float32; from loaders float64 if far from the origin (`gsx.scenes.origin`)."""
    colours: UInt8[Tensor, "P 3"]
    """Display RGB."""

    def __len__(self) -> int:
        return len(self.positions)

    def joined(self, positions: Float[Tensor, "Q 3"], colours: UInt8[Tensor, "Q 3"]) -> "PointCloud":
        """Returns the cloud with more points after its own."""
        positions = torch.cat([self.positions, positions.to(self.positions)])
        return PointCloud(positions, torch.cat([self.colours, colours]))


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """Scene for training: views, points, background."""

    name: str
    train: Sequence[View]
    test: Sequence[View]
    points: PointCloud
    background: Float[Tensor, "3"]
    """Display RGB behind the scene, in [0, 1]."""
    extent: float
    """1.1 x largest distance of a training camera from their mean, scene units (3D-GS, getNerfppNorm)."""
    reduction: Reduction = Reduction()
    """Filter from finer images to the training images; the default is a box average."""
    notes: Sequence[str] = ()
    """Remarks on loading for the log: skipped images, undistortion, fallbacks."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset subtracted from all positions; add it for coordinates of the scene's files."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Format, folder, resize and split rule for the evaluation protocol. JSON-serialisable."""


def extent_of(cameras: Sequence[Camera]) -> float:
    """Returns 1.1 x the largest distance of a camera centre from their mean (3D-GS, getNerfppNorm)."""
    centres = centres_of(cameras)
    return 1.1 * float((centres - centres.mean(0)).norm(dim=1).max())
