"""Blocks of a scene: cells with equal numbers of cameras, and the views and points that each trains on."""

import pytest
import torch
from small_scene import Grey
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.errors import ConfigError
from gsx.scenes.blocks import BlockChoice, block_of, cells_of, parsed_block


def line(count: int) -> Tensor:
    """Camera centres at x = 0, 1, 2, ..."""
    return torch.stack([torch.arange(float(count)), torch.zeros(count), torch.zeros(count)], 1).double()


def ahead(x: float, turned: float = 0.0) -> Camera:
    """A camera at (x, 0, 0) that looks along y, or along x if turned is 1."""
    return look_at([x, 0, 0], [x + turned, 1 - turned, 0], fov_x=1.2, width=40, height=30)


def scene_of(cameras: list[Camera], points: Tensor) -> Scene:
    views = [View(f"{number:02}", camera, Grey()) for number, camera in enumerate(cameras)]
    colours = torch.zeros(len(points), 3, dtype=torch.uint8)
    return Scene(
        name="row",
        train=views,
        test=views[::10],
        points=PointCloud(points, colours),
        background=torch.zeros(3),
        extent=1.0,
    )


def choice(number: int, count: int, margin: float = 0.0, share: float = 1.0) -> BlockChoice:
    return BlockChoice(number=number, count=count, margin=margin, share=share)


def names(scene: Scene) -> list[int]:
    return [int(view.name) for view in scene.train]


def test_cells_hold_equal_numbers_of_cameras_and_cover_space_once() -> None:
    """30 cameras for three blocks: 10 and 20, and these 10 and 10, cut half-way between neighbours."""
    cells = cells_of(line(30), 3)
    assert [(float(cell.low[0]), float(cell.high[0])) for cell in cells] == [
        (-torch.inf, 9.5),
        (9.5, 19.5),
        (19.5, torch.inf),
    ]
    assert [cell.cameras.tolist() for cell in cells] == [list(range(start, start + 10)) for start in (0, 10, 20)]
    anywhere = 100 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    anywhere[0, 0] = 9.5
    assert torch.stack([cell.holds(anywhere) for cell in cells]).sum(0).eq(1).all()


def test_the_longest_side_is_cut() -> None:
    """A grid of 4 x 8 cameras, twice as long in y: four blocks are quarters of y, then halves of the longer rest."""
    grid = torch.cartesian_prod(torch.arange(4.0), torch.arange(8.0), torch.zeros(1)).double()
    cells = cells_of(grid, 4)
    assert all(len(cell.cameras) == 8 for cell in cells)
    assert {float(cell.high[1]) for cell in cells} == {3.5, torch.inf}
    assert {float(cell.high[0]) for cell in cells} == {1.5, torch.inf}


def test_views_of_the_cell_of_its_surroundings_and_of_its_points() -> None:
    """Points are ahead of cameras 16 to 19; in the first block nobody else shows them."""
    cameras = [ahead(x) for x in range(20)]
    points = torch.tensor([[x, 3.0, 0.0] for x in (16.2, 17.1, 18.4)])
    scene = scene_of(cameras, points)
    assert names(block_of(scene, choice(1, 2))) == list(range(10))
    assert names(block_of(scene, choice(1, 2, margin=0.25))) == list(range(12))  # 0.25 x 9 beyond 9.5
    second = block_of(scene, choice(2, 2))
    assert names(second) == list(range(10, 20))
    assert [view.name for view in second.test] == ["10"]
    assert "block 2 of 2: 10 of 20 training views, 10 of them in its cell" in second.notes
    assert len(second.points) == 3
    assert not len(block_of(scene, choice(1, 2)).points)


def test_views_from_outside_count_by_the_points_that_nothing_hides() -> None:
    """The first camera looks along x, towards points in the other cell; a wall of points hides them."""
    cameras = [ahead(0, turned=1.0), *(ahead(x) for x in range(1, 20))]
    far = torch.stack([torch.full((20,), 18.0), *(1.5 * torch.randn(20, generator=torch.Generator()) for _ in "yz")], 1)
    wall = torch.cartesian_prod(torch.tensor([3.0]), torch.arange(-1, 1, 0.05), torch.arange(-1, 1, 0.05))
    assert 0 in names(block_of(scene_of(cameras, far), choice(2, 2, share=0.9)))
    assert 0 not in names(block_of(scene_of(cameras, torch.cat([far, wall])), choice(2, 2, share=0.1)))


def test_too_few_cameras_are_refused() -> None:
    with pytest.raises(ConfigError, match="20 training views are too few for 3 blocks: give at most 2"):
        cells_of(line(20), 3)


@pytest.mark.parametrize("word", ["0/3", "4/3", "1", "a/b", "1/0", "-1/2"])
def test_other_words_are_refused(word: str) -> None:
    with pytest.raises(ConfigError, match=f"scene.block is '{word}': give NUMBER/COUNT"):
        parsed_block(word)
