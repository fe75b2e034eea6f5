"""Levels of detail against loops in plain Python and tables worked out from the published code."""

import json
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gsx.backbones.anchor_options import MODES, LevelOptions, checked_end
from gsx.backbones.cells import pooled_max
from gsx.backbones.levels import (
    Levels,
    all_levels_from,
    box_of,
    derive,
    distance_range,
    drawn,
    drawn_fraction,
    facts_of,
    initial_nodes,
    kept,
    level_count,
    switch_points,
    thresholds,
    unlocked,
    viewpoints_of,
    warnings_of,
    whole_level,
)
from gsx.core.data.camera import Camera, look_at
from gsx.core.training.schedule import Schedule

PUBLISHED = LevelOptions(
    fork=2,
    count=-1,
    first=-1,
    base_layer=3,
    voxel=0.02,
    distance_quantile=0.999,
    extend=1.1,
    extend_rule="reference",
    visible_threshold=0.0,
    mode="round",
    half_cell=False,
    zoom="finer",
    coarse_until=10000,
    coarse_factor=1.5,
)


def camera_at(*eye: float, focal: float = 50.0) -> Camera:
    camera = look_at(eye, [eye[0] + 1, eye[1] + 2, eye[2]], fov_x=0.9, width=40, height=40)
    return replace(camera, fx=focal, fy=focal)


def spread(count: int, seed: int = 0, size: float = 1.0) -> Tensor:
    return (torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 0.4) * size


def cameras(count: int = 7) -> list[Camera]:
    """On a spiral, near and far, with three focal lengths."""
    turns = [(0.4 + 0.5 * i, 0.9 * i) for i in range(count)]
    return [
        camera_at(r * math.cos(a), r * math.sin(a), 0.3 * r, focal=(100.0, 50.0, 70.0)[i % 3])
        for i, (r, a) in enumerate(turns)
    ]


def single(count: int = 4, mode: str = "round", farthest: float = 8.0, focal: float = 50.0, **changes) -> Levels:
    """Levels with D given, one training camera at the origin."""
    levels = derive(spread(20), [camera_at(0, 0, 0, focal=focal)], replace(PUBLISHED, count=count, mode=mode), 0)
    return replace(levels, farthest=farthest, **changes)


def at(*distances: float) -> Tensor:
    """Points at those distances from the origin."""
    return torch.tensor([[distance, 0.0, 0.0] for distance in distances])


def level_by_hand(farthest: float, distance: float, mode: str, highest: int, fork: int = 2) -> int:
    """dist2level of one primitive."""
    if distance == 0:
        return highest
    ideal = math.log(farthest / distance) / math.log(fork)
    level = {"round": round, "floor": math.floor, "ceil": math.ceil, "progressive": lambda x: math.floor(x + 1)}[mode]
    return min(max(level(ideal), 0), highest)


def tops(levels: Levels, camera: Camera, distances: list[float], highest: int | None = None) -> list[int]:
    """Highest level the camera draws at each distance."""
    out, highest = [], levels.count - 1 if highest is None else highest
    for point in at(*distances):
        places = point.repeat(levels.count, 1)
        of = torch.arange(levels.count, dtype=torch.int16)
        mask, _ = drawn(levels, places, of, torch.zeros(levels.count), camera, highest)
        assert mask.tolist() == sorted(mask.tolist(), reverse=True), "coarse levels are always drawn"
        out.append(int(mask.sum()) - 1)
    return out


# -- number of levels and grid ---------------------------------------------------------------------------------------


def test_distance_range_is_that_of_sorted_lists():
    points, views, fraction = spread(301), cameras(), 0.97

    def quantile(values: list[float], share: float) -> float:
        ordered, place = sorted(values), share * (len(values) - 1)
        low = math.floor(place)
        return ordered[low] + (place - low) * (ordered[min(low + 1, len(values) - 1)] - ordered[low])

    listed = []
    for camera in views:
        distances = [math.dist(point, camera.centre.tolist()) for point in points.tolist()]
        listed += [100 / camera.fx * quantile(distances, share) for share in (fraction, 1 - fraction)]
    near, far = distance_range(points, viewpoints_of(views), fraction)
    assert near == pytest.approx(quantile(listed, 1 - fraction), rel=1e-5)
    assert far == pytest.approx(quantile(listed, fraction), rel=1e-5)


def test_duplicates_of_points_do_not_count():
    points, options = spread(50), replace(PUBLISHED, distance_quantile=0.9)
    once = derive(points, cameras(), options, 0)
    often = derive(torch.cat([points, points[:1].repeat(500, 1)]), cameras(), options, 0)
    one = torch.zeros(1, dtype=torch.int16)
    assert facts_of(once, one) == facts_of(often, one)


@pytest.mark.parametrize(
    ("near", "far", "fork", "count"),
    [(1, 1, 2, 1), (1, 1.41, 2, 1), (1, 1.42, 2, 2), (1, 8, 2, 4), (2, 80, 2, 6), (1, 27, 3, 4), (0, 0, 2, 1)],
)
def test_number_of_levels(near, far, fork, count):
    assert level_count(near, far, fork) == count


def test_grid_by_hand():
    """Coordinates from -2 to 6: the box is 8.8 long and begins at -2.2, 32 cells of level 0 fill it."""
    points = torch.tensor([[-2.0, 0, 1], [3, 6, 2]])
    levels = derive(points, [camera_at(0, 0, 9)], replace(PUBLISHED, base_layer=5, count=4), 0)
    assert (levels.origin, levels.box, levels.cell) == pytest.approx((-2.2, 8.8, 8.8 / 32))
    assert levels.cell_of(torch.tensor([0, 1, 3], dtype=torch.int16)).tolist() == pytest.approx(
        [8.8 / 32, 8.8 / 64, 8.8 / 256]
    )


@pytest.mark.parametrize(("count", "base"), [(1, 10), (4, 8), (5, 8), (8, 6)])
def test_base_layer_follows_the_voxel(count, base):
    """log2(8.8 / 0.02) is 8.78: nine forks, less K / 2, and one more."""
    points = torch.tensor([[-2.0, 0, 1], [3, 6, 2]])
    levels = derive(points, [camera_at(0, 0, 9)], replace(PUBLISHED, base_layer=-1, count=count), 0)
    assert levels.base_layer == base
    if count > 1:
        assert levels.size(count // 2 - 1) == pytest.approx(0.02, rel=0.5)


@pytest.mark.parametrize(("pixels", "base"), [(0, 10), (1, 4), (1.7, 4), (1.8, 3), (16, 0), (1000, 0)])
def test_the_base_layer_has_cells_of_whole_pixels(pixels, base):
    """A box of 8.8 seen at 50 px a unit of length, from 16: 27.5 px; halved four times 1.71875, five times less than
    a pixel. What is given holds where it is coarser."""
    points = torch.tensor([[-2.0, 0, 1], [3, 6, 2]])
    options = replace(PUBLISHED, base_layer=10, count=4, cell_pixels=pixels)
    far = derive(points, [camera_at(0, 0, 9)], options, 0).farthest
    options = replace(options, cell_pixels=pixels * 16 / far)
    assert derive(points, [camera_at(0, 0, 9)], options, 0).base_layer == base
    assert derive(points, [camera_at(0, 0, 9)], replace(options, base_layer=0), 0).base_layer == 0


@pytest.mark.parametrize(("mode", "share"), [("floor", 1.0), ("round", 2**-0.5), ("ceil", 0.5)])
def test_cells_in_pixels_where_a_level_is_drawn_first(mode, share):
    """Against a search for the farthest distance at which a camera draws each level."""
    levels, camera = single(count=4, mode=mode), camera_at(0, 0, 0)
    distances = torch.linspace(0.2, 9, 20000)
    for level in range(1, 4):
        of = torch.full((len(distances),), level, dtype=torch.int16)
        farthest = float(
            distances[drawn(levels, at(*distances.tolist()), of, torch.zeros(len(of)), camera, 3)[0]].max()
        )
        pixels = levels.size(level) * 50 / farthest / levels.pixels_per_cell
        assert pixels == pytest.approx(share, rel=0.01)


@given(st.floats(-1e4, 1e4), st.floats(1e-2, 1e3))
def test_the_sane_box_holds_the_points_and_is_as_long(start, length):
    points = torch.tensor([[start, start, start + length], [start, start + length / 2, start]])
    low, high = float(points.min()), float(points.max())
    (origin, box), (_, published) = box_of(points, 1.1, "sane"), box_of(points, 1.1, "reference")
    assert box == published
    assert origin <= low <= high <= origin + box


def test_the_published_box_leaves_points_out_away_from_the_origin():
    assert box_of(torch.tensor([[10.0, 11, 12]]), 1.1, "reference")[0] == pytest.approx(11)


# -- nodes and weed-out ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("threshold", [0.0, 0.4])
def test_nodes_are_those_of_loops(mode, threshold):
    points, views = spread(60, size=2), cameras()
    colours = torch.rand(60, 3, generator=torch.Generator().manual_seed(5))
    options = replace(PUBLISHED, mode=mode, visible_threshold=threshold, count=4, base_layer=2)
    levels = derive(points, views, options, 0)
    wanted: dict[tuple, list[int]] = {}
    for level in range(4):
        size = levels.box / 2 ** (2 + level)
        for row, point in enumerate(points.tolist()):
            cell = tuple(round((x - levels.origin) / size) for x in point)
            node = [i * size + levels.origin for i in cell]
            distances = [100 / view.fx * math.dist(node, view.centre.tolist()) for view in views]
            seen = [level <= level_by_hand(levels.farthest, d, mode, 3) for d in distances]
            if sum(seen) / len(seen) > threshold:
                wanted.setdefault((level, *cell), []).append(row)
    positions, of, group = initial_nodes(points, levels)
    assert of.dtype == torch.int16
    found = [(level, *levels.cells(positions[i, None], level)[0].tolist()) for i, level in enumerate(of.tolist())]
    assert found == sorted(wanted)
    assert len(found) > 100
    assert threshold == 0 or bool((group < 0).any())
    pooled = pooled_max(colours.repeat(4, 1), group.flatten(), len(positions))
    for row, key in enumerate(found):
        assert group[key[0]].eq(row).nonzero().flatten().tolist() == wanted[key]
        assert torch.equal(pooled[row], colours[wanted[key]].amax(0))


def test_halves_go_to_the_even_node():
    levels = single(origin=0.0, extent=8.0, base_layer=3)
    assert levels.cells(at(0.5, 1.5, 2.5, -0.5), 0)[:, 0].tolist() == [0, 2, 2, 0]


@pytest.mark.parametrize("level", [0, 3])
def test_positions_of_nodes_give_back_their_cells(level):
    levels = derive(spread(100, size=30) + 40, cameras(), replace(PUBLISHED, base_layer=9), 0)
    cells = torch.randint(0, 2000, (500, 3), generator=torch.Generator().manual_seed(3))
    assert torch.equal(levels.cells(levels.nodes(cells, level), level), cells)


@pytest.mark.parametrize(("mode", "shift"), [("round", 0.5), ("floor", 0.0), ("ceil", 1.0), ("progressive", 1.0)])
def test_levels_end_at_their_distances(mode, shift):
    """Level L counts up to s d = D f^(shift - L), level 0 always."""
    cases = [(3, 1.0), (2, 1.0), (3, 2.0)]
    for fork, coarseness in cases:
        finest, view = 60.0 * coarseness, camera_at(0, 0, 0, focal=60.0)
        levels = single(mode=mode, fork=fork)
        levels = replace(levels, views=viewpoints_of([view, camera_at(1e6, 0, 0, focal=finest)]))
        for level in range(4):
            edge = 8.0 * fork ** (shift - level) / coarseness
            places, of = at(0.999 * edge, 1.001 * edge, 1e4), torch.full((3,), level, dtype=torch.int16)
            far = [False] * 3 if level else [True] * 3  # what the other camera draws
            wanted = [True, level == 0, level == 0]
            shares = [(a + b) / 2 for a, b in zip(wanted, far, strict=True)]
            assert drawn_fraction(levels, places, of).tolist() == shares
            assert drawn(levels, places, of, torch.zeros(3), view, 3)[0].tolist() == wanted


def test_more_than_the_threshold_must_see_a_primitive():
    """Nine of ten cameras are not more than 0.9 of them."""
    views = [camera_at(1, 0.01 * i, 0) for i in range(9)] + [camera_at(1000, 0, 0)]
    levels = replace(single(farthest=2.0), views=viewpoints_of(views))
    of = torch.tensor([0, 1, 3], dtype=torch.int16)
    for threshold, wanted in ((0.89, [True, True, False]), (0.9, [True, False, False]), (0.0, [True, True, False])):
        assert kept(replace(levels, threshold=threshold), at(0, 0, 0), of).tolist() == wanted


def test_adaptive_threshold_by_hand():
    """Two points 1 and 4 from one camera, 4 and 1 from the other, D about 4, K = 3.

    Level 0 is drawn by both cameras, levels 1 and 2 by the near one: fractions of the six nodes are 1, 1 and four
    halves, their mean 2/3, and the second pass keeps level 0 alone.
    """
    points = torch.tensor([[0.0, 0, 0], [5, 0, 0]])
    views = [camera_at(1, 0, 0), camera_at(4, 0, 0)]
    options = replace(PUBLISHED, visible_threshold=-1.0, base_layer=8)
    levels = derive(points, views, options, 0)
    assert levels.count == 3
    assert levels.threshold == pytest.approx(2 / 3)
    assert initial_nodes(points, levels)[1].tolist() == [0, 0]
    every = derive(points, views, replace(options, visible_threshold=0.0), 0)
    assert initial_nodes(points, every)[1].tolist() == [0, 0, 1, 1, 2, 2]


def test_adaptive_threshold_counts_nodes_no_camera_draws():
    """One camera near three of four points: level 1 is drawn for three, so that the mean is 7/8."""
    points = at(1, 2, 3, 60)
    options = replace(PUBLISHED, visible_threshold=-1.0, base_layer=9, count=2, distance_quantile=1.0)
    assert derive(points, [camera_at(0, 0, 0)], options, 0).threshold == pytest.approx(7 / 8)


def test_adaptive_threshold_keeps_what_every_camera_draws():
    points = spread(30)
    levels = derive(points, [camera_at(0, -9, 0)], replace(PUBLISHED, visible_threshold=-1.0, count=1), 0)
    assert len(initial_nodes(points, levels)[0]) > 0


# -- what a camera draws ---------------------------------------------------------------------------------------------


def test_far_cameras_draw_level_0_and_near_ones_more():
    """A camera at twice D draws level 0 alone, one at a quarter of D three levels."""
    levels = single(count=6)
    assert tops(levels, camera_at(0, 0, 0), [16.0, 2.0]) == [0, 2]


@pytest.mark.parametrize("mode", MODES)
def test_levels_drawn_are_those_of_a_loop(mode):
    levels = single(count=7, mode=mode)
    distances = [0.0, *(0.031 * 1.37**i for i in range(24))]
    for highest in (0, 2, 6):
        wanted = [level_by_hand(8.0, distance, mode, highest) for distance in distances]
        assert tops(levels, camera_at(0, 0, 0), distances, highest) == wanted


def test_half_the_focal_length_is_twice_the_distance():
    levels = single(count=9, mode="progressive", focal=64.0)
    distances = torch.linspace(0.05, 12, 150)
    of, bias = torch.arange(150, dtype=torch.int16) % 9, torch.zeros(150)
    coarse = drawn(levels, at(*distances.tolist()), of, bias, camera_at(0, 0, 0, focal=32.0), 8)
    fine = drawn(levels, at(*(2 * distances).tolist()), of, bias, camera_at(0, 0, 0, focal=64.0), 8)
    assert torch.equal(coarse[0], fine[0])
    assert torch.equal(coarse[1], fine[1])
    assert 0 < int(coarse[0].sum()) < 150


def test_zooming_in_four_times_draws_two_levels_more():
    levels, camera = single(count=9), camera_at(0, 0, 0)
    distances = [7.0, 3.0, 1.0]
    assert tops(levels, camera.zoom(4), distances) == [top + 2 for top in tops(levels, camera, distances)]


def test_levels_can_end_with_those_of_the_finest_training_camera():
    """Zoomed in it draws what training drew; a camera half as fine still draws a level less."""
    levels, camera = replace(single(count=9), zoom="training"), camera_at(0, 0, 0)
    distances = [7.0, 3.0, 1.0]
    own = tops(levels, camera, distances)
    assert tops(levels, camera.zoom(4), distances) == own
    assert tops(levels, camera.zoom(0.5), distances) == [max(0, top - 1) for top in own]


@pytest.mark.parametrize("farthest", [1e-3, 8.0, 1e4])
def test_a_camera_at_a_primitive_asks_for_a_finite_level(farthest):
    assert single(farthest=farthest).ideal(torch.zeros(1), 2.0).item() == pytest.approx(math.log2(1e8))


def test_bias_asks_for_finer_levels():
    levels, of = single(), torch.full((3,), 2, dtype=torch.int16)
    mask, _ = drawn(levels, at(4, 4, 4), of, torch.tensor([0.0, 0.4, 0.6]), camera_at(0, 0, 0), 3)
    assert mask.tolist() == [False, False, True]


def test_half_cell_moves_the_point_whose_distance_counts():
    """Nodes at the camera: half a cell of 4 / 2^L on each axis is 3.46 / 2^L away, so that L* is L - 0.8 of D = 2 and
    L - 0.2 of D = 3."""
    levels, of = single(origin=0.0, extent=4.0, base_layer=0), torch.arange(4, dtype=torch.int16)
    cases = {(False, 2.0): [True] * 4, (True, 2.0): [True, False, False, False], (True, 3.0): [True] * 4}
    for (half_cell, farthest), wanted in cases.items():
        shifted = replace(levels, half_cell=half_cell, farthest=farthest)
        assert drawn(shifted, at(0, 0, 0, 0), of, torch.zeros(4), camera_at(0, 0, 0), 3)[0].tolist() == wanted


def test_fading_levels():
    """Levels as map_to_int_level of Octree-GS has them."""
    ideal = torch.tensor([-2.0, 0.25, 1.7, 9.0])
    level, weight = whole_level(ideal, "progressive", 3)
    assert level.tolist() == [0, 1, 2, 3]
    assert weight.tolist() == pytest.approx([0.9999, 0.25, 0.7, 0.9999], abs=1e-6)


def test_only_the_finest_level_drawn_fades():
    levels = single(mode="progressive")
    distance = 8 / 2**0.7  # L* = 0.7: level 1 is drawn at 0.7
    of = torch.tensor([0, 1, 2], dtype=torch.int16)
    mask, weight = drawn(levels, at(*[distance] * 3), of, torch.zeros(3), camera_at(0, 0, 0), 3)
    assert mask.tolist() == [True, True, False]
    assert weight[:2].tolist() == pytest.approx([1.0, 0.7], abs=1e-5)


def test_fading_has_no_jumps():
    """The opacity a level adds is continuous in the distance, but for a ten-thousandth."""
    levels, steps = single(mode="progressive"), 4000
    places = at(*[16 * 0.999**i for i in range(steps)])
    for level in range(4):
        of = torch.full((steps,), level, dtype=torch.int16)
        mask, weight = drawn(levels, places, of, torch.zeros(steps), camera_at(0, 0, 0), 3)
        assert float((mask * weight).diff().abs().max()) < 2e-3


def test_choice_of_levels_carries_no_gradient():
    places = spread(5).requires_grad_()
    of = torch.zeros(5, dtype=torch.int16)
    _, weight = drawn(single(mode="progressive"), places, of, torch.zeros(5), camera_at(0, 0, 0), 3)
    assert not weight.requires_grad


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("mode", MODES)
def test_units_do_not_matter(scale, mode):
    points, options = spread(200, size=3), replace(PUBLISHED, mode=mode, visible_threshold=-1.0)
    scaled_views = [replace(camera, translation=camera.translation * scale) for camera in cameras()]
    levels, scaled = derive(points, cameras(), options, 0), derive(points * scale, scaled_views, options, 0)
    assert (scaled.count, scaled.first, scaled.base_layer) == (levels.count, levels.first, levels.base_layer)
    assert (scaled.cell, scaled.farthest) == pytest.approx((levels.cell * scale, levels.farthest * scale))
    assert scaled.threshold == pytest.approx(levels.threshold)
    (positions, of, group), (found, found_of, found_group) = (
        initial_nodes(points, levels),
        initial_nodes(points * scale, scaled),
    )
    assert torch.allclose(found, positions * scale, rtol=1e-5, atol=1e-5 * scale)
    assert torch.equal(found_of, of)
    assert torch.equal(found_group, group)
    masks = [
        drawn(each, places, of, torch.zeros(len(of)), views[5], levels.count - 1)[0]
        for each, places, views in ((levels, positions, cameras()), (scaled, found, scaled_views))
    ]
    assert torch.equal(*masks)
    assert 0 < int(masks[0].sum()) < len(of)


# -- schedules -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "switches"),
    [
        (1, ()),
        (2, ()),
        (3, (10000,)),
        (4, (10000,)),
        (5, (6000, 10000)),
        (6, (6000, 10000)),
        (7, (4737, 7895, 10000)),
        (8, (4737, 7895, 10000)),
        (9, (4154, 6923, 8769, 10000)),
        (10, (4154, 6923, 8769, 10000)),
    ],
)
def test_switch_points(count, switches):
    """The switch points of set_coarse_interval (Octree-GS); K = 3 starts with level 1 of 0..2."""
    levels = derive(spread(9), cameras(), replace(PUBLISHED, count=count), 10000)
    assert (levels.first, levels.switches) == (min(count // 2, count - 1), switches)
    assert unlocked(levels.switches, levels.first, 1) == levels.first
    assert unlocked(levels.switches, levels.first, 10001) == count - 1


def test_all_levels_at_once_need_no_switch():
    assert derive(spread(9), cameras(), replace(PUBLISHED, count=8, first=7), 10000).switches == ()
    levels = derive(spread(9), cameras(), replace(PUBLISHED, count=8, first=2), 0)
    assert [unlocked(levels.switches, levels.first, step) for step in (0, 1, 100)] == [7, 7, 7]


def test_the_first_level_is_one_there_is():
    levels = derive(spread(9), cameras(), replace(PUBLISHED, count=3, first=7), 10000)
    assert (levels.first, levels.switches) == (2, ())


def test_equal_intervals():
    assert switch_points(5, 0, 1000, 1.0) == (250, 500, 750, 1000)


def test_a_level_joins_after_its_switch_point():
    assert [unlocked((6000, 10000), 2, step) for step in (1, 6000, 6001, 10000, 10001)] == [2, 2, 3, 3, 4]


def test_thresholds_of_levels():
    """Thresholds of anchor_growing (Octree-GS)."""
    wanted = [2.00e-4, 2.30e-4, 2.64e-4, 3.03e-4, 3.48e-4, 4.00e-4, 4.59e-4, 5.28e-4]
    assert thresholds(2e-4, 2, 0.2, 8) == pytest.approx(wanted, abs=0.5e-6)


# -- odd scenes ------------------------------------------------------------------------------------------------------

ODD = {
    "one point": (torch.tensor([[1.0, 2, 3]]), [camera_at(0, 0, 0)]),
    "one point of one coordinate": (torch.zeros(1, 3), [camera_at(4, 0, 0), camera_at(0, 2, 0)]),
    "all in one place": (torch.full((50, 3), 2.0), cameras()),
    "camera at a point": (torch.cat([torch.zeros(1, 3), spread(50)]), [camera_at(0, 0, 0)]),
    "camera at the only point": (torch.zeros(1, 3), [camera_at(0, 0, 0)]),
    "all distances alike": (torch.zeros(1, 3), [camera_at(3, 0, 0), camera_at(0, 0, 3)]),
    "tiny": (spread(80) * 1e-3, [camera_at(0.002, 0, 0), camera_at(0, 0.01, 0)]),
    "huge": (spread(80) * 1e4, [camera_at(2e4, 0, 0), camera_at(0, 1e5, 0)]),
    "far away": (spread(80) + 1e5, [camera_at(1e5, 1e5 + 3, 1e5)]),
}


@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("base_layer", [-1, 10])
@pytest.mark.parametrize("threshold", [-1.0, 0.0, 0.9])
@pytest.mark.parametrize("rule", ["reference", "sane"])
def test_odd_scenes_have_levels(name, base_layer, threshold, rule):
    points, views = ODD[name]
    options = replace(
        PUBLISHED, base_layer=base_layer, visible_threshold=threshold, extend_rule=rule, distance_quantile=1.0
    )
    levels = derive(points, views, options, 100)
    positions, of, group = initial_nodes(points, levels)
    assert 1 <= levels.count < 30
    assert 0 < levels.cell < math.inf
    assert len(positions) > 0
    assert bool(positions.isfinite().all())
    assert group.shape == (levels.count, len(points))
    mask, weight = drawn(levels, positions, of, torch.zeros(len(of)), views[0], levels.count - 1)
    assert bool(weight.isfinite().all())
    assert bool(mask[of == 0].all())
    json.dumps(facts_of(levels, of), allow_nan=False)
    assert any("fewer than 100" in warning for warning in warnings_of(levels, len(points)))


def test_one_distance_is_one_level():
    levels = derive(*ODD["all distances alike"], PUBLISHED, 0)
    assert (levels.count, levels.nearest, levels.farthest) == (1, 3, 3)
    assert levels.box == 3


def test_warnings_name_their_numbers():
    points, views = ODD["camera at a point"]
    levels = derive(points, views, replace(PUBLISHED, distance_quantile=1.0), 0)
    far, finest = f"{float(points.norm(dim=1).max()):.3g}", f"{levels.box / 2**30:.3g}"
    many, near, fine = (warning.split(":")[0] for warning in warnings_of(levels, 2000))
    assert many == f"28 levels are more than 12, for distances from 0 to {far}"
    assert near == f"the nearest points are 0 from a camera, the farthest {far}"
    assert fine.startswith(f"cells of the finest level, {finest}, are below the precision of positions")
    coincident = derive(*ODD["all in one place"], replace(PUBLISHED, count=2), 0)
    assert "all points are in one place: cells divide the farthest distance" in " ".join(warnings_of(coincident, 99))
    assert "99 primitives" in " ".join(warnings_of(coincident, 99))


def test_sound_scenes_have_no_warnings():
    levels = derive(spread(300), cameras(), PUBLISHED, 0)
    assert warnings_of(levels, 100) == warnings_of(levels, 5_000_000) == []
    assert "5000001 primitives" in warnings_of(levels, 5_000_001)[0]


def test_facts_count_primitives_of_every_level():
    levels = derive(spread(9), cameras(), replace(PUBLISHED, count=5), 10000)
    facts = facts_of(levels, torch.tensor([0, 3, 3, 1], dtype=torch.int16))
    assert facts["anchors"] == [1, 1, 0, 2, 0]
    assert facts["switch_points"] == [6000, 10000]
    assert facts["finest_voxel"] == pytest.approx(facts["voxel"] / 16)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mode", "nearest"),
        ("extend_rule", "none"),
        ("count", 0),
        ("distance_quantile", 0.5),
        ("visible_threshold", 1.0),
        ("visible_threshold", -0.5),
    ],
)
def test_options_are_checked(name, value):
    with pytest.raises(ValueError, match=rf"backbone\.levels\.{name} is .*{value}"):
        replace(PUBLISHED, **{name: value})


def test_levels_that_would_never_train_are_refused():
    checked_end(None, 30000)
    checked_end(replace(PUBLISHED, coarse_until=29999), 30000)
    with pytest.raises(ValueError, match=r"coarse_until is 30000, and the published run .* ends at 30000"):
        checked_end(replace(PUBLISHED, coarse_until=30000), 30000)


@pytest.mark.parametrize(("until", "iterations", "step"), [
    (10000, 30000, 10000), (29999, 100, 99), (10000, 1, 0), (0, 100, 0), (15000, 100, 50),
])  # fmt: skip
def test_all_levels_take_part_before_the_end(until, iterations, step):
    schedule = Schedule(iterations=iterations, published_iterations=30000, views=3)
    assert all_levels_from(replace(PUBLISHED, coarse_until=until), schedule) == step
