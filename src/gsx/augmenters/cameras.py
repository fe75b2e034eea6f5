"""Cameras of pseudo views: windows of a raster, zoomed in, and poses moved at random."""

from dataclasses import replace

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.window import Window
from gsx.core.shapes import Float


def window_size(width: int, height: int, narrow: float, scale: int) -> tuple[int, int]:
    """Returns (width, height) of the window that `narrow` times the raster shows at `scale`, px."""
    return max(1, round(width * narrow / scale)), max(1, round(height * narrow / scale))


def centred_window(width: int, height: int, size: tuple[int, int]) -> Window:
    """Returns the window in the middle, rounded to the upper left."""
    return Window(left=(width - size[0]) // 2, top=(height - size[1]) // 2, width=size[0], height=size[1])


def random_window(width: int, height: int, size: tuple[int, int], generator: torch.Generator) -> Window:
    """Draws a window anywhere on the raster, uniformly."""
    left, top = (int(torch.randint(whole - part + 1, (), generator=generator)) for whole, part in
                 ((width, size[0]), (height, size[1])))  # fmt: skip
    return Window(left=left, top=top, width=size[0], height=size[1])


def grid_window(width: int, height: int, size: tuple[int, int], turn: int) -> Window:
    """Returns the `turn`-th of the windows that cover the raster in rows, cyclically."""
    across, down = -(-width // size[0]), -(-height // size[1])
    row, column = divmod(turn % (across * down), across)
    left = round(column * (width - size[0]) / max(1, across - 1))
    top = round(row * (height - size[1]) / max(1, down - 1))
    return Window(left=left, top=top, width=size[0], height=size[1])


def worst_window(error: Float[Tensor, "H W"], size: tuple[int, int]) -> Window:
    """Returns the window with the largest mean error."""
    sums = torch.nn.functional.pad(error.double(), (1, 0, 1, 0)).cumsum(0).cumsum(1)
    width, height = size
    windows = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    top, left = divmod(int(windows.argmax()), windows.shape[1])
    return Window(left=left, top=top, width=size[0], height=size[1])


def polar(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Returns the rotation nearest to a matrix: U diag(1, 1, det U V^T) V^T of its SVD."""
    left, _, right = torch.linalg.svd(matrix)
    signs = torch.tensor([1.0, 1.0, float(torch.linalg.det(left @ right))], dtype=matrix.dtype)
    return left @ torch.diag(signs) @ right


def noise(shape: tuple[int, ...], kind: str, scale: float, generator: torch.Generator) -> Float[Tensor, "*shape"]:
    """Draws float64 numbers, uniform in [-scale, scale] or normal with standard deviation `scale`."""
    if kind == "normal":
        return scale * torch.randn(shape, generator=generator, dtype=torch.float64)
    return scale * (2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1)


def moved(camera: Camera, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"], kept: str = "t") -> Camera:
    """Adds noise to a pose: R' = polar(R + e_R), t' = t + e_t (the paper, Implementation details).

    `kept` = t: the rotation moves the centre around the world's origin; center: the centre moves by e_t only.
    """
    turned = polar(camera.rotation.double() + rotation)
    held = camera.translation.double() if kept == "t" else -turned @ camera.centre.double()
    return replace(
        camera,
        rotation=turned.to(camera.rotation),
        translation=(held + translation).to(camera.translation),
    )
