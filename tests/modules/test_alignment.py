"""Where a photograph was taken: of slanted walls whose pictures are known from anywhere."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsx.core.data.camera import Camera, pinhole
from gsx.modules.alignment import Motion, estimate_camera, move_camera, rotation_by

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
AT_ORIGIN = pinhole(torch.eye(3), torch.zeros(3), FOCAL, WIDTH, HEIGHT)


def wall_depth(origin: Tensor, rays: Tensor) -> Tensor:
    """How many rays [H W 3] from a place lie between it and the nearer of two slanted walls in the world."""
    hits = []
    for normal, distance in ((torch.tensor([0.5, 0.1, 1.0]), 4.0), (torch.tensor([-0.8, 0.2, 1.0]), 5.0)):
        normal = normal.double()
        hits.append((distance - normal @ origin) / (rays @ normal))
    return torch.stack(hits).amin(0)


def picture(camera: Camera) -> tuple[Tensor, Tensor]:
    """(three channels, depth) of a camera before the walls, pixel by pixel at its centre."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    own = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1).double()
    rotation = camera.rotation.double()
    centre, rays = -rotation.T @ camera.translation.double(), own @ rotation
    depth = wall_depth(centre, rays)
    point = centre + depth[..., None] * rays
    grey = 0.5 + 0.15 * (5.1 * point[..., 0] + 1.3 * point[..., 1]).sin() * (3.0 * point[..., 2]).cos()
    grey = grey + 0.1 * (2.2 * point[..., 0] - 6.0 * point[..., 1]).sin()
    return torch.stack([grey, 0.9 * grey, 0.8 * grey]).float(), depth.float()


def elsewhere(turn: tuple[float, float, float], move: tuple[float, float, float]) -> Camera:
    """The camera turned by so many px at its focal length, and moved."""
    vector = torch.tensor(turn, dtype=torch.float64) / FOCAL
    return move_camera(AT_ORIGIN, Motion(rotation=rotation_by(vector), move=torch.tensor(move, dtype=torch.float64)))


def found_for(taken: Camera, counted: Tensor | None = None, gain: float = 1.0) -> Camera:
    """Where a photograph taken there is found to be taken, from a render at the origin."""
    image, depth = picture(AT_ORIGIN)
    return estimate_camera(
        AT_ORIGIN, image, depth, torch.ones_like(depth), gain * picture(taken)[0] + 1 - gain, counted
    )


def off(one: Camera, other: Camera) -> tuple[float, float]:
    """(px of the angle between two cameras, scene units between their centres)."""
    between = one.rotation.double() @ other.rotation.double().T
    angle = math.acos(min(1.0, (float(between.trace()) - 1) / 2))
    return FOCAL * angle, float((one.centre.double() - other.centre.double()).norm())


def beside(one: Camera, other: Camera) -> float:
    """Median of how far apart two cameras see what the walls show, px."""
    depth = picture(AT_ORIGIN)[1].flatten()
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    rays = torch.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, torch.ones_like(x)], -1).view(-1, 3)
    points = depth[:, None] * rays
    return float((one.project(points)[0] - other.project(points)[0]).norm(dim=1).median())


MOTIONS = [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.4, -0.6, 0.0), (0.0, 0.0, 0.0)), ((2.0, 3.0, 1.0), (0.0, 0.0, 0.0)),
           ((0.0, 0.0, 0.0), (0.06, -0.04, 0.08)), ((-1.5, 1.0, -2.0), (0.05, 0.03, -0.1))]  # fmt: skip


@pytest.mark.parametrize(("turn", "move"), MOTIONS)
def test_turns_and_moves_are_found_together_whatever_the_exposure(turn, move) -> None:
    """What the walls show is seen where it was, to the accuracy of the interpolation between pixels; a turn and a move
    that almost cancel are told apart less well. 0.06 units are 3.3 px at the usual depth."""
    taken = elsewhere(turn, move)
    found = found_for(taken, gain=0.7)
    angle, distance = off(found, taken)
    assert beside(found, taken) < 0.05
    assert angle < 0.3
    assert distance < 0.01


def test_what_stands_in_the_way_hardly_counts_and_what_is_masked_does_not_at_all() -> None:
    taken, counted = elsewhere((1.0, -1.5, 0.0), (0.03, 0.0, 0.0)), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    image, depth = picture(AT_ORIGIN)
    photograph = picture(taken)[0]
    photograph[:, 60:100, 80:120] = 1.0
    found = estimate_camera(AT_ORIGIN, image, depth, torch.ones_like(depth), photograph, None)
    assert beside(found, taken) < 0.1
    photograph[:, :, :100] = picture(elsewhere((-3.0, 3.0, 0.0), (0.0, 0.0, 0.0)))[0][:, :, :100]
    counted[:, :120] = False
    found = estimate_camera(AT_ORIGIN, image, depth, torch.ones_like(depth), photograph, counted)
    assert beside(found, taken) < 0.1


def test_a_plain_picture_moves_nothing_and_no_depth_tells_nothing() -> None:
    image, depth = picture(AT_ORIGIN)
    plain = torch.full_like(image, 0.5)
    assert beside(estimate_camera(AT_ORIGIN, plain, depth, torch.ones_like(depth), plain, None), AT_ORIGIN) < 1e-6
    other = picture(elsewhere((1.0, 1.0, 0.0), (0.0, 0.0, 0.0)))[0]
    assert estimate_camera(AT_ORIGIN, image, 0 * depth, torch.zeros_like(depth), other, None) is AT_ORIGIN


def test_what_pictures_do_not_tell_goes_back_to_the_given_pose() -> None:
    astray = elsewhere((2.0, -1.0, 0.5), (0.05, 0.0, -0.02))
    plain, depth = torch.full((3, HEIGHT, WIDTH), 0.5), picture(AT_ORIGIN)[1]
    back = estimate_camera(astray, plain, depth, torch.ones_like(depth), plain, None, prior=AT_ORIGIN)
    angle, distance = off(back, AT_ORIGIN)
    assert angle < 0.05
    assert distance < 0.001
    assert off(astray, AT_ORIGIN)[1] > 0.04


def test_a_pose_that_may_be_far_off_is_held_less() -> None:
    """Before a photograph that differs much, and was taken two pixels beside."""
    taken, (image, depth) = elsewhere((2.0, 0.0, 0.0), (0.0, 0.0, 0.0)), picture(AT_ORIGIN)
    photograph = picture(taken)[0] + 0.2 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    moves = [
        beside(
            estimate_camera(AT_ORIGIN, image, depth, torch.ones_like(depth), photograph, None, prior_weight=weight),
            AT_ORIGIN,
        )
        for weight in (25000, 1000, 62.5)
    ]
    assert moves[0] < 0.3
    assert moves[1] == pytest.approx(1.4, abs=0.3)
    assert moves[2] == pytest.approx(2.0, abs=0.2)


def test_depth_is_that_of_what_covers_a_pixel() -> None:
    """The rasterizer sums depth by weights that add up to alpha."""
    taken, (image, depth) = elsewhere((0.0, 0.0, 0.0), (0.06, -0.04, 0.08)), picture(AT_ORIGIN)
    found = estimate_camera(AT_ORIGIN, image, 0.8 * depth, torch.full_like(depth, 0.8), picture(taken)[0], None)
    assert beside(found, taken) < 0.05


def test_before_a_distant_wall_a_turn_is_not_taken_for_a_move() -> None:
    """Both shift the picture alike: the prior shares the shift between them, and lets neither run away."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")

    def flat(across: float) -> Tensor:
        return (0.5 + 0.2 * (0.2 * (x - across)).sin() + 0.2 * (0.15 * y).cos()).expand(3, -1, -1).contiguous()

    depth = torch.full((HEIGHT, WIDTH), 1000.0)
    found = estimate_camera(AT_ORIGIN, flat(0.0), depth, torch.ones_like(depth), flat(1.5), None)
    point = torch.tensor([[0.0, 0.0, 1000.0]])
    assert found.project(point)[0][0, 0] - AT_ORIGIN.project(point)[0][0, 0] == pytest.approx(1.5, abs=0.1)
    assert off(found, AT_ORIGIN)[0] < 3


def test_a_camera_stays_one_over_many_motions() -> None:
    camera = replace(AT_ORIGIN, rotation=1.001 * torch.eye(3))  # as if rounding had stretched it
    for _ in range(20):
        camera = move_camera(camera, Motion(rotation=rotation_by(torch.tensor([0.1, 0.02, -0.05]).double()),
                                      move=torch.zeros(3, dtype=torch.float64)))  # fmt: skip
    torch.testing.assert_close(camera.rotation @ camera.rotation.T, torch.eye(3), atol=1e-6, rtol=0)
