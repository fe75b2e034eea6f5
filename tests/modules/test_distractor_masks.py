"""Distractors in pictures of a plane whose truth is known: found where they are, and nowhere else."""

import pytest
import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.modules.distractor_masks import (
    ALIKE,
    BLOCK,
    LEAST,
    PLAIN,
    TIMES,
    Difference,
    Witnesses,
    colour_bins,
    difference_of,
    distractors_in,
    plain_parts,
    whole_of,
    with_plain_parts,
    with_their_colours,
    witnesses,
)
from gsx.modules.photo_pairs import gains, match_brightness

SIZE = 64, 48


def cameras(count: int = 6) -> list[Camera]:
    """On a line before the plane z = 0, which they see whole."""
    return [look_at([0.3 * i - 0.8, -1.0, 4], [0, 0, 0], fov_x=0.7, width=SIZE[0], height=SIZE[1])
            for i in range(count)]  # fmt: skip


def on_plane(camera: Camera) -> tuple[Tensor, Tensor]:
    """(world points of the plane at the pixels, camera z of them)."""
    y, x = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1).double()
    world, centre = rays @ camera.rotation.double(), camera.centre.double()
    depth = -centre[2] / world[..., 2]
    return centre + depth[..., None] * world, depth.float()


def shown(camera: Camera) -> tuple[Tensor, Tensor]:
    """(picture of the plane, depth)."""
    points, depth = on_plane(camera)
    grey = (0.5 + 0.2 * (4 * points[..., 0]).sin() * (3 * points[..., 1]).cos()).float()
    return torch.stack([grey, grey, grey]), depth


def seen(photographs: list[Tensor], counted: Tensor | None = None) -> list[Difference]:
    """Photographs against renders of the plane, which covers everything."""
    return [
        difference_of(camera, *shown(camera), torch.ones(48, 64), photograph, counted)
        for camera, photograph in zip(cameras(), photographs, strict=True)
    ]


def at_its_exposure(camera: Camera, image: Tensor, depth: Tensor, taken: Tensor) -> Difference:
    """A photograph against a render that is made as bright, and by how much that is."""
    bright, ratio = match_brightness(image, taken, None), gains(image, taken, None)
    return difference_of(camera, bright, depth, torch.ones(48, 64), taken, gains=ratio)


def noisy(seed: int = 0, noise: float = 0.01) -> list[Tensor]:
    """What cameras photograph of the plane."""
    generator = torch.Generator().manual_seed(seed)
    pictures = [shown(camera)[0] for camera in cameras()]
    return [picture + noise * torch.randn(picture.shape, generator=generator) for picture in pictures]


def blocks(y: slice, x: slice) -> Tensor:
    """The blocks of some pixels."""
    marked = torch.zeros(48, 64, dtype=torch.bool)
    marked[y, x] = True
    return marked[::BLOCK, ::BLOCK]


def test_what_stands_in_one_photograph_is_found_there_alone() -> None:
    photographs = noisy()
    photographs[2][:, 12:24, 20:40] = torch.tensor([0.9, 0.1, 0.4])[:, None, None]
    found = distractors_in(seen(photographs))
    assert torch.equal(found[2], blocks(slice(12, 24), slice(20, 40)))
    assert not any(bool(found[other].any()) for other in (0, 1, 3, 4, 5))


def test_what_all_photographs_show_is_an_error_of_the_model() -> None:
    """A disc on the plane that the model has not learnt."""
    photographs = noisy()
    for camera, photograph in zip(cameras(), photographs, strict=True):
        photograph[:, on_plane(camera)[0][..., :2].norm(dim=-1) < 0.4] += 0.4
    assert not any(bool(marked.any()) for marked in distractors_in(seen(photographs)))


def test_what_the_model_has_learnt_of_it_in_other_views_does_not_hide_it() -> None:
    """A model that shows something of one photograph to all cameras is wrong everywhere there; the others agree."""
    photographs, pictures = noisy(), []
    photographs[2][:, 12:24, 20:40] = torch.tensor([0.9, 0.1, 0.4])[:, None, None]
    for camera, photograph in zip(cameras(), photographs, strict=True):
        image, depth = shown(camera)
        image[:, on_plane(camera)[0][..., :2].norm(dim=-1) < 0.9] = torch.tensor([0.7, 0.3, 0.45])[:, None]
        pictures.append(difference_of(camera, image, depth, torch.ones(48, 64), photograph))
    assert all(float((one.size > LEAST).float().mean()) > 0.1 for one in pictures), "wrong in every view"
    found = distractors_in(pictures)
    assert bool(found[2][blocks(slice(12, 24), slice(20, 40))].all())
    assert not any(bool(found[other].any()) for other in (0, 1, 3, 4, 5))


@pytest.mark.parametrize("greys", [(0.2, 0.8, 0.35, 0.65, 0.05, 0.95), (0.95, 0.2, 0.6), (0.2, 0.5, 0.8)])
def test_what_looks_different_from_everywhere_is_not_alone(greys: tuple[float, ...]) -> None:
    """In the middle of a disc that shines: each photograph shows it in a grey of its own, the model in half of white.
    Its rim lies beside the plane, on which others agree."""
    pictures, inside = [], []
    for camera, photograph, grey in zip(cameras(), noisy(), greys, strict=False):
        away, (image, depth) = on_plane(camera)[0][..., :2].norm(dim=-1), shown(camera)
        photograph[:, away < 0.4], image[:, away < 0.4] = grey, 0.5 + 1e-3
        pictures.append(difference_of(camera, image, depth, torch.ones(48, 64), photograph))
        inside.append((away < 0.2)[::BLOCK, ::BLOCK])
    for number, (own, middle) in enumerate(zip(pictures, inside, strict=True)):
        others = pictures[:number] + pictures[number + 1 :]
        assert not bool(witnesses(own, others).alone(own.evened_size)[middle].any())


def told_of(apart: list[list[float]], off_middle: list[list[float]], unseen: list[tuple[int, int]]) -> Witnesses:
    """Of blocks in a row: a list for each block, of values for each witness; (block, witness) that do not see it."""
    sees = torch.ones(len(apart[0]), 1, len(apart), dtype=torch.bool)
    for block, witness in unseen:
        sees[witness, 0, block] = False
    return Witnesses(sees=sees, apart=torch.tensor(apart).T[:, None], off_middle=torch.tensor(off_middle).T[:, None])


def test_who_is_alone_by_what_others_tell_of_a_place() -> None:
    """Blocks that differ by 0.3, of four witnesses: alone; two show the same; two disagree with the middle; one of
    these is not asked, since it sees nothing; one alone sees it."""
    agreed, parted = [0.1, 0.0, 0.1, 0.1], [0.1, 0.0, 0.2, 0.2]
    apart = [[0.4, 0.4, 0.4, 0.1], [0.4, 0.4, 0.1, 0.1], [0.4] * 4, [0.4, 0.4, 0.1, 0.1], [0.4] * 4]
    unseen = [(3, 3), (4, 1), (4, 2), (4, 3)]
    told = told_of(apart, [agreed, agreed, parted, [0.1, 0.0, 0.1, 0.9], agreed], unseen)
    assert told.alone(torch.full((1, 5), 0.3)).tolist() == [[True, False, False, True, False]]
    assert told.disputed(torch.full((1, 5), 0.15)).tolist() == [[False, False, True, False, False]]


def test_what_others_dispute_stays_beside_a_distractor() -> None:
    """To the right of it, each photograph shows a grey of its own, and the model is wrong for that camera alone."""
    pictures, greys, edge = [], (0.2, 0.8, 0.5, 0.65, 0.05, 0.95), on_plane(cameras()[2])[0][24, 32, 0]
    for number, (camera, photograph, grey) in enumerate(zip(cameras(), noisy(), greys, strict=True)):
        (image, depth), shines = shown(camera), on_plane(camera)[0][..., 0] > edge
        photograph[:, shines] = image[:, shines] = grey
        if number == 2:
            image[:, shines] += 0.75 * LEAST
            photograph[:, 16:32, 16:32] = torch.tensor([0.9, 0.1, 0.4])[:, None, None]
        pictures.append(difference_of(camera, image, depth, torch.ones(48, 64), photograph))
    found = distractors_in(pictures)[2]
    assert float(found[blocks(slice(16, 32), slice(16, 30))].float().mean()) > 0.9
    assert not bool(found[:, 18:].any())


def test_what_half_of_those_show_who_see_it_is_confirmed() -> None:
    """By two of four; by one of four; by one of two who see it; by the only one who sees it; by nobody."""
    same, other = ALIKE - 0.005, ALIKE + 0.005
    apart = [[same, same, other, other], [same, other, other, other], [same, other, same, same], [same] * 4, [same] * 4]
    unseen = [(2, 2), (2, 3), (3, 1), (3, 2), (3, 3), *((4, witness) for witness in range(4))]
    told = told_of(apart, [[0.0] * 4] * 5, unseen)
    assert told.confirmed.tolist() == [[True, False, True, False, False]]


@pytest.mark.parametrize(("light", "gain"), [(1.0, 0.4), (0.3, 1.9), (0.3, 2.5)])
def test_what_others_agree_on_is_compared_at_one_exposure(light: float, gain: float) -> None:
    """A scene, and a photograph of it at another exposure in which something stands."""
    pictures = []
    for number, (camera, photograph) in enumerate(zip(cameras(), noisy(noise=0.0), strict=True)):
        (image, depth), taken = shown(camera), light * photograph
        if number == 2:
            taken[:, 12:24, 20:40] = light * torch.tensor([0.9, 0.1, 0.4])[:, None, None]
            taken = gain * taken
        pictures.append(at_its_exposure(camera, light * image, depth, taken))
    found = distractors_in(pictures)
    assert bool(found[2][blocks(slice(12, 24), slice(20, 40))].all())
    assert not any(bool(found[other].any()) for other in (0, 1, 3, 4, 5))


def test_who_stands_behind_something_does_not_see_a_place() -> None:
    """Four of five others look at a wall before the plane: what they show of it says nothing of the plane."""
    photographs, pictures = noisy(), []
    photographs[2][:, 12:24, 20:40] = torch.tensor([0.9, 0.1, 0.4])[:, None, None]
    for number, (camera, photograph) in enumerate(zip(cameras(), photographs, strict=True)):
        (image, depth), behind = shown(camera), number in (0, 1, 3, 4)
        picture = torch.full_like(image, 0.2) if behind else image
        taken = torch.full_like(image, 0.2) if behind else photograph
        pictures.append(difference_of(camera, picture, depth / 2 if behind else depth, torch.ones(48, 64), taken))
    assert not any(bool(marked.any()) for marked in distractors_in(pictures))


@pytest.mark.parametrize("gain", [1.0, 0.7])
def test_what_others_show_as_well_stays_beside_a_distractor(gain: float) -> None:
    """Around what stands in one photograph, taken at another exposure, the model is wrong for that camera alone, by
    three quarters of what stands out; the plane is there in all photographs."""
    pictures = []
    around = torch.zeros(48, 64, dtype=torch.bool)
    around[8:28, 16:44], around[12:24, 20:40] = True, False
    for number, (camera, photograph) in enumerate(zip(cameras(), noisy(), strict=True)):
        (image, depth), taken = shown(camera), photograph
        if number == 2:
            taken = photograph * gain
            taken[:, 12:24, 20:40] = torch.tensor([0.9, 0.1, 0.4])[:, None, None]
            image[:, around] += 0.75 * LEAST / gain
        pictures.append(at_its_exposure(camera, image, depth, taken))
    assert torch.equal(distractors_in(pictures)[2], blocks(slice(12, 24), slice(20, 40)))


def test_one_photograph_or_two_tell_nothing() -> None:
    photographs = noisy()
    photographs[1][:, 12:24, 20:40] = 0.95
    for some in (seen(photographs)[1:2], seen(photographs)[:2]):
        assert [int(marked.sum()) for marked in distractors_in(some)] == [0] * len(some)
    assert distractors_in([]) == []


def test_what_nobody_else_sees_is_not_judged() -> None:
    photographs = noisy()
    photographs[2][:, 12:24, 20:40] = 0.95
    counted = torch.zeros(48, 64, dtype=torch.bool)
    counted[:, :3] = True  # of all other photographs next to nothing counts
    pictures = [
        difference_of(camera, *shown(camera), torch.ones(48, 64), photograph, None if number == 2 else counted)
        for number, (camera, photograph) in enumerate(zip(cameras(), photographs, strict=True))
    ]
    assert not any(bool(marked.any()) for marked in distractors_in(pictures))


def test_before_an_empty_background_directions_tell() -> None:
    """Turned cameras see a part of the same sky; none of them sees anything but it."""
    turned = [look_at([0.1 * i, 0, 0], [0.1 * i + 0.1 * i, 5, 0], fov_x=0.7, width=SIZE[0], height=SIZE[1])
              for i in range(5)]  # fmt: skip
    photographs = [torch.full((3, 48, 64), 0.6) for _ in turned]
    photographs[2][:, 12:24, 20:40] = 0.1
    empty = torch.zeros(48, 64)
    pictures = [
        difference_of(camera, torch.full((3, 48, 64), 0.6), empty, empty, photograph)
        for camera, photograph in zip(turned, photographs, strict=True)
    ]
    found = distractors_in(pictures)
    assert torch.equal(found[2], blocks(slice(12, 24), slice(20, 40)))
    assert sum(int(marked.sum()) for marked in found) == int(found[2].sum())


@pytest.mark.parametrize("gain", [0.7, 1.5])
def test_another_exposure_is_no_distractor_and_hides_none(gain: float) -> None:
    """Saturated where that is bright; something dark stands in it."""
    pictures = []
    for number, (camera, photograph) in enumerate(zip(cameras(), noisy(), strict=True)):
        taken = (photograph * gain).clamp(0, 1) if number == 2 else photograph
        if number == 2:
            taken[:, 12:24, 20:40] = 0.05
        image, depth = shown(camera)
        pictures.append(at_its_exposure(camera, image, depth, taken))
    found = distractors_in(pictures)
    assert torch.equal(found[2], blocks(slice(12, 24), slice(20, 40)))
    assert not any(bool(found[other].any()) for other in (0, 1, 3, 4, 5))


def test_what_masks_leave_out_says_nothing_of_the_rest() -> None:
    """Most of the picture is masked, and differs."""
    photographs = noisy()
    counted = torch.zeros(48, 64, dtype=torch.bool)
    counted[:, :24] = True
    for photograph in photographs:
        photograph[:, ~counted] = 0.0
    photographs[2][:, 12:24, 4:20] = 0.95
    found = distractors_in(seen(photographs, counted))
    assert torch.equal(found[2], blocks(slice(12, 24), slice(4, 20)))
    assert sum(int(marked.sum()) for marked in found) == int(found[2].sum())


@pytest.mark.parametrize(("noise", "step", "found"), [(0.0, 0.8, False), (0.0, 1.2, True), (0.3, 1.2, False)])
def test_how_much_stands_out(noise: float, step: float, found: bool) -> None:
    """Of the least difference where there is no noise; with noise it has to be so many times the usual."""
    assert TIMES * 0.3 * 0.67 / BLOCK > 1.2 * LEAST
    photographs = noisy(noise=noise)
    photographs[2][:, 12:24, 20:40] += step * LEAST * torch.tensor([1, 0, -1])[:, None, None]  # no grey beside is that
    marked = distractors_in(seen(photographs))
    assert bool(marked[2][blocks(slice(12, 24), slice(20, 40))].float().mean() > 0.5) == found


def test_masked_pixels_are_no_distractor() -> None:
    photographs = noisy()
    photographs[2][:, 12:24, 20:40] = 0.95
    counted = ~blocks(slice(12, 24), slice(20, 40)).repeat_interleave(BLOCK, 0).repeat_interleave(BLOCK, 1)
    assert not bool(distractors_in(seen(photographs, counted))[2].any())


def test_single_blocks_go_and_weak_neighbours_come() -> None:
    """A lone block is noise; three in a row take the weak ones beside them in three rounds."""
    marked, weak = torch.zeros(8, 12, dtype=torch.bool), torch.zeros(8, 12, dtype=torch.bool)
    marked[1, 1] = marked[4, 3:6] = weak[4, 3:] = True
    weak[4, 10] = False
    expected = torch.zeros(8, 12, dtype=torch.bool)
    expected[4, 4:8] = expected[4, 3] = True
    assert torch.equal(whole_of(marked, weak), expected)


def flooded(colours: Tensor, start: tuple[int, int]) -> set[tuple[int, int]]:
    """Blocks that are reached from one over steps between colours that differ little."""
    reached, edge = {start}, [start]
    while edge:
        y, x = edge.pop()
        for other in ((y + 1, x), (y - 1, x), (y, x + 1), (y, x - 1)):
            inside = 0 <= other[0] < colours.shape[1] and 0 <= other[1] < colours.shape[2]
            if inside and other not in reached and (colours[:, *other] - colours[:, y, x]).abs().max() < PLAIN:
                reached.add(other)
                edge.append(other)
    return reached


@pytest.mark.parametrize("seed", range(3))
def test_plain_parts_are_those_that_a_flood_fills(seed: int) -> None:
    """Of pictures of few colours, whose parts wind."""
    generator = torch.Generator().manual_seed(seed)
    colours = torch.randint(0, 2, (1, 14, 19), generator=generator).float().expand(3, -1, -1) * 0.5
    colours = colours + 0.1 * PLAIN * torch.rand(3, 14, 19, generator=generator)
    parts = plain_parts(colours)
    for y in range(14):
        for x in range(19):
            alike = {tuple(place) for place in (parts == parts[y, x]).nonzero().tolist()}
            assert alike == flooded(colours, (y, x))


def test_a_thing_goes_as_a_whole_where_enough_of_it_is_marked() -> None:
    """A plain coat of 40 blocks before a patterned wall; blocks of the wall are parts of their own."""
    colours = torch.rand(3, 12, 10, generator=torch.Generator().manual_seed(0))
    colours[:, 2:10, 3:8] = torch.tensor([0.8, 0.1, 0.1])[:, None, None]
    parts, few, enough = plain_parts(colours), torch.zeros(12, 10, dtype=torch.bool), torch.zeros(12, 10).bool()
    few[2:4, 3:8] = True
    enough[2:5, 3:8] = True
    enough[0, 0] = True
    assert torch.equal(with_plain_parts(few, parts), few)
    expected = enough.clone()
    expected[2:10, 3:8] = True
    assert torch.equal(with_plain_parts(enough, parts), expected)


def test_what_the_model_has_learnt_of_a_plain_thing_is_found_with_the_rest() -> None:
    """Half of it is in the render already, and differs nowhere."""
    photographs = [shown(camera)[0] for camera in cameras()]
    photographs[2] = photographs[2].clone()
    photographs[2][:, 10:30, 20:40] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]
    pictures = [shown(camera) for camera in cameras()]
    learnt = pictures[2][0].clone()
    learnt[:, 10:20, 20:40] = photographs[2][:, 10:20, 20:40]
    found = distractors_in([
        difference_of(camera, learnt if n == 2 else image, depth, torch.ones(48, 64), photograph)
        for n, (camera, (image, depth), photograph) in enumerate(zip(cameras(), pictures, photographs, strict=True))
    ])  # fmt: skip
    assert bool(found[2][5:15, 10:20].all())
    assert not any(bool(marked.any()) for n, marked in enumerate(found) if n != 2)


def test_colours_that_are_mostly_those_of_distractors_are_theirs_in_every_photograph() -> None:
    """Red is marked in the first; in the second it goes where most around it does, not where it stands alone. Half of
    the green is marked, which is not most."""
    blue, red, green = range(3)
    colours = [torch.full((6, 9), blue) for _ in range(2)]
    colours[0][1:5, :5] = colours[1][2:5, 1:4] = colours[1][1, 7] = red
    colours[0][1:4, 6:] = colours[1][3:, 6:] = green
    marked = [colours[0] != blue, torch.zeros(6, 9, dtype=torch.bool)]
    found = with_their_colours(marked, colours)
    assert torch.equal(found[0], marked[0])
    expected = torch.zeros(6, 9, dtype=torch.bool)
    expected[2:5, 2] = expected[3, 1:4] = True
    assert torch.equal(found[1], expected)


def test_bins_of_colours_are_their_own() -> None:
    colours = torch.stack([*torch.eye(3), torch.zeros(3), torch.tensor([0.0, 0.0, 0.05]), torch.ones(3)], 1)[:, None]
    counted = torch.ones(1, 6, dtype=torch.bool)
    assert len(set(colour_bins(colours, counted)[0].tolist())) == 6
    assert colour_bins(colours, counted)[0, -1] == 32**3 - 1
    assert colour_bins(colours, ~counted)[0].tolist() == [32**3] * 6


def test_blocks_that_do_not_count_tell_nothing_of_their_colour() -> None:
    """Photographs upright and across; what masks leave out is black, as is all that is marked."""
    black = [torch.zeros(3, 6, 4), torch.zeros(3, 4, 6)]
    counted = [torch.zeros(6, 4, dtype=torch.bool), torch.zeros(4, 6, dtype=torch.bool)]
    counted[0][:, :2], marked = True, [torch.zeros_like(one) for one in counted]
    marked[0][:4, :2] = True
    found = with_their_colours(marked, [colour_bins(*pair) for pair in zip(black, counted, strict=True)])
    assert bool(found[0][4, :2].any()), "most of the black that counts is marked"
    assert not bool(found[0][:, 2:].any())
    assert not bool(found[1].any())


def test_who_walks_on_in_the_same_clothes_is_told_by_them() -> None:
    """In three photographs they differ from the model; the fourth the model has learnt as it is."""
    pictures, photographs = [shown(camera) for camera in cameras()], []
    for number, (image, _) in enumerate(pictures):
        photographs.append(image.clone())
        if number < 4:
            left = 6 + 9 * number
            photographs[-1][:, 14:34, left : left + 8] = torch.tensor([0.8, 0.1, 0.1])[:, None, None]
    found = distractors_in([
        difference_of(camera, photograph if n == 3 else image, depth, torch.ones(48, 64), photograph)
        for n, (camera, (image, depth), photograph) in enumerate(zip(cameras(), pictures, photographs, strict=True))
    ])  # fmt: skip
    assert bool(found[3][8:16, 17:20].all())
    assert not bool(found[3][:, :15].any())
    assert not any(bool(marked.any()) for marked in found[4:])
