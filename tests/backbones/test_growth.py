"""Growing and pruning on clouds worked by hand and against loops in plain Python.

All lengths are powers of two and all positions their multiples, so that loops and tensors agree to the bit.
"""

import math
from dataclasses import replace

import pytest
import torch
from test_decoding import table_of
from test_heads import SMALL, heads_of
from torch.nn import Parameter

from gsx.backbones import growth
from gsx.backbones.anchor_options import CHOICES, GrowthOptions, Quirks, resolved
from gsx.backbones.decoding import Explicit, Neural
from gsx.backbones.density import room_under
from gsx.backbones.growth import (
    DepthGrowth,
    LevelGrowth,
    clamp_scales,
    eligible,
    fresh_statistics,
    nodes_of,
    observe,
    prune,
    reset_offsets,
)
from gsx.backbones.levels import Levels, Viewpoints, thresholds
from gsx.core.training.parameter_table import ParameterTable

PUBLISHED = GrowthOptions(
    observe_from=500, start=1500, stop=15000, every=100, success=0.8, gradient=2e-4, prune_opacity=0.005,
    largest_log_scale=0.05, depths=3, hierarchy=4, coarsest=16, update_ratio=0.2, bias_gradient=0.25, bias_step=0.01,
    overlap=False,
)  # fmt: skip
REFERENCE = resolved(Quirks(**dict.fromkeys(CHOICES, "")), "reference")
SEEN = 64.0
"""A power of two above the 40 sightings that make an offset eligible."""
ALL = 10**9


def cloud(
    anchors: list[list[float]],
    offsets: list[list[list[float]]],
    gradients: list[list[float]],
    *,
    seen: float = SEEN,
    levels: list[int] | None = None,
    explicit: bool = False,
) -> tuple[ParameterTable, Neural | Explicit]:
    """Anchors of unit reach with offsets in world units and mean gradients; the features are random."""
    count, k = len(anchors), len(offsets[0])
    representation = Explicit(1, -2.0) if explicit else Neural(heads_of(SMALL, offsets=k))
    rows = representation.rows(torch.zeros(count), torch.full((count, 3), 0.5))
    generator = torch.Generator().manual_seed(8)
    rows |= {name: torch.randn(rows[name].shape, generator=generator) for name in representation.pooled}
    rows["offsets"] = torch.tensor(offsets)
    columns, statistics = {"anchors": torch.tensor(anchors)}, fresh_statistics(count, k, "cpu")
    statistics["gradient_count"] = torch.full((count, k), seen)
    statistics["gradient_sum"] = torch.tensor(gradients) * seen
    if levels is not None:
        columns |= {"level": torch.tensor(levels, dtype=torch.int16), "bias": torch.zeros(count)}
    parameters = {name: Parameter(value) for name, value in rows.items()}
    return ParameterTable(parameters, columns, statistics), representation


def under(most: int, table: ParameterTable) -> int:
    """Room up to a table of that many anchors."""
    return room_under(most, len(table))


@pytest.fixture
def keep_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """No candidate is left out by chance."""
    monkeypatch.setattr(torch, "rand", lambda shape, generator=None: torch.full(shape, 0.999))


def deepen(
    table: ParameterTable, representation, *, voxel: float = 1.0, early: bool = True, most: int = ALL, **changes
) -> int:
    generator = torch.Generator().manual_seed(9)
    options = replace(PUBLISHED, **changes)
    return DepthGrowth(table, representation, options, 40.0, under(most, table), voxel).grow(early, generator)[0]


def grown(table: ParameterTable, before: int) -> list[tuple[float, ...]]:
    """Positions of the new anchors in the order of their rows."""
    return [tuple(place) for place in table["anchors"][before:].tolist()]


# -- by depth ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("keep_all")
def test_thresholds_and_cells_of_the_three_depths() -> None:
    """Each offset lies in a new cell of 16, 4 or 1 voxels and just misses or meets the threshold there."""
    for depth, (cell, tau) in enumerate(((16.0, 2e-4), (4.0, 4e-4), (1.0, 8e-4))):
        for gradient, wanted in ((tau * 0.999, []), (tau, [(cell, 0.0, 0.0)])):
            # not new in larger cells: less than half of the next larger one away from the anchor's own node
            table, neural = cloud([[0.0, 0, 0]], [[[cell, 0.0, 0.0]]], [[gradient]])
            deepen(table, neural, early=False)
            assert grown(table, 1) == wanted, depth
            if wanted:
                assert table["log_scales"][1].tolist() == pytest.approx([math.log(cell)] * 6)


@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize(("early", "wanted"), [(True, []), (False, [(4.0, 0.0, 0.0)])])
def test_nothing_at_the_first_depth_ends_the_call_in_the_reference(early: bool, wanted: list) -> None:
    """Unit check (g) and its sane counterpart."""
    table, neural = cloud([[0.0, 0, 0]], [[[4.0, 0.0, 0.0]]], [[5e-4]])
    assert deepen(table, neural, early=early) == len(wanted)
    assert grown(table, 1) == wanted


@pytest.mark.usefixtures("keep_all")
def test_growth_at_the_first_depth_opens_the_others() -> None:
    table, neural = cloud([[0.0, 0, 0]], [[[4.0, 0.0, 0.0], [0.0, 64.0, 0.0]]], [[5e-4, 3e-4]])
    deepen(table, neural)
    assert grown(table, 1) == [(0.0, 64.0, 0.0), (4.0, 0.0, 0.0)]


@pytest.mark.usefixtures("keep_all")
def test_a_coarsest_cell_of_four_voxels_has_two_depths(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []
    monkeypatch.setattr(growth, "nodes_of", lambda places, size: sizes.append(size) or nodes_of(places, size))
    table, neural = cloud([[0.0, 0, 0]], [[[4.0, 0.0, 0.0], [2.0, 0.25, 0.0]]], [[1.0, 1.0]])
    deepen(table, neural, early=False, coarsest=4)
    # 4 / 4 = 1 and 2 / 4 = 0.5, which rounds to the even 0; then 4 (taken) and 2 in cells of one voxel; never 0 voxels
    assert grown(table, 1) == [(4.0, 0.0, 0.0), (2.0, 0.0, 0.0)]
    assert set(sizes) == {4.0, 1.0}


@pytest.mark.usefixtures("keep_all")
def test_cells_that_hold_an_anchor_stay_as_they_are() -> None:
    """Taken before the call, taken by an earlier depth, and twice by two candidates."""
    anchors = [[0.0, 0, 0], [32.0, 0, 0]]
    offsets = [[[33.0, 0.0, 0.0], [0.0, 0.0, 48.0]], [[-32.0, 0.0, 49.0], [0.0, 0.0, 0.0]]]
    table, neural = cloud(anchors, offsets, [[1.0, 1.0], [1.0, 0.0]])
    deepen(table, neural, early=False)
    # depth 0: nodes (2,0,0) taken; (0,0,3) new, once. Depth 1: (8,0,0) and (0,0,12) taken. Depth 2: (33,..), (0,0,49)
    assert grown(table, 2) == [(0.0, 0.0, 48.0), (0.0, 0.0, 49.0), (33.0, 0.0, 0.0)]


@pytest.mark.usefixtures("keep_all")
def test_new_anchors_take_the_largest_features_of_all_candidates_in_the_cell() -> None:
    anchors, k = [[0.0, 0, 0], [160.0, 0, 0], [320.0, 0, 0]], 2
    target = [[64.0 - x, 64.0, dz] for x in (0, 160, 320) for dz in (0.0, 1.0)]
    offsets = [target[k * i : k * i + k] for i in range(3)]
    table, neural = cloud(anchors, offsets, [[1e-3, 1e-3], [3e-4, 3e-4], [1e-4, 1e-4]])
    features = table["features"].detach().clone()
    deepen(table, neural, depths=1)
    assert grown(table, 3) == [(64.0, 64.0, 0.0)]
    assert table["features"][3].tolist() == [max(features[0][c], features[1][c]) for c in range(8)], "not the third"
    assert not table["offsets"][3].any()
    for name in ("opacity_sum", "visits", "gradient_sum", "gradient_count"):
        assert not table[name][3].any()
    assert torch.equal(table["features"][:3], features)


@pytest.mark.usefixtures("keep_all")
def test_only_offsets_seen_often_enough_grow() -> None:
    for seen, wanted in ((40.0, 0), (41.0, 1)):
        table, neural = cloud([[0.0, 0, 0]], [[[64.0, 0.0, 0.0]]], [[1.0]], seen=seen)
        assert deepen(table, neural, depths=1) == wanted


@pytest.mark.usefixtures("keep_all")
def test_reach_scales_offsets_by_the_first_three_lengths() -> None:
    table, neural = cloud([[0.0, 0, 0]], [[[1.0, 1.0, 1.0]]], [[1.0]])
    with torch.no_grad():
        table["log_scales"].copy_(torch.tensor([[64.0, 32, 16, 1e3, 1e3, 1e3]]).log())
    deepen(table, neural, depths=1)
    assert grown(table, 1) == [(64.0, 32.0, 16.0)]


def test_chances_are_a_half_three_quarters_and_seven_eighths() -> None:
    """One offset per depth that can grow there and nowhere else, by gradient or because its coarser cells are taken."""
    grid = torch.cartesian_prod(*[torch.arange(18.0) * 1600] * 3)
    count = len(grid)
    offsets = [[[20.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]]] * count
    table, neural = cloud(grid.tolist(), offsets, [[3e-4, 5e-4, 1e-3]] * count)
    deepen(table, neural, early=False)
    new = (table["anchors"][count:] - table["anchors"][count:].div(1600).round() * 1600).tolist()
    for place, chance in (([16.0, 0, 0], 0.5), ([0.0, 4, 0], 0.75), ([0.0, 0, 1], 0.875)):
        share = sum(found == place for found in new) / count
        assert abs(share - chance) < 4 * math.sqrt(chance * (1 - chance) / count), (place, share)


@pytest.mark.usefixtures("keep_all")
def test_no_anchor_is_added_beyond_the_cap_and_the_largest_gradients_come_first() -> None:
    offsets = [[[64.0 * (j + 1), 0.0, 0.0] for j in range(4)]]
    table, neural = cloud([[0.0, 0, 0]], offsets, [[3e-4, 9e-4, 5e-4, 7e-4]])
    features = table["features"].detach().clone()
    assert deepen(table, neural, depths=1, most=3) == 2
    assert grown(table, 1) == [(128.0, 0.0, 0.0), (256.0, 0.0, 0.0)]
    assert torch.equal(table["features"], features.expand(3, -1))
    assert deepen(table, neural, depths=1, most=3) == 0
    assert deepen(table, neural, depths=1, most=1) == 0


@pytest.mark.usefixtures("keep_all")
def test_no_pseudo_view_has_seen_a_new_anchor() -> None:
    """What pseudo views allowed of the filter's size is the older anchors'."""
    table, neural = cloud([[0.0, 0, 0]], [[[64.0, 0.0, 0.0]]], [[3e-4]])
    table.columns |= {"filter": torch.tensor([0.25]), "earned": torch.tensor([0.5])}
    assert deepen(table, neural) == 1
    assert table["earned"].tolist() == [0.5, math.inf]


@pytest.mark.usefixtures("keep_all")
def test_the_largest_gradients_come_first_whatever_their_cells() -> None:
    """Four are large, each in a new cell of one voxel only; eight small ones lie in new cells of all sizes."""
    anchors = [[1024.0 * i, 0, 0] for i in range(12)]
    offsets = [[[64.0, 0.0, 0.0]]] * 8 + [[[1.0, 0.0, 0.0]]] * 4
    gradients = [[3e-4 + 1e-6 * i] for i in range(8)] + [[5e-2]] * 4
    table, neural = cloud(anchors, offsets, gradients)
    assert deepen(table, neural, most=12 + 6) == 6
    large = [(1024.0 * i + 1, 0.0, 0.0) for i in range(8, 12)]
    assert grown(table, 12) == [(1024.0 * i + 64, 0.0, 0.0) for i in (6, 7)] + large
    assert len(table["gradient_sum"]) == 18


def node(place: list[float], size: float, origin: float = 0.0) -> tuple[int, ...]:
    """Python rounds halves to even."""
    return tuple(round((value - origin) / size) for value in place)


def by_depth_loop(table: ParameterTable, early: bool, sizes=(16.0, 4.0, 1.0), least: float = 40.0) -> list[tuple]:
    """(position, feature, size) of every new anchor, by brute force."""
    taken, new = [list(place) for place in table["anchors"].tolist()], []
    for depth, size in enumerate(sizes):
        if early and depth > 0 and not new:
            break
        cells: dict[tuple, list[int]] = {}
        for i, place in enumerate(table["anchors"].tolist()):
            for j, offset in enumerate(table["offsets"][i].tolist()):
                seen, total = float(table["gradient_count"][i, j]), float(table["gradient_sum"][i, j])
                if not seen > least or total / seen < 2e-4 * 2**depth:
                    continue
                cells.setdefault(node([a + b for a, b in zip(place, offset, strict=True)], size), []).append(i)
        held = {node(place, size) for place in taken}
        for cell in sorted(cells):
            if cell not in held:
                position = tuple(size * value for value in cell)
                new.append((position, table["features"][cells[cell]].amax(0).tolist(), size))
        taken += [list(position) for position, _, _ in new]
    return new


def random_cloud(seed: int, count: int = 30, k: int = 3, levels: int | None = None) -> tuple[ParameterTable, Neural]:
    """Positions and offsets in quarters, gradients over the range of thresholds, sightings around 40."""
    generator = torch.Generator().manual_seed(seed)
    anchors = torch.randint(-80, 80, (count, 3), generator=generator) / 4
    offsets = torch.randint(-60, 60, (count, k, 3), generator=generator) / 4
    gradients = torch.empty(count, k).uniform_(0, 1.2e-3, generator=generator)
    of = torch.randint(0, levels, (count,), generator=generator).tolist() if levels else None
    table, neural = cloud(anchors.tolist(), offsets.tolist(), gradients.tolist(), levels=of)
    table.statistics["gradient_count"] = torch.randint(30, 60, (count, k), generator=generator).float()
    table.statistics["gradient_sum"] = gradients * table["gradient_count"]
    return table, neural


@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize("seed", range(6))
def test_growth_by_depth_is_that_of_a_loop(seed: int) -> None:
    table, neural = random_cloud(seed)
    with torch.no_grad():
        wanted = by_depth_loop(table, early=True)
    assert deepen(table, neural) == len(wanted) > 0
    assert grown(table, 30) == [position for position, _, _ in wanted]
    assert table["features"][30:].tolist() == [feature for _, feature, _ in wanted]
    torch.testing.assert_close(table["log_scales"][30:, 5].exp(), torch.tensor([size for *_, size in wanted]))


# -- by level ----------------------------------------------------------------------------------------------------------


def three_levels(*, farthest: float = 1e9, threshold: float = 0.0, count: int = 3, origin: float = -8.0) -> Levels:
    """Cells of 4, 2, 1 units from -8 on; one camera at the origin, that draws everything unless `farthest` is less."""
    views = Viewpoints(centres=torch.zeros(1, 3), coarseness=torch.ones(1), focal=50.0)
    return Levels(
        count=count, fork=2, nearest=1.0, farthest=farthest, origin=origin, extent=16.0, base_layer=2, first=0,
        switches=(), threshold=threshold, mode="round", half_cell=False, zoom="finer", views=views,
    )  # fmt: skip


TAUS = (2.0e-4, 2.2974e-4, 2.639e-4, 3.0314e-4)


def level_up(
    table: ParameterTable,
    representation,
    levels: Levels | None = None,
    *,
    gate: bool = True,
    most: int = ALL,
    **changes,
) -> int:
    """`changes` are of quirks or of growth options."""
    quirks = replace(REFERENCE, **{name: value for name, value in changes.items() if name in CHOICES})
    options = replace(PUBLISHED, **{name: value for name, value in changes.items() if name not in CHOICES})
    levels = levels or three_levels()
    room, finest = under(most, table), levels.size(levels.count - 1)
    return LevelGrowth(table, representation, options, 40.0, room, finest, levels, quirks, gate).grow()[0]


def grown_levels(table: ParameterTable, before: int) -> list[tuple]:
    """(level, position) of the new anchors."""
    return list(zip(table["level"][before:].tolist(), grown(table, before), strict=True))


FAR = [[0.0, 0.0, 4.0], [0.0, 0.0, 6.0], [0.0, 0.0, 7.0]]
"""An anchor of each level, all out of the way."""


def one_offset(
    gradient: float, level: int, offset: list[float], levels=(0, 1, 2), **more
) -> tuple[ParameterTable, Neural]:
    """An anchor of `level` at the origin with one offset, and anchors of `levels` elsewhere."""
    others = [FAR[other] for other in levels]
    return cloud(
        [[0.0, 0.0, 0.0], *others],
        [[offset]] + [[[0.0, 0.0, 0.0]]] * len(others),
        [[gradient]] + [[0.0]] * len(others),
        levels=[level, *levels],
        **more,
    )


def test_thresholds_rise_by_a_fifth_of_an_octave_per_level() -> None:
    wanted = [2.00, 2.30, 2.64, 3.03, 3.48, 4.00, 4.59, 5.28]
    assert [round(1e4 * tau, 2) for tau in thresholds(2e-4, 2, 0.2, 8)] == wanted


@pytest.mark.parametrize(
    ("level", "gradient", "wanted"),
    [
        (0, 1.99e-4, []),
        (0, 2e-4, [(0, (4.0, 0.0, 0.0))]),  # 5 / 4 rounds to one cell
        (0, 2.29e-4, [(0, (4.0, 0.0, 0.0))]),
        (0, 2.30e-4, [(1, (4.0, 0.0, 0.0))]),  # (5 + 8) / 2 = 6.5 rounds to the even 6, and 6 * 2 - 8 = 4
        (1, 2.29e-4, []),
        (1, 2.30e-4, [(1, (4.0, 0.0, 0.0))]),
        (1, 2.63e-4, [(1, (4.0, 0.0, 0.0))]),
        (1, 2.65e-4, [(2, (5.0, 0.0, 0.0))]),
        (2, 2.63e-4, []),
        (2, 2.65e-4, [(2, (5.0, 0.0, 0.0))]),
        (2, 3.02e-4, [(2, (5.0, 0.0, 0.0))]),
        (2, 3.04e-4, []),  # beyond the last threshold nothing grows
    ],
)
def test_gradients_decide_between_the_level_and_the_next(level: int, gradient: float, wanted: list) -> None:
    table, neural = one_offset(gradient, level, [5.0, 0.0, 0.0])
    level_up(table, neural)
    assert grown_levels(table, 4) == wanted
    for new, _ in wanted:
        assert table["log_scales"][4].tolist() == pytest.approx([math.log(4.0 / 2**new)] * 6)
    assert table["level"].dtype == torch.int16


def test_the_finest_level_can_be_without_an_upper_bound() -> None:
    for gradient in (2.65e-4, 1.0):
        table, neural = one_offset(gradient, 2, [5.0, 0.0, 0.0])
        level_up(table, neural, finest="open")
        assert grown_levels(table, 4) == [(2, (5.0, 0.0, 0.0))]


def test_coarser_levels_stay_bounded_when_the_finest_is_open() -> None:
    table, neural = one_offset(1.0, 0, [5.0, 0.0, 0.0])
    level_up(table, neural, finest="open", gate=False)
    assert grown_levels(table, 4) == []


@pytest.mark.parametrize("gate", [True, False])
def test_the_gate_holds_promotion_and_bias_back_but_not_growth_on_the_level(gate: bool) -> None:
    table, neural = one_offset(1.0, 0, [5.0, 0.0, 0.0])
    level_up(table, neural, gate=gate)
    assert len(grown_levels(table, 4)) == gate
    assert bool(table["bias"].any()) == gate
    table, neural = one_offset(2.1e-4, 0, [5.0, 0.0, 0.0])
    level_up(table, neural, gate=gate)
    assert len(grown_levels(table, 4)) == 1


def test_only_anchors_of_the_same_level_hold_a_cell() -> None:
    """At (4, 0, 0) an anchor of another level is no hindrance, one of the same level is."""
    for other, wanted in ((0, []), (1, [(0, (4.0, 0.0, 0.0))]), (2, [(0, (4.0, 0.0, 0.0))])):
        table, neural = cloud(
            [[0.0, 0, 0], [4.0, 0, 0]], [[[5.0, 0.0, 0.0]], [[0.0] * 3]], [[2.1e-4], [0.0]], levels=[0, other]
        )
        level_up(table, neural)
        assert grown_levels(table, 2) == wanted, other


@pytest.mark.parametrize(("duplicates", "held_by", "grows"), [
    ("next", 1, False), ("next", 0, True), ("own", 1, True), ("own", 0, False),
])  # fmt: skip
def test_promotion_looks_at_the_next_level_or_like_the_published_tables_at_its_own(
    duplicates: str, held_by: int, grows: bool
) -> None:
    anchors = [[0.0, 0, 0], [4.0, 0, 0], [0.0, 0, 6.0]]
    table, neural = cloud(
        anchors, [[[4.0, 0.0, 0.0]]] + [[[0.0] * 3]] * 2, [[1.0], [0.0], [0.0]], levels=[0, held_by, 1]
    )
    level_up(table, neural, duplicates=duplicates)
    assert grown_levels(table, 3) == ([(1, (4.0, 0.0, 0.0))] if grows else [])


@pytest.mark.parametrize(
    ("promoted", "overlap", "inherits"), [("zeros", False, False), ("max", False, True), ("zeros", True, True)]
)
def test_features_of_promoted_anchors(promoted: str, overlap: bool, inherits: bool) -> None:
    table, neural = cloud(
        [[0.0, 0, 0], [0.0, 4, 0], [0.0, 0, 6]],
        [[[5.0, 0.0, 0.0]], [[5.0, -4.0, 0.0]], [[0.0] * 3]],
        [[1.0], [1.0], [0.0]],
        levels=[0, 0, 1],
    )
    level_up(table, neural, promoted=promoted, overlap=overlap)
    assert grown_levels(table, 3) == [(1, (4.0, 0.0, 0.0))]
    wanted = table["features"][:2].amax(0) if inherits else torch.zeros(8)
    assert torch.equal(table["features"][3], wanted)


def test_features_on_the_same_level_are_the_largest_of_the_parents() -> None:
    table, neural = one_offset(2.1e-4, 0, [5.0, 0.0, 0.0])
    level_up(table, neural, promoted="zeros")
    assert torch.equal(table["features"][4], table["features"][0])


def test_an_emptied_level_is_refilled_only_with_overlap() -> None:
    for overlap in (False, True):
        table, neural = one_offset(1.0, 0, [5.0, 0.0, 0.0], levels=(0, 2))
        level_up(table, neural, overlap=overlap)
        assert grown_levels(table, 3) == ([(1, (4.0, 0.0, 0.0))] if overlap else [])


def test_overlap_stacks_anchors_in_one_cell_once_per_call() -> None:
    table, gaussians = cloud(
        [[0.0, 0, 0], [4.0, 0, 0]], [[[5.0, 0.0, 0.0]], [[0.0] * 3]], [[2.1e-4], [2.1e-4]], levels=[0, 0], explicit=True
    )
    assert level_up(table, gaussians, overlap=True) == 1
    assert grown_levels(table, 2) == [(0, (4.0, 0.0, 0.0))]
    for name in ("sh_dc", "sh_rest"):
        assert torch.equal(table[name][2], table[name][:2].amax(0))
    assert table["opacity_logits"][2].item() == -2.0
    assert table["quats"][2].tolist() == [1, 0, 0, 0]


def test_new_anchors_that_too_few_cameras_draw_are_left_out() -> None:
    """D = 8: level 1 is drawn up to 8 / sqrt(2) = 5.66 units away."""
    for x, wanted in ((4.0, [(1, (4.0, 0.0, 0.0))]), (6.0, [])):
        table, neural = one_offset(2.4e-4, 1, [x, 0.0, 0.0])
        level_up(table, neural, three_levels(farthest=8.0))
        assert grown_levels(table, 4) == wanted
    table, neural = one_offset(2.1e-4, 0, [1000.0, 0.0, 0.0])
    level_up(table, neural, three_levels(farthest=8.0))
    assert len(grown_levels(table, 4)) == 1, "level 0 is drawn from everywhere"
    assert len(table["features"]) == 5


def test_new_anchors_are_no_candidates_in_the_same_call() -> None:
    """One promoted to level 1 would, with its parents' statistics, go on to level 2."""
    table, neural = one_offset(1.0, 0, [5.0, 0.0, 0.0])
    level_up(table, neural)
    assert [level for level, _ in grown_levels(table, 4)] == [1]
    assert not table["gradient_count"][4:].any()
    assert table["bias"][4].item() == 0


def bias_case() -> tuple[ParameterTable, Neural]:
    """Anchors of levels 0, 1, 2 with mean gradients above a quarter of tau_0, tau_1 and below that of tau_2."""
    anchors, gradients = [[0.0, 0, 0], [4.0, 4, 0], [8.0, 0, 4]], [[5.1e-5], [5.8e-5], [6.5e-5]]
    return cloud(anchors, [[[0.0] * 3]] * 3, gradients, levels=[0, 1, 2])


@pytest.mark.parametrize(
    ("bias", "wanted"),
    [
        # quarters of the thresholds: 5.0e-5, 5.74e-5, 6.6e-5; at each level all those above take a step
        ("all", [0.01, 0.02, 0.02]),
        ("own", [0.01, 0.01, 0.0]),
        ("level", [0.01, 0.01, 0.0]),
    ],
)
def test_bias_of_all_anchors_at_every_level_or_of_the_level_at_hand(bias: str, wanted: list[float]) -> None:
    table, neural = bias_case()
    level_up(table, neural, bias=bias)
    assert table["bias"].tolist() == pytest.approx(wanted)


def test_bias_is_capped_only_where_the_quirk_says_so() -> None:
    for bias, wanted in (("own", 1.0), ("level", 1.2), ("all", 1.2)):
        table, neural = bias_case()
        for _ in range(3):
            level_up(table, neural, bias=bias, bias_step=0.4)
        assert table["bias"][0].item() == pytest.approx(wanted)


def test_bias_looks_at_the_mean_over_eligible_offsets() -> None:
    """Two of three count: their mean is 6e-5 and 4.9e-5; a quarter of tau_0 is 5e-5."""
    for second, wanted in ((8e-5, 0.01), (5.8e-5, 0.0)):
        table, neural = cloud([[0.0, 0, 0]], [[[0.0] * 3] * 3], [[4e-5, second, 1.0]], levels=[0])
        table["gradient_count"][0, 2] = 40.0
        level_up(table, neural, three_levels(count=1))
        assert table["bias"].tolist() == pytest.approx([wanted])


def by_level_loop(table: ParameterTable, levels: int, inherit: bool) -> list[tuple]:
    """(level, position, feature) of every new anchor: gate open, next level's duplicates, nothing weeded."""
    taken = list(zip(table["level"].tolist(), table["anchors"].tolist(), strict=True))
    new = []
    for level in range(levels):
        for target, low, high in ((level, TAUS[level], TAUS[level + 1]), (level + 1, TAUS[level + 1], math.inf)):
            size, cells = 4.0 / 2**target, {}
            if target == levels or target not in {of for of, _ in taken}:
                continue
            for i, place in enumerate(table["anchors"].tolist()):
                for j, offset in enumerate(table["offsets"][i].tolist()):
                    seen, total = float(table["gradient_count"][i, j]), float(table["gradient_sum"][i, j])
                    if int(table["level"][i]) == level and seen > 40 and low <= total / seen < high:
                        mean = [a + b for a, b in zip(place, offset, strict=True)]
                        cells.setdefault(node(mean, size, -8.0), []).append(i)
            held = {node(place, size, -8.0) for of, place in taken if of == target}
            for cell in sorted(set(cells) - held):
                pooled = table["features"][cells[cell]].amax(0)
                feature = pooled if inherit or target == level else torch.zeros(8)
                new.append((target, tuple(size * value - 8.0 for value in cell), feature.tolist()))
                taken.append((target, list(new[-1][1])))
    return new


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("promoted", ["zeros", "max"])
def test_growth_by_level_is_that_of_a_loop(seed: int, promoted: str) -> None:
    table, neural = random_cloud(seed, levels=3)
    table.statistics["gradient_sum"] = table["gradient_sum"] * 0.4  # most between the thresholds of the levels
    with torch.no_grad():
        wanted = by_level_loop(table, 3, promoted == "max")
    assert level_up(table, neural, promoted=promoted) == len(wanted) > 0
    assert [(level, place) for level, place, _ in wanted] == grown_levels(table, 30)
    assert table["features"][30:].tolist() == [feature for *_, feature in wanted]


def test_the_largest_gradients_come_first_whatever_their_level() -> None:
    """All that would grow, and what of it stays where there is room for a third."""
    table, neural = random_cloud(0, levels=3)
    level_up(table, neural)
    everything = grown_levels(table, 30)
    table, neural = random_cloud(0, levels=3)
    strengths = []
    added = growth.Growth.add
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            growth.Growth, "add", lambda self, new: strengths.extend(new.strength.tolist()) or added(self, new)
        )
        assert level_up(table, neural, most=30 + len(everything) // 3) == len(everything) // 3
    least = sorted(strengths, reverse=True)[len(everything) // 3 - 1]
    assert len({level for level, _ in everything}) > 1
    wanted = [place for place, strength in zip(everything, strengths, strict=True) if strength >= least]
    assert grown_levels(table, 30) == wanted


def test_the_cap_holds_with_levels_too() -> None:
    table, neural = random_cloud(0, levels=3)
    assert level_up(table, neural, most=33) == 3
    assert len(table) == 33


NOWHERE = ([math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0], [0.0, -math.inf, 0.0], [1e30, 0.0, 0.0])


@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize(("levels", "gradient"), [(None, 1.6e-3), ([0], 2.1e-4)])
def test_offsets_without_a_place_grow_nothing(levels: list[int] | None, gradient: float) -> None:
    """Their cells have no number; the others grow as if these were not there."""
    offsets = [[4.0, 0.0, 0.0], [0.0, 40.0, 0.0]]
    wanted: list[tuple[float, ...]] = []
    for places in (offsets, [*offsets, *NOWHERE]):
        table, neural = cloud([[0.0, 0, 0]], [places], [[gradient] * len(places)], levels=levels)
        if levels is None:
            deepen(table, neural, early=False)
        else:
            level_up(table, neural)
        assert len(table) > 1
        wanted = wanted or grown(table, 1)
        assert grown(table, 1) == wanted


# -- statistics --------------------------------------------------------------------------------------------------------


def test_statistics_are_sums_over_pictures() -> None:
    """Visits of anchors, opacities summed over offsets, gradients of the Gaussians on screen: as a loop counts them,
    each picture by its weight, which gradients carry already."""
    table = table_of(6, 3, **fresh_statistics(6, 3, "cpu"))
    generator, wanted = torch.Generator().manual_seed(1), [[0.0] * 6, [0.0] * 6, [0.0] * 18, [0.0] * 18]
    for weight in (1.0, 1.0, 0.25, 1.0, 0.85):
        rows = torch.randperm(6, generator=generator)[:4]
        opacities = torch.rand(4, 3, generator=generator)
        slots = torch.tensor([row * 3 + j for row in rows.tolist() for j in range(3)])
        seen = (slots % 2).float()  # the others have no radius
        gradients = seen * torch.rand(len(slots), generator=generator)
        observe(table, rows, opacities, slots, gradients, weight * seen, torch.tensor([weight]))
        for i, row in enumerate(rows.tolist()):
            wanted[0][row] += weight
            wanted[1][row] += weight * sum(opacities[i].tolist())
        for slot, gradient in zip(slots.tolist(), gradients.tolist(), strict=True):
            wanted[2][slot] += gradient
            wanted[3][slot] += weight if slot % 2 else 0.0
    names = ("visits", "opacity_sum", "gradient_sum", "gradient_count")
    for name, values in zip(names, wanted, strict=True):
        torch.testing.assert_close(table[name].flatten(), torch.tensor(values))


def test_offsets_are_judged_after_more_than_forty_sightings() -> None:
    table, _ = cloud([[0.0, 0, 0]], [[[0.0] * 3] * 4], [[0.0] * 4])
    table.statistics["gradient_count"] = torch.tensor([[0.0, 40.0, 41.0, 64.0]])
    table.statistics["gradient_sum"] = torch.tensor([[0.0, 40.0, 41.0, 32.0]])
    enough, mean = eligible(table, 40.0)
    assert enough.tolist() == [[False, False, True, True]]
    assert mean.tolist() == [[0.0, 0.0, 1.0, 0.5]]
    reset_offsets(table, enough)
    assert table["gradient_sum"].tolist() == [[0.0, 40.0, 0.0, 0.0]]
    assert table["gradient_count"].tolist() == [[0.0, 40.0, 0.0, 0.0]]


def pruning_case(visits: list[float], sums: list[float]) -> ParameterTable:
    table, _ = cloud([[float(i), 0, 0] for i in range(len(visits))], [[[0.0] * 3]] * len(visits), [[0.0]] * len(visits))
    table.statistics |= {"visits": torch.tensor(visits), "opacity_sum": torch.tensor(sums)}
    return table


def test_pruning_by_hand() -> None:
    """Unit check (b): ten opacities of 0.001 make 0.01 a visit, which stays. Comparisons are strict on both sides."""
    table = pruning_case([100, 100, 80, 81, 81, 0], [100 * 10 * 0.001, 0.4, 0.0, 0.405, 0.404, 0.0])
    assert prune(table, PUBLISHED, 80.0) == 2
    assert table["anchors"][:, 0].tolist() == [0.0, 2.0, 3.0, 5.0]
    assert table["visits"].tolist() == [0.0, 80.0, 0.0, 0.0]
    assert table["opacity_sum"].tolist() == [0.0, 0.0, 0.0, 0.0]


def test_anchors_not_yet_ready_keep_their_sums() -> None:
    table = pruning_case([80, 81, 10], [7.0, 8.0, 9.0])
    assert prune(table, PUBLISHED, 80.0) == 0
    assert table["visits"].tolist() == [80.0, 0.0, 10.0]
    assert table["opacity_sum"].tolist() == [7.0, 0.0, 9.0]


def test_the_last_anchors_stay() -> None:
    table = pruning_case([100, 100], [0.0, 0.0])
    assert prune(table, PUBLISHED, 80.0) == 0
    assert len(table) == 2


def test_lengths_of_gaussians_alone_are_clamped() -> None:
    table, _ = cloud([[0.0, 0, 0]], [[[0.0] * 3]], [[0.0]])
    with torch.no_grad():
        table["log_scales"].copy_(torch.tensor([[1.0, 2.0, 3.0, 0.04, 0.05, 3.0]]))
    clamp_scales(table, 0.05)
    torch.testing.assert_close(table["log_scales"].detach(), torch.tensor([[1.0, 2.0, 3.0, 0.04, 0.05, 0.05]]))


# -- options -----------------------------------------------------------------------------------------------------------


def test_single_quirks_win_over_fidelity() -> None:
    blank = Quirks(**dict.fromkeys(CHOICES, ""))
    sane = resolved(replace(blank, gate="open"), "sane")
    assert vars(sane) == {
        "early_stop": "no", "clamp": "extent", "voxel": "distance", "gate": "open", "bias": "own", "finest": "open",
        "promoted": "max", "duplicates": "next",
    }  # fmt: skip
    assert vars(resolved(blank, "reference")) == {
        "early_stop": "yes", "clamp": "world", "voxel": "squared", "gate": "open", "bias": "all", "finest": "bounded",
        "promoted": "zeros", "duplicates": "next",
    }  # fmt: skip


def test_unknown_values_are_refused_by_name() -> None:
    blank = Quirks(**dict.fromkeys(CHOICES, ""))
    with pytest.raises(ValueError, match=r"backbone\.quirks\.bias is 'some'; choose all or own or level"):
        resolved(replace(blank, bias="some"), "sane")
    with pytest.raises(ValueError, match=r"backbone\.fidelity is 'best'; choose reference or sane"):
        resolved(blank, "best")
    with pytest.raises(ValueError, match=r"backbone\.growth\.success is 0.0; give a share above 0"):
        replace(PUBLISHED, success=0.0)


@pytest.mark.usefixtures("keep_all")
def test_adam_rows_follow_anchors() -> None:
    """New rows have zero moments, kept rows their own, and the step count goes on."""
    table, neural = random_cloud(1)
    for name in table.parameters:
        table.set_rate(name, 0.0)
        table[name].grad = torch.ones_like(table[name]).cumsum(0)
    table.optimiser.step()
    before = {name: dict(table.optimiser.state[table[name]]) for name in table.parameters}
    new = deepen(table, neural)
    table.statistics["visits"][:10] = 100.0
    assert prune(table, PUBLISHED, 80.0) == 10
    for name, old in before.items():
        state = table.optimiser.state[table[name]]
        assert float(state["step"]) == float(old["step"]) == 1
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(state[key][:20], old[key][10:])
            assert len(state[key]) == 20 + new == len(table[name])
            assert not state[key][20:].any()
        assert table[name].grad is None
        assert table.group(name)["params"] == [table.parameters[name]]
