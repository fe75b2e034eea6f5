"""Image files, read and written by OpenImageIO, and a cache of images.

Images are uint8 display values [C, H, W], red first, straight alpha (if any) last.
"""

import errno
import os
import shutil
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsx.core.data.resize import Size, display_from_linear, to_uint8
from gsx.core.errors import InputError
from gsx.core.files import refuse_lfs_pointer, replacing
from gsx.core.shapes import Float, Shaped, UInt8

JPEG_QUALITY = 95
PNG_EFFORT = {"png:compressionLevel": 1, "png:filter": 0x80}
"""Weak compression and Paeth's predictor: faster than libpng's defaults, with more bytes."""


def read_image(path: str | Path) -> UInt8[Tensor, "C H W"]:
    """Reads an image with 3 or, with alpha, 4 channels.

    Grey becomes RGB, 16 bits are rounded to 8, floating-point values are linear light and get the sRGB curve,
    premultiplied colours are divided by alpha. EXIF's orientation is not applied, as in the cameras of COLMAP,
    nerfstudio and 3D-GS (gsx.scenes.orientation).

    Raises:
        InputError: the file is missing, damaged, CMYK, or has channels other than grey or RGB and alpha.
    """
    pixels, spec = decode(Path(path))
    stated = spec.get_int_attribute("oiio:UnassociatedAlpha", 0) == 1 or Path(path).suffix.lower() == ".bmp"
    straight = spec.alpha_channel < 0 or stated  # OpenImageIO does not state it for BMP
    if pixels.shape[2] < 3:  # grey, perhaps with alpha
        pixels = pixels[..., (0, 0, 0, 1)[: pixels.shape[2] + 2]]
    return _display_bytes(pixels, straight, path).permute(2, 0, 1).contiguous()


def image_size(path: str | Path) -> Size:
    """Returns (width, height) from the header alone; InputError as `header_of`."""
    spec = header_of(path)
    return spec.width, spec.height


def has_alpha(path: str | Path) -> bool:
    """Returns whether an image has alpha, from the header alone; InputError as `header_of`."""
    return bool(header_of(path).alpha_channel >= 0)


def write_image(
    path: str | Path,
    image: UInt8[Tensor, "C H W"] | Float[Tensor, "C H W"],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Writes RGB as PNG or JPEG, by suffix, or straight RGBA as PNG, atomically.

    Args:
        path: File.
        image: 8-bit values, or floats in [0, 1], which are rounded by `to_uint8`.
        attributes: Further header entries by OpenImageIO's names, such as EXIF.

    Raises:
        InputError: the suffix is wrong, or the file cannot be written.
    """
    import OpenImageIO as oiio

    path = Path(path)
    if image.dim() != 3:
        raise InputError(f"Image '{path}' has the shape {tuple(image.shape)}, give channels, height and width.")
    suffixes = (".png", ".jpg", ".jpeg") if image.shape[0] == 3 else (".png",)
    if path.suffix.lower() not in suffixes:
        raise InputError(f"Image '{path}' has {image.shape[0]} channels, write it as {' or '.join(suffixes)}.")
    rounded = image if image.dtype == torch.uint8 else to_uint8(image)
    buffer = oiio.ImageBuf(np.ascontiguousarray(rounded.detach().cpu().permute(1, 2, 0).numpy()))
    buffer.specmod().attribute("Compression", f"jpeg:{JPEG_QUALITY}")
    for name, value in (PNG_EFFORT | dict(attributes or {})).items():
        buffer.specmod().attribute(name, value)
    buffer.specmod().attribute("oiio:UnassociatedAlpha", 1)
    try:
        with replacing(path) as partial, in_memory(partial) as name:
            if not buffer.write(name, fileformat=path.suffix[1:].lower()):
                raise InputError(f"Image '{path}' cannot be written ({buffer.geterror()}), check the folder's space.")
    except OSError as problem:
        full = dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free some space")
        remedy = (full | {errno.ENOENT: "make its folder"}).get(problem.errno or 0, "remove what is in its way")
        raise InputError(f"Image '{path}' cannot be written ({problem.strerror}), {remedy}.") from None


@contextmanager
def in_memory(place: Path) -> Iterator[str]:
    """Yields the name of a file in memory (Linux) and copies it to `place` at the end; elsewhere yields `place`.

    OpenImageIO ignores errors of the disk under a PNG or GIF, and ends the process under a JPEG.
    """
    if not hasattr(os, "memfd_create") or not os.path.isdir("/proc/self/fd"):
        yield str(place)
        return
    with open(os.memfd_create("gsx"), "rb") as memory:
        yield f"/proc/self/fd/{memory.fileno()}"
        with place.open("wb") as file:
            shutil.copyfileobj(memory, file)


class ImageCache:
    """Cache of the most recently used images, of at most `budget_bytes`."""

    def __init__(self, budget_bytes: int) -> None:
        self._budget = budget_bytes
        self._used = 0
        self._images: OrderedDict[Hashable, Tensor] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Shaped[Tensor, "C H W"]]) -> Shaped[Tensor, "C H W"]:
        """Returns the image of a key; calls `make` if it is not stored."""
        if key in self._images:
            self._images.move_to_end(key)
            return self._images[key]
        image = make()
        if image.numel() <= self._budget:
            self._images[key] = image
            self._used += image.numel()
        while self._used > self._budget:
            self._used -= self._images.popitem(last=False)[1].numel()
        return image


def composite(image: UInt8[Tensor, "4 H W"], background: tuple[float, float, float]) -> UInt8[Tensor, "3 H W"]:
    """Composites straight-alpha RGBA over a background, in float64, truncated to 8 bits (3D-GS)."""
    values = image.double() / 255
    colour, alpha = values[:3], values[3:]
    behind = torch.tensor(background, dtype=torch.float64)[:, None, None]
    return ((colour * alpha + behind * (1 - alpha)) * 255).to(torch.uint8)


def header_of(path: str | Path) -> Any:
    """Returns OpenImageIO's description of a file, from its header; InputError: it is missing or no image."""
    reader = open_image(Path(path))
    spec = reader.spec()
    reader.close()
    return spec


def open_image(path: Path) -> Any:
    """Returns an OpenImageIO reader that does not premultiply straight alpha."""
    import OpenImageIO as oiio

    if not path.is_file():
        raise InputError(f"Image '{path}' does not exist, check the folder and the name.")
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(path), hints)
    if reader is None:
        problem = in_one_line(oiio.geterror())
        refuse_lfs_pointer(path)
        raise InputError(f"Image '{path}' cannot be read ({problem}), convert it to PNG or JPEG.")
    return reader


def decode(path: Path) -> tuple[np.ndarray, Any]:
    """Returns pixels [H, W, C] in the file's number type, and its description."""
    reader = open_image(path)
    spec = reader.spec()
    refuse_unusable(path, spec)
    pixels = reader.read_image(spec.format)
    error = reader.geterror()
    reader.close()
    if pixels is None or error:
        raise damaged(path, error)
    return pixels, spec


def damaged(path: Path, error: str) -> InputError:
    """Returns the error for undecodable pixels; `error` is the library's message."""
    if "not configured" in error or "not implemented" in error:  # a libtiff without this compression
        return InputError(f"Image '{path}' cannot be decoded here ({in_one_line(error)}), save it as PNG or JPEG.")
    return InputError(f"Image '{path}' is damaged ({in_one_line(error)}), copy or export it anew.")


def refuse_unusable(path: str | Path, spec: Any) -> None:
    """Raises InputError for a header with CMYK, a partial picture, or channels other than grey or RGB and alpha."""
    if _is_cmyk(spec):
        raise InputError(f"Image '{path}' is CMYK, whose colours need a printing profile: convert it to sRGB.")
    if (spec.width, spec.height) != (spec.full_width, spec.full_height):
        raise InputError(
            f"Image '{path}' stores only a {spec.width} x {spec.height} window of its {spec.full_width} x"
            f" {spec.full_height} pixels, write it whole."
        )
    channels = spec.nchannels
    if channels not in (1, 2, 3, 4) or (channels % 2 == 0 and spec.alpha_channel != channels - 1):
        raise InputError(
            f"Image '{path}' has channels {', '.join(spec.channelnames)}, keep only grey or RGB, with or without alpha."
        )


def in_one_line(text: str) -> str:
    """Joins the lines of a message."""
    return "; ".join(line.strip() for line in text.splitlines())


def _is_cmyk(spec: Any) -> bool:
    names = ("jpeg:ColorSpace", "tiff:ColorSpace", "oiio:ColorSpace")
    return any(spec.get_string_attribute(name).lower() in ("cmyk", "ycbcrk", "color separated") for name in names)


def _display_bytes(pixels: np.ndarray, straight: bool, path: str | Path) -> UInt8[Tensor, "H W C"]:
    """Converts pixels of any number type to 8-bit display values with straight alpha."""
    if pixels.dtype == np.uint8 and straight:
        return torch.from_numpy(pixels)
    is_light = np.issubdtype(pixels.dtype, np.floating)
    full = 1.0 if is_light else float(np.iinfo(pixels.dtype).max)
    values = torch.from_numpy(pixels.astype(np.float32) / full)
    if values.isnan().any():
        raise InputError(f"Image '{path}' holds values that are not numbers (NaN), render or export it anew.")
    colour, alpha = values[..., :3], values[..., 3:]
    if not straight:
        colour = torch.where(alpha > 0, colour / alpha.clamp(min=torch.finfo(torch.float32).tiny), 0)
    return to_uint8(torch.cat([display_from_linear(colour) if is_light else colour, alpha], dim=-1))


def is_reduction(size: Size, expected: Size) -> bool:
    """Returns whether one factor of at least 1 reduces both expected sides to the file's, within a pixel."""
    (width, height), (model_width, model_height) = size, expected
    least = max(model_width / (width + 1), model_height / (height + 1))
    most = min(model_width / max(width - 1, 1e-9), model_height / max(height - 1, 1e-9))
    return max(least, 1) <= most


def refuse_other_size(path: str | Path, size: Size, expected: Size) -> None:
    """Raises InputError unless `is_reduction`."""
    (width, height), (model_width, model_height) = size, expected
    if not is_reduction(size, expected):
        turned = ", which are not turned" if is_reduction((height, width), expected) else ""
        raise InputError(
            f"Image '{path}' is {width} x {height} and the camera model says {model_width} x {model_height}: use the"
            f" images the cameras were computed from{turned}."
        )
