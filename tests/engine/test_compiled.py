"""The compiled path draws what the float64 truth draws, forward and backward, by both schedules; it stays compiled."""

import os
import subprocess
import sys
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from compilations import new_code
from raster_scenes import (
    any_path,
    changed,
    errors_of,
    front_camera,
    leaves,
    random_splats,
    render_with_gradients,
    truth_of,
)
from torch import Tensor

from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import rasterize
from gsx.core.rasterizer.composite import composite_eager
from gsx.core.rasterizer.intersections import TileIntersections, intersect_tiles
from gsx.engine import compiled, lanes
from gsx.engine.backend import COMPILED
from gsx.engine.compile_cache import TRACING, file_of, recorded
from gsx.engine.compiled import Chunks, Rows, Stage, available, room_for_gradients
from gsx.engine.compiling import IN_VECTORS, OWN_INDICES, WHOLE_LOOPS
from gsx.engine.kernels import EXP_TOP, Rules, blend, compile_loop, compiled_loop, exp_polynomial, thresholds
from gsx.engine.lanes import Lanes
from gsx.engine.segments import parts

pytestmark = pytest.mark.skipif(not available(), reason="no working compiler on this machine")

QUICK = any_path(cull="tight", path="compiled", unrolled=2)
"""Two splats unrolled: the loops compile several times faster."""


def opaque(count: int, seed: int) -> Splats:
    """Large opaque splats: pixels and whole groups of tiles end early."""
    splats = random_splats(count, seed=seed, size=0.5)
    return changed(splats, log_opacities=splats.log_opacities / 30)


@pytest.mark.parametrize("schedule", ["chunks", "segments"])
@pytest.mark.parametrize("scene", ["mixed", "opaque", "single"])
def test_picture_and_gradient_are_those_of_the_truth(schedule: str, scene: str) -> None:
    splats = {"mixed": random_splats(300, seed=4), "opaque": opaque(400, 5), "single": random_splats(1, seed=1)}[scene]
    rules = replace(QUICK, schedule=schedule)
    errors = errors_of(splats, front_camera(), rules, truth_of(splats, front_camera(), rules))
    assert errors.largest <= 1e-5
    assert errors.gradient <= 1e-4


@pytest.mark.parametrize("size", [(40, 56), (64, 64)])
def test_small_batches_draw_the_truth(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    groups = list[int]()  # of each call; two at once would leave the last of three alone, and torch specialises on that

    def watched(loop: Callable[..., Any], rules: Rules) -> Callable[..., Any]:
        own = compiled_loop(loop, rules)
        return (lambda rows, *others: groups.append(len(rows)) or own(rows, *others)) if loop is blend else own

    monkeypatch.setattr("gsx.engine.compiled.compiled_loop", watched)
    rules, splats, camera = replace(QUICK, compiled_values=1), opaque(150, 5), front_camera(*size)
    errors = errors_of(splats, camera, rules, truth_of(splats, camera, rules))
    assert errors.largest <= 1e-5
    assert errors.gradient <= 1e-4
    assert set(groups) <= {2, 3}


@pytest.mark.parametrize(
    ("scene", "chunks", "values", "stop"),
    [("mixed", 3, 0, 1e-4), ("mixed", 3, 0, 0), ("mixed", 3, 1, 1e-4), ("opaque", 3, 0, 1e-4), ("opaque", 9, 1, 1e-4)],
)
def test_lists_in_pieces_draw_the_truth(
    scene: str, chunks: int, values: int, stop: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, own = list[Lanes](), compiled.lay_out

    def watched(*given: Any, **named: Any) -> Lanes:
        found.append(own(*given, **named))
        return found[-1]

    monkeypatch.setattr(compiled, "lay_out", watched)
    monkeypatch.setattr(lanes, "chunks_at_most", lambda lengths, chunk: chunks)
    splats = {"mixed": random_splats(300, seed=4), "opaque": opaque(400, 5)}[scene]
    rules, camera = replace(QUICK, compiled_values=values, transmittance_stop=stop), front_camera()
    errors = errors_of(splats, camera, rules, truth_of(splats, camera, rules))
    assert errors.largest <= 1e-5
    assert errors.gradient <= 1e-4
    assert len(found[-1].follows) > 4
    assert len(found[-1].active) == chunks  # of nine, groups leave after four
    with torch.no_grad():  # bits of a picture that nothing is learnt from do not depend on what is cut
        drawn = rasterize(splats, camera, rules, depth=True).image
        monkeypatch.undo()
        assert torch.equal(drawn, rasterize(splats, camera, rules, depth=True).image)


def test_lists_are_cut_where_a_few_are_much_longer() -> None:
    usual = torch.arange(1, 71)
    assert lanes.chunks_at_most(usual, 2) == 35  # 31 would do for all but an eighth
    assert lanes.chunks_at_most(torch.cat([usual, torch.tensor([0, 0, 93])]), 2) == 47  # half as many again
    assert lanes.chunks_at_most(torch.cat([usual, torch.tensor([0, 0, 97])]), 2) == 32
    assert lanes.chunks_at_most(torch.cat([usual, torch.tensor([0, 999])]), 2) == 63  # an eighth
    assert lanes.chunks_at_most(torch.tensor([0, 5]), 2) == 3


def test_the_shipped_number_of_unrolled_splats(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lanes, "chunks_at_most", lambda lengths, chunk: 2)
    rules = replace(QUICK, unrolled=any_path().unrolled, cull="published")
    splats = random_splats(300, seed=7)
    errors = errors_of(splats, front_camera(), rules, truth_of(splats, front_camera(), rules, depth=False), depth=False)
    assert errors.largest <= 1e-5
    assert errors.gradient <= 1e-4
    with recorded() as calls:
        render_with_gradients(splats, front_camera(), rules, depth=False)
    loops = {call[0].function.__name__: file_of(*call).read_bytes().count(b"#pragma omp for") for call in calls}
    assert loops["blend"] == 1
    assert loops["transmit"] <= 3  # a product, and twice its factor
    assert loops["gradients"] == 8  # slopes, two of sums, and five that lay columns out: more would talk through memory


def test_one_tile_size_after_another() -> None:
    for rules in (QUICK, replace(QUICK, tile_size=16, unrolled=1)):  # each compiles for any number of blocks
        for splats in (random_splats(250, seed=4), opaque(90, rules.tile_size), random_splats(200, seed=8)):
            errors = errors_of(splats, front_camera(), rules, truth_of(splats, front_camera(), rules))
            assert errors.largest <= 1e-5
            assert errors.gradient <= 1e-4


def test_float64_splats_are_drawn_in_float64() -> None:
    wide, rules = changed(random_splats(150, seed=9), dtype=torch.float64), replace(QUICK, unrolled=1)
    errors = errors_of(wide, front_camera(), rules, truth_of(wide, front_camera(), rules))
    assert errors.largest <= 1e-12
    assert errors.gradient <= 1e-10


def test_absolute_gradient_is_that_of_the_eager_path(monkeypatch: pytest.MonkeyPatch) -> None:
    def probe(path: str) -> torch.Tensor:
        rules = replace(QUICK, path=path)
        rendering = rasterize(leaves(random_splats(200, seed=3)), front_camera(), rules, absolute_gradient=True)
        weights = torch.randn(rendering.image.shape, generator=torch.Generator().manual_seed(0))
        (rendering.image * weights).sum().backward()
        assert rendering.screen.absgrad is not None
        assert rendering.screen.absgrad.grad is not None
        return rendering.screen.absgrad.grad

    eager, whole = probe("eager"), probe("compiled")
    assert eager.abs().sum() > 0
    assert (whole - eager).norm() <= 1e-5 * eager.norm()
    monkeypatch.setattr(lanes, "chunks_at_most", lambda lengths, chunk: 10)
    in_pieces = probe("compiled")
    assert (in_pieces - eager).norm() <= 1e-5 * eager.norm()
    assert not torch.equal(in_pieces, whole)


@pytest.mark.parametrize("left", [61, 50, 17])
def test_colours_do_not_depend_on_how_many_there_are(left: int) -> None:
    """Of 70 Gaussians and the first ones of them: other rows lie in the last, incomplete vector."""
    generator = torch.Generator().manual_seed(7)
    constant, rest, offsets, weights = (
        torch.randn(70, *sides, generator=generator) for sides in ((1, 3), (15, 3), (3,), (3,))
    )

    def learnt(count: int) -> list[torch.Tensor]:
        given = [value[:count].clone().requires_grad_() for value in (constant, rest, offsets)]
        colours = colours_of(*given, 3, COMPILED)
        (colours * weights[:count]).sum().backward()
        return [colours.detach(), *(value.grad for value in given)]

    assert all(torch.equal(few, all_[:left]) for few, all_ in zip(learnt(left), learnt(70), strict=True))


def test_the_compilers_options_are_those_it_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    every = torch._inductor.list_options()
    older = [name for name in every if name != "realize_cpu_opcount_threshold"]  # torch 2.11
    monkeypatch.setattr(torch._inductor, "list_options", lambda: older)
    assert thresholds() == ["realize_opcount_threshold"]
    assert set(WHOLE_LOOPS | IN_VECTORS | OWN_INDICES) <= set(older)
    assert all(hasattr(torch._dynamo.config, name) for name in TRACING)


def test_places_of_pairs_are_only_found_for_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("asked for")

    splats = random_splats(300, seed=4)
    wanted = rasterize(splats, front_camera(), QUICK, depth=True).image
    monkeypatch.setattr("gsx.engine.compiled.places_of", refuse)
    with torch.no_grad():
        torch.testing.assert_close(rasterize(splats, front_camera(), QUICK, depth=True).image, wanted)
    with pytest.raises(AssertionError, match="asked for"):
        rasterize(leaves(splats), front_camera(), QUICK, depth=True)


@pytest.mark.parametrize("schedule", ["chunks", "segments"])
def test_until_its_backward_pass_a_render_holds_no_lists_of_pairs(
    schedule: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lists = list[weakref.ref[Tensor]]()

    def watched(*arguments: Any) -> TileIntersections:
        found = intersect_tiles(*arguments)
        lists.extend(weakref.ref(table) for table in (found.splats, found.tiles, found.slots))
        return found

    monkeypatch.setattr("gsx.core.rasterizer.render.intersect_tiles", watched)
    splats = leaves(opaque(400, 5))
    image = rasterize(splats, front_camera(), replace(QUICK, schedule=schedule), depth=True).image
    assert len(lists) == 3
    assert all(table() is None for table in lists)
    image.sum().backward()
    assert splats.means.grad is not None


def test_room_for_gradients_is_zero_where_no_slice_was_blended() -> None:
    rows = torch.rand(9, 2, 12, 16)
    picked = torch.tensor([4, 6])
    stages = [Stage(range(7, 8), range(2), None), Stage(picked, picked, None), Stage(range(2, 4), range(2), None)]
    kept = Chunks(stages, Rows(rows), Rows(rows), Rows(rows), None)
    torch.use_deterministic_algorithms(True)  # what is not written is not a number
    try:
        found = room_for_gradients(kept, 9)
    finally:
        torch.use_deterministic_algorithms(False)
    assert found.shape == (9, 2, 16, 9)
    assert [bool((block == 0).all()) for block in found] == [True, True, False, False, True, True, True, False, True]


def test_a_crop_is_the_crop_of_the_picture() -> None:
    splats, camera = random_splats(300, seed=4), front_camera()
    with torch.no_grad():
        whole, part = (rasterize(splats, c, QUICK, depth=True).image for c in (camera, camera.crop(8, 16, 24, 16)))
    assert torch.equal(part, whole[:, 16:32, 8:32])


def test_two_runs_give_the_same_bits() -> None:
    (first, ones), (second, others) = (render_with_gradients(opaque(400, 5), front_camera(), QUICK) for _ in range(2))
    assert torch.equal(first.image, second.image)
    assert all(torch.equal(ones[name], others[name]) for name in ones)


def test_nothing_compiles_anew_in_steady_state() -> None:
    def draw(count: int, seed: int, schedule: str) -> None:
        for splats in (random_splats(count, seed=seed), opaque(count, seed)):
            render_with_gradients(splats, front_camera(), replace(QUICK, schedule=schedule))

    compile_loop.cache_clear()
    with new_code() as first:
        for schedule in ("chunks", "segments"):
            draw(400, 5, schedule)
    assert {"transmit", "blend", "gradients", "entry_slopes"} <= set(first)
    with new_code() as later:
        for count in (1, 40, 397, 1100):
            for schedule in ("chunks", "segments"):
                draw(count, count, schedule)
    assert later == []


@pytest.mark.parametrize("alpha_min", [0.05, 1 / 255, 1e-3, 1e-6, 1e-15, 1e-37])
def test_the_polynomial_is_exp_where_it_counts(alpha_min: float) -> None:
    least = float(torch.tensor(alpha_min).log())
    powers, squarings = exp_polynomial(least)
    x = torch.linspace(least, EXP_TOP, 10_000, dtype=torch.float64)
    value = sum(power * x**i for i, power in enumerate(powers)) ** (2**squarings)
    assert (value / x.exp() - 1).abs().max() < (3e-7 if alpha_min > 1e-30 else 6e-7)


def test_parts_cover_everything_and_none_is_single() -> None:
    for total, size in [(1, 4), (2, 4), (5, 4), (8, 4), (9, 4), (100, 7), (99, 7)]:
        slices = parts(total, size)
        assert [i for part in slices for i in range(total)[part]] == list(range(total))
        assert total == 1 or all(part.stop - part.start > 1 for part in slices)


def test_what_goes_the_eager_way(monkeypatch: pytest.MonkeyPatch) -> None:
    blended = list[int]()

    def counted(screen: Any, channels: torch.Tensor, *more: Any) -> Any:
        blended.append(len(channels))
        return composite_eager(screen, channels, *more)

    monkeypatch.setattr("gsx.engine.compiled.composite_eager", counted)
    splats, wide = random_splats(40), random_splats(40, channels=9)
    eager = replace(QUICK, path="eager")
    for given, options in ((splats, {"max_weight": True}), (wide, {})):
        drawn, expected = (rasterize(given, front_camera(), rules, **options) for rules in (QUICK, eager))
        torch.testing.assert_close(drawn.image, expected.image, rtol=0, atol=1e-6)  # kernels before it round otherwise
    assert len(blended) == 2
    assert not torch.equal(
        rasterize(splats, front_camera(), QUICK).image, rasterize(splats, front_camera(), eager).image
    )
    assert len(blended) == 2
    assert (QUICK.path_on("cpu"), eager.path_on("cpu"), replace(QUICK, path="auto").path_on("cpu")) == (
        "compiled",
        "eager",
        "eager",
    )


BROKEN = """
import torch
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.engine.compile_ahead import warm_splats
from gsx.engine.compositors import COMPOSITORS
from gsx.experiments.runs.rasterizer_path import decide
from gsx.core.data.camera import look_at
import logging
logging.basicConfig(level=logging.INFO, format="%(message)s")
camera = look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=32, height=32)
splats = warm_splats(torch.device("cpu"))
rules = [RasterSettings(path=path, compositors=COMPOSITORS) for path in ("compiled", "compiled", "eager")]
pictures = [rasterize(splats, camera, each).image for each in rules]
assert torch.equal(pictures[0], pictures[2]) and torch.equal(pictures[1], pictures[2])
assert decide(RasterSettings(path="auto", compositors=COMPOSITORS), 10_000, torch.device("cpu")).path == "eager"
"""


def test_without_a_compiler_one_warning_and_the_eager_picture(tmp_path) -> None:
    wrong = {"CXX": str(tmp_path / "no-such-compiler"), "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", BROKEN], env=os.environ | wrong, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("nothing can be compiled here (InvalidCxxCompiler: ") == 1
    assert "rasterizer: eager path (no working compiler" in done.stderr
