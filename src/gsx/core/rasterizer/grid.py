"""Tiles of a raster, aligned to the camera's frame, so that a crop has the same tiles as the whole."""

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.shapes import Float, Int


@dataclass(frozen=True, kw_only=True)
class TileGrid:
    """Whole tiles that cover a raster at (left, top) of its frame, px."""

    left: int
    top: int
    width: int
    height: int
    tile: int

    @staticmethod
    def of(camera: Camera, tile: int) -> "TileGrid":
        """Returns the grid of a camera's raster."""
        frame = camera.frame
        return TileGrid(left=frame.left, top=frame.top, width=camera.width, height=camera.height, tile=tile)

    @property
    def first(self) -> tuple[int, int]:
        """Column and row of the first tile on the frame."""
        return self.left // self.tile, self.top // self.tile

    @property
    def shape(self) -> tuple[int, int]:
        """Number of columns and rows."""
        past_x, past_y = -(-(self.left + self.width) // self.tile), -(-(self.top + self.height) // self.tile)
        return past_x - self.first[0], past_y - self.first[1]

    def centres(self, tiles: Int[Tensor, "P"], like: Tensor) -> Float[Tensor, "P 2"]:
        """Returns the centres of tiles on the frame, px, in the dtype of `like`."""
        columns = self.shape[0]
        position = torch.stack([tiles % columns + self.first[0], tiles // columns + self.first[1]], 1)
        return position.to(like) * self.tile + self.tile / 2

    def to_raster(self, tiles: Float[Tensor, "T P C"]) -> Float[Tensor, "C H W"]:
        """Assembles tiles to a picture, cut to the raster."""
        columns, rows = self.shape
        blocks = tiles.view(rows, columns, self.tile, self.tile, -1).permute(4, 0, 2, 1, 3)
        picture = blocks.reshape(-1, rows * self.tile, columns * self.tile)
        x, y = self.left - self.first[0] * self.tile, self.top - self.first[1] * self.tile
        return picture[:, y : y + self.height, x : x + self.width]

    def to_tiles(self, raster: Float[Tensor, "C H W"]) -> Float[Tensor, "T C P"]:
        """Cuts a picture into tiles; pixels outside the raster are 0."""
        columns, rows = self.shape
        x, y = self.left - self.first[0] * self.tile, self.top - self.first[1] * self.tile
        padding = (x, columns * self.tile - x - self.width, y, rows * self.tile - y - self.height)
        padded = torch.nn.functional.pad(raster, padding)
        blocks = padded.view(len(raster), rows, self.tile, columns, self.tile).permute(1, 3, 0, 2, 4)
        return blocks.reshape(rows * columns, len(raster), self.tile**2)


def pixel_centres(tile: int, like: Tensor) -> Float[Tensor, "3 P"]:
    """Returns (x, y, 1) at the pixel centres of a tile, px from its centre, like `like`."""
    offset = torch.arange(tile, device=like.device, dtype=like.dtype) + 0.5 - tile / 2
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    return torch.stack([x.reshape(-1), y.reshape(-1), torch.ones_like(x).reshape(-1)])


@dataclass(frozen=True, eq=False, kw_only=True)
class Basis:
    """Pixel centres of a tile, px from its centre, and their products."""

    x: Float[Tensor, "P 1"]
    y: Float[Tensor, "P 1"]
    products: Float[Tensor, "3 P 1"]
    """x^2, x y, y^2."""


@functools.lru_cache
def basis_of(tile: int, dtype: torch.dtype, device: torch.device) -> Basis:
    """Returns the basis of a tile size."""
    x, y = pixel_centres(tile, torch.empty(0, dtype=dtype, device=device))[:2, :, None].unbind(0)
    return Basis(x=x.contiguous(), y=y.contiguous(), products=torch.stack([x * x, x * y, y * y]))


@functools.lru_cache(maxsize=2)
def inside_of(grid: TileGrid, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "T 1 P"]:
    """Returns 1 at pixels of the raster, 0 outside; the cache is small, since each is as large as a picture."""
    return grid.to_tiles(torch.ones(1, grid.height, grid.width, dtype=dtype, device=device))
