"""Rendered pictures as files: their size and peculiarities from the header, their pixels as display values."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.images import header_of, read_image
from gsx.core.errors import InputError
from gsx.core.shapes import Float

JPEGS = (".jpg", ".jpeg")
MOST_ROUNDING = 1e-3
"""Largest excess of floating-point pictures over [0, 1] that is rounding."""


@dataclass(frozen=True, kw_only=True)
class Header:
    """Size of a picture, and what a reader of figures should know of its file."""

    size: tuple[int, int]
    """(width, height), px."""
    remarks: tuple[str, ...]
    """Such as `16 bits, rounded to 8`; the same words for every file of that kind."""


def read_header(path: Path) -> Header:
    """Reads the header of a picture; InputError: it is no picture."""
    if path.suffix.lower() == ".npy":
        return array_header(path)
    spec = header_of(path)
    turned = ["turned by EXIF, which is not applied"] if spec.get_int_attribute("Orientation", 1) != 1 else []
    remarks = (*remarks_on(path, spec.nchannels, str(spec.format)), *turned)
    return Header(size=(spec.width, spec.height), remarks=remarks)


def remarks_on(path: Path, channels: int, kind: str) -> Iterator[str]:
    """Yields what is peculiar about a picture of so many channels and that number type."""
    if channels in (2, 4):
        yield "transparent, laid over the scene's background"
    if channels in (1, 2):
        yield "grey, used as red, green and blue"
    if kind == "uint16":
        yield "16 bits, rounded to 8"
    if path.suffix.lower() == ".exr":
        yield "EXR, converted from linear light to sRGB and rounded to 8 bits"
    if path.suffix.lower() in JPEGS:
        yield "JPEG, whose compression counts as error"


def read_picture(path: Path, background: Float[Tensor, "3"]) -> Float[Tensor, "3 H W"]:
    """Reads a picture as display values in [0, 1], a transparent one over a background.

    Raises:
        InputError: it is damaged, or holds other values.
    """
    pixels = array_pixels(path) if path.suffix.lower() == ".npy" else read_image(path).float() / 255
    if len(pixels) == 3:
        return pixels
    colour, alpha = pixels[:3], pixels[3:]
    return colour * alpha + background[:, None, None] * (1 - alpha)


def array_header(path: Path) -> Header:
    """Reads size and peculiarities of a NumPy array from its header."""
    array = mapped(path)
    height, width, channels = layout_of_array(path, array)
    remarks = [] if array.dtype == np.uint8 else [f"{array.dtype} display values"]
    return Header(size=(width, height), remarks=(*remarks_on(path, channels, ""), *remarks))


def mapped(path: Path) -> np.ndarray:
    """Maps an array from its file; InputError: it holds none."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"'{path}' is no array of numbers ({error}): save it by numpy.save") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "uf":
        raise InputError(f"'{path}' holds {getattr(array, 'dtype', 'objects')}: give uint8, or floats in [0, 1]")
    return array


def layout_of_array(path: Path, array: np.ndarray) -> tuple[int, int, int]:
    """Returns height, width and channels of [H, W], [H, W, C] or [3, H, W]; InputError: another shape."""
    if array.ndim == 2:
        return array.shape[0], array.shape[1], 1
    if array.ndim == 3 and array.shape[2] in (1, 3, 4):
        return array.shape[0], array.shape[1], array.shape[2]
    if array.ndim == 3 and array.shape[0] == 3:
        return array.shape[1], array.shape[2], 3
    raise InputError(f"'{path}' has the shape {list(array.shape)}: give [H, W, 3], [3, H, W] or [H, W]")


def array_pixels(path: Path) -> Float[Tensor, "C H W"]:
    """Reads an array as display values in [0, 1], with 3 or 4 channels; InputError: it holds other values."""
    array = mapped(path)
    height, width, channels = layout_of_array(path, array)
    if array.ndim == 3 and array.shape[2] not in (1, 3, 4):
        array = array.transpose(1, 2, 0)
    whole = 255 if array.dtype == np.uint8 else 65535 if array.dtype == np.uint16 else 1
    values = torch.from_numpy(array.reshape(height, width, channels).astype(np.float32) / whole)
    refuse_other_values(path, values)
    return (values.expand(-1, -1, 3) if channels == 1 else values).permute(2, 0, 1).clamp(0, 1).contiguous()


def refuse_other_values(path: Path, values: Float[Tensor, "H W C"]) -> None:
    """Raises InputError for values that are not finite or not in [0, 1]."""
    if not bool(values.isfinite().all()):
        raise InputError(f"'{path}' holds values that are not finite: render that view again")
    least, most = float(values.min()), float(values.max())
    if least < -MOST_ROUNDING or most > 1 + MOST_ROUNDING:
        raise InputError(
            f"'{path}' holds values from {least:.3g} to {most:.3g}: give display values in [0, 1], or uint8"
        )
