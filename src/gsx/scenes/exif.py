"""Facts about photos from EXIF: orientation and lens."""

import math
from pathlib import Path

from gsx.core.data.images import header_of

Lens = tuple[str, str, float, float]
"""Maker, model, focal length in mm, and that of the same view on 35 mm film; empty or 0 where a file lacks it."""
NO_LENS: Lens = ("", "", 0.0, 0.0)


def lens_of(path: str | Path) -> Lens:
    """Return the lens of a photo; InputError: the file is missing or is no image."""
    spec = header_of(path)
    maker, model = (spec.get_string_attribute(name, "") for name in ("Make", "Model"))
    lengths = [spec.get_float_attribute(f"Exif:{name}", 0.0) for name in ("FocalLength", "FocalLengthIn35mmFilm")]
    focal, film = (round(length, 3) if 0 < length < math.inf else 0.0 for length in lengths)  # 0/0 is read as nan
    return maker, model, focal, film


def orientation_of(path: str | Path) -> int:
    """Return the EXIF orientation, 1 to 8; 1 (as stored): the file has none, or no such number."""
    value = int(header_of(path).get_int_attribute("Orientation", 1))
    return value if 1 <= value <= 8 else 1
