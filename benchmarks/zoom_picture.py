"""Joins a crop of the gallery's x4 pictures into docs/gallery/zoom_x4.jpg: python benchmarks/zoom_picture.py"""

import argparse
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsx.core.data.images import read_image, write_image
from gsx.core.data.window import Window
from gsx.core.shapes import UInt8
from measuring.machine import ROOT

FOLDER = ROOT / "docs" / "gallery"
LABELS = {"gs3d": "3D-GS", "mip_splatting": "Mip-Splatting", "gs3d_zoom": "gsx (default)", "truth": "truth"}
"""Label of each picture, from left to right, by the name of its file."""
CROP = Window(60, 48, 200, 190)
"""Part of each picture: the tin and bricks around it, px."""
BAR, GAP, FONT = 26, 4, 16
"""Height of a label's bar, distance between pictures, size of letters, px."""


def label_bar(text: str, width: int) -> UInt8[Tensor, "3 h w"]:
    """Draw dark letters on white."""
    import OpenImageIO as oiio

    bar = oiio.ImageBuf(oiio.ImageSpec(width, BAR, 3, oiio.UINT8))
    oiio.ImageBufAlgo.fill(bar, (1.0, 1.0, 1.0))
    place, ink = (width // 2, BAR // 2), (0.1, 0.1, 0.1)
    oiio.ImageBufAlgo.render_text(bar, *place, text, FONT, "DroidSans", ink, "center", "center")
    return torch.from_numpy(bar.get_pixels(oiio.UINT8)).permute(2, 0, 1)


def panel(name: str) -> UInt8[Tensor, "3 h w"]:
    """Cut the crop of one picture, with its label above and a white gap on the right."""
    picture = CROP.cut(read_image(FOLDER / f"{name}.x4.jpg"))
    return pad(torch.cat([label_bar(LABELS[name], CROP.width), picture], 1), (0, GAP), value=255)


def main(words: Sequence[str] | None = None) -> None:
    """Write the picture."""
    argparse.ArgumentParser(description=__doc__).parse_args(words)
    write_image(FOLDER / "zoom_x4.jpg", torch.cat([panel(name) for name in LABELS], 2)[..., :-GAP])


if __name__ == "__main__":
    main()
