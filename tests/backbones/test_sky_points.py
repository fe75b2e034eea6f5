"""What lies behind the scene: a plain below, a sky above whose colour tells the direction."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsx.backbones.sky import CELLS, DISTANCE, none_above, sky_of
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.formats.turned import spread_directions

LOWEST = 0.1
"""Sine of the elevation above which nothing of the scene is seen."""


class ColouredSky:
    """Above the horizon the colour is the direction; what it may show beside is told."""

    hidden: str = ""

    def image(self, camera: Camera) -> Tensor:
        column, row = torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy")
        pixels = torch.stack([column, row], 2).reshape(-1, 2) + 0.5
        x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
        rays = torch.stack([x, y, torch.ones_like(x)], 1) @ camera.rotation.float()
        colours = (rays / rays.norm(dim=1, keepdim=True) + 1) / 2
        return (255 * colours.T.reshape(3, camera.height, camera.width)).round().byte()

    def max_zoom(self, camera: Camera) -> float:
        return 1.0

    def counted(self, camera: Camera) -> Tensor | None:
        return self.right(camera) if self.hidden == "masked" else None

    def transparent(self, camera: Camera) -> Tensor | None:
        return ~self.right(camera) if self.hidden == "cut out" else None

    def right(self, camera: Camera) -> Tensor:
        return (torch.arange(camera.width) >= camera.width // 2).expand(camera.height, -1)


def towers(seed: int = 0) -> Tensor:
    """Points of a ring of walls around the origin, seen from inside up to an elevation whose sine is LOWEST."""
    generator = torch.Generator().manual_seed(seed)
    turn, height = 2 * torch.pi * torch.rand(6000, generator=generator), torch.rand(6000, generator=generator)
    top = 20 * LOWEST / (1 - LOWEST**2) ** 0.5
    return torch.stack([20 * turn.cos(), 20 * turn.sin(), -6 + (6 + top) * height], 1)


def scene_of(positions: Tensor, source: ColouredSky | None = None, roll: bool = False) -> Scene:
    cameras = []
    for number in range(12):
        turn = torch.tensor(2 * torch.pi * number / 12)
        eye = [float(turn.cos()), float(turn.sin()), 0.0]
        camera = look_at(eye, [9 * value for value in eye], fov_x=1.2, width=120, height=100)
        cameras.append(rolled(camera) if roll and number % 3 == 0 else camera)
    return Scene(
        name="plain",
        train=[View(f"v{number}", camera, source or ColouredSky()) for number, camera in enumerate(cameras)],
        test=[],
        points=PointCloud(positions, torch.zeros(len(positions), 3, dtype=torch.uint8)),
        background=torch.zeros(3),
        extent=1.1,
    )


def rolled(camera: Camera) -> Camera:
    """Held on its side."""
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turn = quarter.to(camera.rotation)
    return replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)


def seen(scene: Scene) -> tuple[Tensor, Tensor, float]:
    """(directions, colours, share)."""
    sky = sky_of(scene)
    positions = sky.points.positions
    return positions / positions.norm(dim=1, keepdim=True), sky.points.colours, sky.share


@pytest.mark.parametrize("roll", [False, True])
def test_it_is_where_nothing_is_found_and_nothing_above_in_the_colours_of_the_photographs(roll: bool) -> None:
    rays, colours, share = seen(scene_of(towers(), roll=roll))
    assert 0.2 < share < 0.6
    assert len(rays) > 800
    assert float(rays[:, 2].min()) > LOWEST - 0.02
    assert float((rays[:, 2] < LOWEST + 0.15).float().mean()) > 0.1  # down to the walls' tops
    assert ((rays + 1) / 2 * 255 - colours).abs().max() < 8


def test_it_stands_far_behind_all_points() -> None:
    scene = scene_of(towers())
    distance = sky_of(scene).points.positions.norm(dim=1)
    assert torch.allclose(distance, torch.tensor(DISTANCE * 1.1), rtol=1e-4)
    far = sky_of(replace(scene, points=PointCloud(100 * towers(), scene.points.colours)))
    assert float(far.points.positions.norm(dim=1).min()) > 1.9 * 2000


@pytest.mark.parametrize("hidden", ["masked", "cut out"])
def test_what_does_not_count_and_what_is_cut_out_is_no_sky(hidden: str) -> None:
    source = ColouredSky()
    source.hidden = hidden
    whole, half = seen(scene_of(towers()))[2], seen(scene_of(towers(), source))[2]
    assert half == pytest.approx(whole / 2, rel=0.05)


def test_nothing_is_behind_a_scene_that_surrounds_its_cameras_or_shows_no_points() -> None:
    ball = torch.randn(20000, 3, generator=torch.Generator().manual_seed(0))
    assert seen(scene_of(10 * ball / ball.norm(dim=1, keepdim=True)))[2] < 0.01
    assert len(sky_of(scene_of(torch.zeros(0, 3))).points) == 0


def test_points_above_and_beside_close_a_pixel() -> None:
    """Squares of 10 px, up is up: a point at (55, 45) closes what is below it, beside that, and one square above."""
    up, point = torch.tensor([0.0, -1.0]), torch.tensor([[55.0, 45.0]])
    asked = torch.tensor([[55.0, 95.0], [45.0, 95.0], [65.0, 55.0], [75.0, 95.0], [55.0, 35.0], [55.0, 25.0]])
    assert none_above(asked, point, up, 10.0).tolist() == [False, False, False, True, False, True]


def test_a_scene_far_from_the_origin_has_the_same_sky() -> None:
    """As maps have it: float32 is half a unit there."""
    scene, away = scene_of(towers()), torch.tensor([500000.0, 5600000.0, 100.0], dtype=torch.float64)
    there = replace(
        scene,
        train=[
            replace(view, camera=replace(view.camera, translation=shifted(view.camera, away))) for view in scene.train
        ],
        points=PointCloud((towers().double() + away).float(), scene.points.colours),
    )
    here, sky = sky_of(scene), sky_of(there)
    assert abs(here.share - sky.share) < 0.03
    rays = sky.points.positions.double() - away
    rays = (rays / rays.norm(dim=1, keepdim=True)).float()
    assert ((rays + 1) / 2 * 255 - sky.points.colours).abs().max() < 10


def shifted(camera: Camera, by: Tensor) -> Tensor:
    """The translation of the camera, moved in the world."""
    return camera.translation.double() - camera.rotation.double() @ by


def test_directions_are_evenly_over_the_sphere() -> None:
    found = spread_directions(CELLS).float()
    assert torch.allclose(found.norm(dim=1), torch.ones(8000))
    assert found.mean(0).abs().max() < 1e-3
    nearest = (found[::40] @ found.T).topk(2).values[:, 1].clamp(max=1).acos()
    assert 0.6 < float(nearest.min() / nearest.max()) <= 1
