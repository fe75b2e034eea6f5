"""EXIF orientations: pictures against OpenImageIO's own, cameras against projected points."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from gsx.core.data.camera import Camera
from gsx.core.data.images import image_size, read_image
from gsx.scenes.exif import orientation_of
from gsx.scenes.orientation import (
    AFTER_MIRROR,
    INVERSES,
    MIRROR,
    TURNS,
    WITHOUT_MIRROR,
    oriented,
    oriented_camera,
    oriented_size,
)

PICTURE = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (3, 16, 32), np.uint8))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_openimageio_turns_them(tmp_path: Path, orientation: int) -> None:
    path = tmp_path / "a.jpg"
    buffer = oiio.ImageBuf(np.ascontiguousarray(PICTURE.permute(1, 2, 0).numpy()))
    buffer.specmod().attribute("Orientation", orientation)
    assert buffer.write(str(path))
    stored = read_image(path)
    expected = oiio.ImageBufAlgo.reorient(oiio.ImageBuf(str(path))).get_pixels(oiio.UINT8)
    upright = oriented(stored, orientation_of(path))
    assert torch.equal(upright, torch.from_numpy(expected).permute(2, 0, 1))
    assert oriented_size(image_size(path), orientation) == (upright.shape[2], upright.shape[1])
    assert torch.equal(oriented(upright, INVERSES.get(orientation, orientation)), stored)


def test_mirrored_pictures_are_a_mirror_and_a_turn() -> None:
    for orientation in (2, 4, 5, 7):
        upright = oriented(PICTURE, orientation)
        assert torch.equal(oriented(oriented(PICTURE, MIRROR), AFTER_MIRROR[orientation]), upright)
        assert torch.equal(oriented(PICTURE, WITHOUT_MIRROR[orientation]), upright.flip(-1))


@pytest.mark.parametrize("value", [0, 9, 300])
def test_no_orientation_is_as_stored(tmp_path: Path, value: int) -> None:
    buffer = oiio.ImageBuf(np.zeros((4, 8, 3), np.uint8))
    buffer.specmod().attribute("Orientation", value)
    assert buffer.write(str(tmp_path / "a.jpg"))
    assert orientation_of(tmp_path / "a.jpg") == 1


@pytest.mark.parametrize("orientation", TURNS)
def test_turned_cameras_see_points_where_turned_pictures_show_them(orientation: int) -> None:
    """A picture with one bright pixel, whose centre a point projects to."""
    axes, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    camera = Camera(
        rotation=axes * torch.linalg.det(axes), translation=torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64),
        fx=30.0, fy=33.0, cx=14.0, cy=9.0, width=32, height=16,
    )  # fmt: skip
    column, row = 21, 5
    point = camera.unproject(torch.tensor([[column + 0.5, row + 0.5]]), torch.tensor([3.0]))
    picture = torch.zeros(1, 16, 32, dtype=torch.uint8)
    picture[0, row, column] = 255
    down, across = oriented(picture, orientation)[0].nonzero()[0].tolist()
    turned = oriented_camera(camera, orientation)
    pixels, depths = turned.project(point)
    assert turned.size == oriented_size(camera.size, orientation)
    assert pixels[0].tolist() == pytest.approx([across + 0.5, down + 0.5], abs=1e-4)
    assert float(depths[0]) == pytest.approx(3.0, abs=1e-5)
    assert torch.linalg.det(turned.rotation) == pytest.approx(1.0)
    assert torch.allclose(turned.centre, camera.centre)
