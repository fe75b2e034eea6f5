"""Coverage of views: planes before cameras whose frames are worked by hand, with occluders and gaps."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from small_scene import Grey
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.experiments.evaluation.view_coverage import (
    SAMPLES,
    SceneCoverage,
    by_class,
    class_of,
    coverage_lines,
    grid_of,
    scene_coverage,
    small_camera,
)

WIDTH, HEIGHT, FOCAL, DISTANCE = 40, 20, 80.0, 4.0
"""At that distance the frame is 2 wide and 1 high."""


def facing(x: float, distance: float = DISTANCE, focal: float = FOCAL) -> Camera:
    """Looks along +z at the plane z = 0 from so far before it."""
    return Camera(
        rotation=torch.eye(3), translation=torch.tensor([-x, 0.0, distance]), fx=focal, fy=focal,
        cx=WIDTH / 2, cy=HEIGHT / 2, width=WIDTH, height=HEIGHT, near=0.01,
    )  # fmt: skip


def turned(camera: Camera, degrees: float) -> Camera:
    """Moves a camera around the world's vertical axis through (0, 0, 0)."""
    angle = torch.deg2rad(torch.tensor(degrees))
    sine, cosine = float(angle.sin()), float(angle.cos())
    around = torch.tensor([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
    return replace(camera, rotation=camera.rotation @ around)


def views_of(cameras: Sequence[Camera]) -> list[View]:
    return [View(f"{number}.jpg", camera, Grey()) for number, camera in enumerate(cameras)]


def plane(camera: Camera, wall: float = 0.0, half: float = 1e9) -> tuple[Tensor, Tensor]:
    """Depth and alpha of the plane z = wall where |x| < half."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    slopes = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
    directions, centre = slopes @ camera.rotation, camera.centre
    depth = (wall - centre[2]) / directions[..., 2]
    across = centre[0] + depth * directions[..., 0]
    alpha = ((depth > 0) & (across.abs() < half)).float()
    return depth * alpha, alpha


def coverage(train: Sequence[Camera], test: Sequence[Camera] = (), draw=plane) -> SceneCoverage:
    return scene_coverage(views_of(train), [View("t.jpg", camera, Grey()) for camera in test], draw, 1e6)


def figures(train: Sequence[Camera], test: Camera, draw=plane) -> tuple[float, float]:
    entry = coverage(train, [test], draw).test[0].figures()
    return entry["coverage"], entry["covering_views"]


def test_frames_that_overlap_are_counted_by_hand() -> None:
    """Frames are 2 wide. Of x in [-1, 1], four frames moved by 0, 0.5, 1 and 1.5 hold 4, 3, 2 and 1 quarters."""
    share, views = figures([facing(x) for x in (0.001, 0.5, 1.0, 1.5)], facing(0.0))
    assert share == pytest.approx(0.5)
    assert views == pytest.approx((4 + 3 + 2 + 1) / 4)


def test_a_view_behind_all_others_is_not_covered() -> None:
    """It shows the back of the plane, on the same points; another looks away from it, into the void."""
    train, behind = [facing(x) for x in (0.1, 0.2, 0.3)], turned(facing(0.0), 180)
    away = replace(behind, translation=-behind.translation)
    assert figures(train, behind) == (0, 0)
    assert figures(train, away) == (0, 0)


def test_others_leave_out_the_view_itself() -> None:
    """Three cameras close together: each has two others."""
    train = coverage([facing(x) for x in (0.0, 0.001, 0.002)]).train
    assert [one.figures()["coverage"] for one in train] == [0, 0, 0]
    assert [one.figures()["covering_views"] for one in train] == pytest.approx([2, 2, 2], abs=0.06)


def test_photos_of_one_pose_do_not_cover_each_other() -> None:
    assert figures([facing(0.0)] * 4, facing(0.0)) == (0, 0)
    assert figures([facing(0.0)] * 4, facing(0.001))[1] == pytest.approx(4, abs=0.1)


def test_a_gap_before_a_plane_is_thin_on_both_of_its_sides() -> None:
    """Frames at 0, 0.5, 1 and 4, 4.5, 5: the gap's sides have few others, the middles have all."""
    train = coverage([facing(x) for x in (0.0, 0.5, 1.0, 4.0, 4.5, 5.0)]).train
    right_of = train[2]
    counts, across = right_of.counts, right_of.sampled.points[:, 0]
    assert (counts[across > 1.5] == 0).all()
    assert (counts[(across > 0.1) & (across < 0.9)] == 2).all()
    assert (train[3].counts[train[3].sampled.points[:, 0] < 3.5] == 0).all()


def test_what_stands_before_a_point_hides_it() -> None:
    """A wall at z = -2 with |x| < 0.25 hides from the frame at x = 1 what it has behind it."""

    def draw(camera: Camera) -> tuple[Tensor, Tensor]:
        depth, alpha = plane(camera)
        if camera.centre[0] < 0.5:  # the view itself has a hole in the wall
            return depth, alpha
        near, wall = plane(camera, -2.0, 0.25)
        return torch.where(wall > 0, near, depth), alpha

    own = coverage([facing(0.0), facing(1.0)], draw=draw).train[0]
    across = own.sampled.points[:, 0]
    # a ray from x = 1, z = -4 to x on the plane crosses z = -2 at (1 + x) / 2
    crossing = (1 + across) / 2
    clear, inside = (crossing - 0.25).abs() > 0.03, across > 0.01
    assert (own.counts[inside & clear] == (crossing > 0.25)[inside & clear].long()).all()
    assert (own.counts[across < -0.01] == 0).all()


@pytest.mark.parametrize(("wall", "covered"), [(-0.7, True), (-0.9, False), (0.5, True)])
def test_only_what_is_clearly_nearer_hides(wall: float, covered: bool) -> None:
    """Training views have a wall at z, 4 + z before them; less than 0.8 of the plane's 4 hides it, 3.2."""
    one = coverage(
        [facing(0.001 * n) for n in range(1, 4)], [facing(0.0)], lambda c: plane(c, wall if c.centre[0] > 5e-4 else 0.0)
    )
    assert one.test[0].figures()["coverage"] == pytest.approx(float(covered), abs=0.06)


@pytest.mark.parametrize(("degrees", "covered"), [(40, True), (50, False)])
def test_a_camera_from_another_side_covers_nothing(degrees: float, covered: bool) -> None:
    """At the point that both look at; depths of a plane agree from any side."""
    one = coverage([turned(facing(0.0), degrees)] * 3, [facing(0.0)]).test[0]
    middle = (one.sampled.points[:, 0].abs() < 0.04) & (one.sampled.points[:, 1].abs() < 0.04)
    assert middle.any()
    assert (one.counts[middle] == (3 if covered else 0)).all()


@pytest.mark.parametrize(("distance", "covered"), [(7.6, True), (8.4, False), (2.4, True)])
def test_a_camera_that_shows_less_than_half_the_size_covers_nothing(distance: float, covered: bool) -> None:
    one = coverage([facing(0.0, distance)] * 3, [facing(0.0)]).test[0]
    middle = one.sampled.points[:, :2].norm(dim=1) < 0.1
    assert (one.counts[middle] == (3 if covered else 0)).all()
    longer = coverage([facing(0.0, distance, 2 * FOCAL)] * 3, [facing(0.0)]).test[0]
    assert (longer.counts[middle] == 3).all()


def test_sky_is_covered_where_cameras_look_the_same_way() -> None:
    """Nothing in any direction; a turn by 100 degrees leaves no common direction."""

    def sky(camera: Camera) -> tuple[Tensor, Tensor]:
        return torch.zeros(camera.height, camera.width), torch.zeros(camera.height, camera.width)

    train = [facing(x) for x in (0.1, 0.2, 0.3)]
    assert figures(train, facing(0.0), sky) == (1, 3)
    assert figures(train, turned(facing(0.0), 100), sky) == (0, 0)
    assert figures(train, facing(0.0), lambda c: plane(c) if c.centre[0] else sky(c)) == (0, 0)


class HalfMasked(Grey):
    """The left half does not count."""

    def counted(self, camera: Camera) -> Tensor:
        return (torch.arange(camera.width) >= camera.width // 2).expand(camera.height, -1)


def test_masked_pixels_neither_cover_nor_count() -> None:
    masked = [View(f"{n}", facing(0.001 * n), HalfMasked()) for n in range(1, 4)]
    plain = View("t", facing(0.0), Grey())
    whole = scene_coverage(masked, [plain], plane, 1e6).test[0]
    assert whole.figures()["coverage"] == pytest.approx(0.5, abs=0.03)
    other = scene_coverage(masked, [View("t", facing(0.0), HalfMasked())], plane, 1e6).test[0]
    assert len(other.counts) == len(whole.counts) / 2
    assert other.figures()["coverage"] == pytest.approx(1, abs=0.06)


def test_right_halves_have_figures_of_their_own() -> None:
    """Frames at 0.5, 0.5 and 0.5 hold the right three quarters."""
    one = coverage([facing(0.5)] * 3, [facing(0.0)]).test[0]
    assert one.figures()["coverage"] == pytest.approx(0.75)
    assert one.figures(right=True)["coverage"] == pytest.approx(1.0)


@pytest.mark.parametrize("size", [(40, 20), (640, 480), (31, 1000), (5000, 7)])
def test_grids_have_few_samples(size: tuple[int, int]) -> None:
    camera = small_camera(replace(facing(0.0), width=size[0], height=size[1]))
    columns, rows = grid_of(camera)
    assert 0 < len(columns) * len(rows) <= SAMPLES
    assert columns[-1] < camera.width
    assert rows[-1] < camera.height
    assert max(camera.size) <= 160


def test_figures_by_class_are_means_of_their_views() -> None:
    shares, psnr = [1.0, 0.9, 0.89, 0.2, None], [30.0, 20.0, 18.0, 14.0, 10.0]
    entries = [
        {"coverage": share, "covering_views": 1.0, "psnr": value, "ssim": 0.5, "lpips": None}
        for share, value in zip(shares, psnr, strict=True)
    ]
    classes = by_class(entries)
    assert {name: (one["views"], one["psnr"], one["lowest_psnr"]) for name, one in classes.items()} == {
        "well": (2, 25.0, 20.0), "partly": (1, 18.0, 18.0), "thin": (1, 14.0, 14.0)
    }  # fmt: skip
    assert classes["well"]["lpips"] is None
    assert [class_of(share) for share in (0.9, 0.5, 0.499, 0.0)] == ["well", "partly", "thin", "thin"]


def evaluation_of(test: Sequence[Camera]) -> dict:
    """Coverage by frames at 0, 0.5 and 1, and figures by hand of a view at 20 dB less 1 for each before it."""
    measured = coverage([facing(x) for x in (0.0, 0.5, 1.0)], test)
    views = [{"name": "t", "psnr": 20.0 - number, "ssim": 0.5, "lpips": None} for number in range(len(test))]
    return measured.figures(views)


def test_evaluations_say_what_a_mean_is_a_mean_of() -> None:
    """A frame at 0.5 shares [0, 1] with all three, half of its pixels; one at 9 shares nothing."""
    entry = evaluation_of([facing(0.501), facing(9.0)])
    assert [view["coverage"] for view in entry["views"]] == pytest.approx([0.5, 0.0])
    assert [view["psnr"] for view in entry["views"]] == [20.0, 19.0]
    assert entry["coverage"]["share"] == pytest.approx(0.25)
    assert entry["coverage"]["training"]["classes"] == {"well": 0, "partly": 0, "thin": 3}
    assert coverage_lines(entry) == [
        "coverage: at least 3 training views show 25% of a test view; "
        "test views partly 1 (20.00 dB), thinly 1 (19.00 dB)"
    ]


def test_without_test_views_training_views_are_described() -> None:
    """Of four frames a tenth apart each has three others; the outer ones have them on 1.7 of 2."""
    measured = coverage([facing(x) for x in (0.0, 0.1, 0.2, 0.3)])
    assert coverage_lines(measured.figures([])) == [
        "coverage: at least 3 other training views show 85% of a training view"
    ]


def test_unknown_coverage_says_why() -> None:
    assert coverage_lines({"coverage": {"unavailable": "no memory"}}) == ["coverage: n/a, no memory"]
    assert coverage_lines({}) == []
