"""Several cameras at once: one rendering each, gradients add up."""

from collections.abc import Sequence

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer.render import Rendering, rasterize
from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Float


def rasterize_batch(
    splats: Splats,
    cameras: Sequence[Camera],
    settings: RasterSettings,
    *,
    background: Float[Tensor, "C"] | Float[Tensor, "B C"] | None = None,
    intrinsics: Float[Tensor, "B 4"] | None = None,
    depth: bool = False,
    absolute_gradient: bool = False,
    max_weight: bool = False,
) -> list[Rendering]:
    """Render the same splats from B cameras, whose rasters may differ in size; see `rasterize`.

    The background is one colour or one per camera. Every rendering has its own screen statistics.

    Raises:
        InputError: backgrounds or intrinsics are not one per camera, or `rasterize` refuses; it names the camera.
    """
    count = len(cameras)
    if background is not None and background.dim() == 2 and len(background) != count:
        raise InputError(f"{len(background)} backgrounds for {count} cameras: give one colour, or one per camera")
    if intrinsics is not None and len(intrinsics) != count:
        raise InputError(f"{len(intrinsics)} rows of intrinsics for {count} cameras: give one per camera")
    renderings = []
    for index, camera in enumerate(cameras):
        try:
            rendering = rasterize(
                splats,
                camera,
                settings,
                background=background[index] if background is not None and background.dim() == 2 else background,
                intrinsics=None if intrinsics is None else intrinsics[index],
                depth=depth,
                absolute_gradient=absolute_gradient,
                max_weight=max_weight,
            )
        except InputError as error:
            raise InputError(f"camera {index} of {count}: {error}") from error
        renderings.append(rendering)
    return renderings
