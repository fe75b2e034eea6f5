"""Regenerators without anything to learn: Lanczos enlargement, identity, and the truth itself as an upper bound."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.images import resize, to_uint8
from gsx.core.regenerator import Material, Request
from gsx.core.shapes import Float


@dataclass(frozen=True, kw_only=True)
class PlainOptions:
    """Nothing to choose."""

    name: str


class Resampled:
    """Enlarges by Lanczos' filter with three lobes."""

    def __init__(self, options: PlainOptions) -> None:
        self.options = options

    def prepare(self, material: Material) -> dict[str, float]:
        """Nothing to learn."""
        return {}

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """Each picture, `scale` times as large."""
        return [enlarged(request) for request in requests]


def enlarged(request: Request) -> Float[Tensor, "3 H W"]:
    """By Lanczos, through 8 bits."""
    height, width = (side * request.scale for side in request.image.shape[1:])
    return resize(to_uint8(request.image), width, height, "lanczos").float() / 255


class Unchanged:
    """Gives back what it is given: the control of a restorer."""

    def __init__(self, options: PlainOptions) -> None:
        self.options = options

    def prepare(self, material: Material) -> dict[str, float]:
        """Nothing to learn."""
        return {}

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 h w"]]:
        """Each picture as it is.

        Raises:
            InputError: a picture is to be enlarged.
        """
        for request in requests:
            if request.scale != 1:
                raise InputError(
                    f"regenerator identity cannot enlarge x{request.scale}: choose another regenerator/upscale"
                )
        return [request.image for request in requests]


class Oracle:
    """The true pixels: the ceiling of any regenerator, and a test of alignment. No result of it is a result."""

    def __init__(self, options: PlainOptions) -> None:
        self.options = options

    def prepare(self, material: Material) -> dict[str, float]:
        """Nothing to learn."""
        return {}

    def regenerate(self, requests: Sequence[Request]) -> list[Float[Tensor, "3 H W"]]:
        """What the scene truly shows.

        Raises:
            InputError: the photographs hold no such pixels.
        """
        return [truth(request) for request in requests]


def truth(request: Request) -> Float[Tensor, "3 H W"]:
    """The truth that the camera of a request sees at `scale` times the density."""
    view, scale = request.view, request.scale
    if scale > view.source.max_zoom(view.camera):
        raise InputError(
            f"regenerator oracle: photographs of '{view.name}' are not {scale} times finer than the training images; "
            f"train at scene.downscale={scale} or more"
        )
    height, width = (side * scale for side in request.image.shape[1:])
    try:
        return view.source.image(request.camera.resize(width, height)).float() / 255
    except ValueError as error:
        raise InputError(
            f"regenerator oracle knows no truth beside the photograph of '{view.name}' ({error}): "
            "set augmenter.NAME.variants=0"
        ) from error
