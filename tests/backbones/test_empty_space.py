"""Space that cut-out photographs show to be empty: a sphere's silhouettes, drawn from its equation."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from gsx.backbones.adaptive import in_empty_space
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.images import ImageCache, write_image
from gsx.core.data.masks import Mask
from gsx.core.data.resize import ResizeRule
from gsx.core.data.scene import View
from gsx.scenes.photo_source import PhotoSource

RADIUS, SIDE = 0.5, 96
EYES = [(4, 0, 0), (0, 4, 0), (-3, -3, 0.5)]


def distance_to_ray(camera: Camera, directions: Tensor) -> Tensor:
    """Distance of the origin from rays of a camera's centre."""
    centre = camera.centre.double()
    along = directions / directions.norm(dim=-1, keepdim=True)
    return (centre - (along @ centre)[..., None] * along).norm(dim=-1)


def cut_out(camera: Camera) -> Tensor:
    """Red where a ray through the middle of a pixel meets the sphere, transparent elsewhere."""
    middle = torch.arange(SIDE, dtype=torch.float64) + 0.5
    y, x = torch.meshgrid(middle, middle, indexing="ij")
    rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
    met = distance_to_ray(camera, rays @ camera.rotation.double()) < RADIUS
    red = torch.tensor([255, 0, 0])[:, None, None].expand(3, SIDE, SIDE)
    return torch.cat([red, 255 * met[None]]).to(torch.uint8)


def views_of(folder: Path, downscale: int = 1, channels: int = 4) -> list[View]:
    cache, rule = ImageCache(10**7), ResizeRule(filter="bicubic", light="display", background=(1.0, 1.0, 1.0))
    views = []
    for number, eye in enumerate(EYES):
        whole = look_at(eye, [0, 0, 0], fov_x=0.6, width=SIDE, height=SIDE)
        path = folder / f"{number}.png"
        write_image(path, cut_out(whole)[:channels])
        source = PhotoSource(path=path, rule=rule, cache=cache, whole=whole)
        views.append(View(path.stem, whole.resize(SIDE // downscale, SIDE // downscale), source))
    return views


def witnesses(points: Tensor, views: list[View], margin: float) -> Tensor:
    """How many cameras see each point beside the sphere, by its equation."""
    cameras = [view.camera for view in views]
    beside = [
        (distance_to_ray(camera, points.double() - camera.centre.double()) > RADIUS + margin) & camera.sees(points)
        for camera in cameras
    ]
    return torch.stack(beside).sum(0)


@pytest.mark.parametrize("downscale", [1, 2])
def test_what_two_silhouettes_leave_out_is_empty(downscale: int, tmp_path: Path) -> None:
    views = views_of(tmp_path, downscale)
    points = (torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * 2.4
    empty = in_empty_space(points, views)
    pixel = 4.5 / views[0].camera.fx  # at the far side of the sphere
    assert not empty[points.norm(dim=1) < RADIUS].any()
    assert not (empty & (witnesses(points, views, -pixel) < 2)).any()
    surely = witnesses(points, views, 4 * pixel) >= 2
    assert empty[surely].all()
    assert 0.2 < surely.float().mean() < 1


def test_pictures_without_alpha_and_masks_tell_nothing(tmp_path: Path) -> None:
    views, points = views_of(tmp_path), torch.tensor([[0.7, 0.7, 0.0]])
    assert bool(in_empty_space(points, views))
    masked = [replace(v, source=replace(v.source, mask=Mask(path=v.source.path, alpha=True))) for v in views]
    assert not bool(in_empty_space(points, masked))
    (tmp_path / "rgb").mkdir()
    assert not bool(in_empty_space(points, views_of(tmp_path / "rgb", channels=3)))


def test_one_view_alone_and_points_out_of_sight_tell_nothing(tmp_path: Path) -> None:
    views, beside = views_of(tmp_path), torch.tensor([[0.0, 1.0, 0.0]])
    assert not bool(in_empty_space(beside, views[:1]))
    behind = 2 * views[0].camera.centre[None]  # behind the first, beyond the raster of the others
    assert not bool(in_empty_space(behind, views))
