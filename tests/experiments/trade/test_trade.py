"""The sweep over the rasterizer's knobs: figures, front and advice by hand; truths against the untiled reference."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.nn.functional import logsigmoid

from gsx.builtin import plugins
from gsx.core.data.camera import Camera, look_at
from gsx.core.errors import ConfigError, InputError
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.rasterizer import RasterSettings
from gsx.core.rasterizer.reference import render_reference
from gsx.experiments.reports.charts import Axis, Dot, scatter
from gsx.experiments.runs.rasterizer_path import Learnt
from gsx.experiments.trade.rasterizer.advice import advice_lines, front_of, most_exact, recommended, rounded_up, table
from gsx.experiments.trade.rasterizer.bench import EXACT, Bench, Times, check_truth, fell_back
from gsx.experiments.trade.rasterizer.knobs import (
    KNOBS,
    Row,
    Trial,
    check_knobs,
    combinations,
    evenly,
    gradient_error,
    image_errors,
    ordered,
    overrides,
    pooled_psnr,
    single_changes,
)
from gsx.experiments.trade.rasterizer.measure import at_pace, resolved, sweep, timed, unsteady, usable_paths
from gsx.experiments.trade.rasterizer.page import write_trade
from gsx.experiments.trade.rasterizer.subject import Shot, Subject, framing_cameras, open_subject
from gsx.formats.splat_files import write_gaussians


def row(ratio: float, error: float, knob: str = "chunk", most: float | None = None, **changes: Any) -> Row:
    """A measured row; the base settings take 100 ms, and rendering a third of that."""
    return Row(
        knob=knob if changes else "base",
        changes=changes,
        step_ms=100 * ratio,
        forward_ms=100 * ratio / 3,
        ratio=ratio,
        max_error=error,
        most_error=error if most is None else most,
        psnr=60.0,
        gradient_error=1e-3,
        gradient_field="means",
        pairs=1000.0,
    )


def random_splats(count: int = 120, seed: int = 0) -> Splats:
    g = torch.Generator().manual_seed(seed)
    return Splats(
        means=torch.randn(count, 3, generator=g),
        scales=torch.exp(torch.randn(count, 3, generator=g) * 0.7 - 2.0),
        quats=torch.randn(count, 4, generator=g),
        log_opacities=logsigmoid(2 * torch.randn(count, generator=g)),
        colours=torch.rand(count, 3, generator=g),
    )


def small_camera(width: int = 45, height: int = 33) -> Camera:
    return look_at([0, -4, 1], [0, 0, 0], fov_x=0.9, width=width, height=height)


def tiny_subject(**rules: Any) -> Subject:
    return Subject(
        name="random",
        notes=("by hand",),
        shots=(Shot(name="front", camera=small_camera(), splats=random_splats()),),
        background=torch.zeros(3),
        raster=RasterSettings(**rules),
        device=torch.device("cpu"),
        seed=0,
    )


# -- errors --------------------------------------------------------------------------------------------------------


def test_errors_of_a_pair_of_pictures_made_by_hand() -> None:
    truth = torch.zeros(3, 100, 200, dtype=torch.float64)
    image = torch.zeros(3, 100, 200)
    image[0, 0, 0], image[1, 0, 0], image[2, 5, 5], image[1, 99, 199], image[0, 50, 50] = 0.5, -0.25, -0.4, 0.25, 0.125
    # 20,000 pixels: 2 may be left out, so the third largest is the error of most; channels of a pixel count once
    assert image_errors([image], [truth]) == (0.5, 0.25)
    assert image_errors([image[:, :50, :100]], [truth[:, :50, :100]]) == (0.5, 0.5)
    squares = 0.5**2 + 0.25**2 + 0.4**2 + 0.25**2 + 0.125**2
    assert pooled_psnr([image], [truth]) == pytest.approx(10 * math.log10(60000 / squares))


def test_pictures_are_pooled_not_averaged_in_decibels() -> None:
    truth = torch.zeros(1, 4, 4, dtype=torch.float64)
    pictures = [torch.full((1, 4, 4), 0.1, dtype=torch.float64), torch.full((1, 4, 4), 0.3, dtype=torch.float64)]
    assert pooled_psnr(pictures, [truth, truth]) == pytest.approx(-10 * math.log10((0.01 + 0.09) / 2))
    assert pooled_psnr([truth], [truth]) == math.inf


def test_gradient_error_is_that_of_the_worst_field() -> None:
    truth = {"means": torch.tensor([[3.0, 0, 4]]), "scales": torch.tensor([[2.0, 0, 0]]), "quats": torch.ones(1, 4)}
    truth = {name: value.double() for name, value in truth.items()}
    other = {"means": torch.tensor([[3.0, 1, 4]]), "scales": torch.tensor([[2.5, 0, 0]]), "quats": torch.ones(1, 4)}
    assert gradient_error([other], [truth], [torch.ones(1, 3)]) == (pytest.approx(0.25), "scales")
    # two pictures: norms over both, so sqrt(1 + 1) / sqrt(50) for the means and sqrt(0.5) / sqrt(8) for the scales
    error, _ = gradient_error([other, other], [truth, truth], [torch.ones(1, 3)] * 2)
    assert error == pytest.approx(0.25)


def test_orientations_of_round_splats_count_against_their_scales() -> None:
    truth = {"scales": torch.full((1, 3), 10.0).double(), "quats": torch.zeros(1, 4).double()}
    noise = {"scales": truth["scales"], "quats": torch.tensor([[1e-6, 0, 0, 0]])}
    log_scales = math.sqrt(3) * 10 * 0.1
    error, field = gradient_error([noise], [truth], [torch.full((1, 3), 0.1)])
    assert (error, field) == (pytest.approx(1e-6 / (1e-3 * log_scales)), "quats")


# -- front and advice ----------------------------------------------------------------------------------------------

HAND = [
    row(1.0, 1e-6),
    row(0.5, 1e-3, tile_size=16),
    row(0.6, 1e-2, cull="tight"),  # slower and less exact than the one before
    row(0.4, 2e-2, tile_cap=64),
    row(2.0, 1e-9, evaluation="float64"),
    row(2.0, 1e-7, accumulation="float64"),  # as slow as the one before and less exact
    Row(knob="evaluation", changes={"evaluation": "float16"}, failure="no such thing here"),
]


def test_the_front_of_a_hand_made_table() -> None:
    assert front_of(HAND) == [3, 1, 0, 4]
    assert front_of([]) == []
    assert front_of([row(1, 1e-3), row(1, 1e-3, chunk=8)]) == [0, 1]
    # errors count as they are shown, so a slower row is not on the front for being better by chance
    assert front_of([row(1, 1.104e-3), row(2, 1.101e-3, chunk=8), row(3, 1.04e-3, chunk=32)]) == [0, 2]


def test_the_fastest_row_within_the_budget_is_recommended() -> None:
    assert recommended(HAND, 1e-3) is HAND[1]
    assert recommended(HAND, 9e-4) is HAND[0]
    assert recommended(HAND, 5e-2) is HAND[3]
    assert recommended(HAND, 1e-8) is HAND[4]
    assert recommended(HAND, 1e-10) is None
    assert most_exact(HAND) is HAND[4]
    assert most_exact([row(1, 1.104e-3), row(0.5, 1.101e-3, chunk=8)]).changes == {}


def test_of_rows_as_fast_as_each_other_the_one_that_changes_least_is_recommended() -> None:
    rows = [row(1.0, 0), row(0.50, 0, chunk=8, tile_size=4), row(0.51, 0, chunk=32), row(0.52, 0, tile_size=16)]
    assert recommended(rows, 0) is rows[2]
    assert recommended([row(1.0, 0), row(0.99, 0, chunk=8)], 0).changes == {}
    unsteady = replace(row(0.8, 0, chunk=8), step_spread=0.3, forward_spread=0.1)
    assert recommended([row(1.0, 0), unsteady], 0).changes == {}
    assert recommended([row(1.0, 0), unsteady], 0, "forward_ms") is unsteady


def test_advice_is_typed_as_it_stands() -> None:
    both = "training and rendering, every pixel within 0.001: rasterizer.tile_size=16 (2.00 x as fast)"
    assert advice_lines(HAND, 1e-3) == [both]
    assert advice_lines(HAND[:1], 1e-3) == [
        "training and rendering, every pixel within 0.001: keep the settings as they are"
    ]
    rows = [HAND[0], HAND[1], replace(row(0.9, 1e-4, schedule="segments"), forward_ms=1.0)]
    assert [line.split(":")[1] for line in advice_lines(rows, 1e-3)] == [
        " rasterizer.tile_size=16 (2.00 x as fast)",
        " rasterizer.schedule=segments (33.33 x as fast)",
    ]


def test_when_nothing_fits_the_most_exact_is_named_and_what_would_fit_but_for_a_few_pixels() -> None:
    rows = [row(1.0, 6.06e-3, most=2e-6), row(0.5, 8e-3, most=3e-6, tile_size=16), row(0.3, 0.5, most=0.4, tile_cap=64)]
    nothing, most = advice_lines(rows, 1e-3)
    assert nothing.startswith("no settings keep every pixel within 0.001: the most exact are base settings")
    assert nothing.endswith("--max-error 0.0061")
    assert most.endswith("all but 0.01% of the pixels within 0.001: rasterizer.tile_size=16 (2.00 x as fast)")
    assert len(advice_lines(rows, 1e-9)) == 1


@pytest.mark.parametrize(("value", "text"), [(6.06e-3, "0.0061"), (0.5, "0.5"), (1.23e-7, "1.3e-07"), (0.0, "0")])
def test_budgets_are_rounded_up(value: float, text: str) -> None:
    assert rounded_up(value) == text
    assert float(text) >= value


def test_the_table_is_aligned_sorted_and_names_what_failed() -> None:
    lines = table(ordered(HAND))
    assert [line.split()[-1] for line in lines[1:4]] == ["tile_cap=64", "tile_size=16", "cull=tight"]
    assert [line.startswith("*") for line in lines[1:7]] == [True, True, False, True, True, False]
    assert lines[-1] == "failed: evaluation=float16: no such thing here"
    assert len({line.index(line.split("  ")[-1]) for line in lines[1:-1]}) == 1


# -- what is tried -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cuda", [False, True])
@pytest.mark.parametrize("cull", ["published", "tight"])
def test_single_changes_are_valid_settings_and_change_something(cull: str, cuda: bool) -> None:
    base = RasterSettings(cull=cull)
    presets = [RasterSettings(), RasterSettings(path="compiled", chunk=8, batch_values=1 << 19)]
    trials = single_changes(base, presets, cuda=cuda, knobs=KNOBS)
    assert trials[0] == Trial(knob="base", changes={})
    assert {trial.knob for trial in trials} == {"base", *KNOBS}
    for trial in trials[1:]:
        assert replace(base, **trial.changes) != base
    assert len({overrides(trial.changes) for trial in trials}) == len(trials)
    found = [trial.changes for trial in trials]
    assert ({"evaluation": "tf32"} in found) == cuda
    assert ({"tile_size": 32} in found) == (cull == "tight")
    compiled = {"path": "compiled", "chunk": 8, "batch_values": 1 << 19}
    assert compiled in found
    assert compiled | {"schedule": "chunks" if cuda else "segments"} in found


def test_without_a_compiler_neither_path_nor_schedule_is_tried() -> None:
    trials = single_changes(RasterSettings(), [RasterSettings()], cuda=False, knobs=KNOBS)
    assert {trial.knob for trial in trials} == {"base", *KNOBS} - {"path", "schedule"}


@pytest.mark.parametrize("complaint", ["", "no compiler"])
def test_paths_that_do_not_work_here_are_not_tried(complaint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsx.experiments.trade.rasterizer.measure.complaint", lambda device: complaint)
    monkeypatch.setattr("gsx.experiments.trade.rasterizer.measure.available", lambda device: not complaint)
    presets, notes = usable_paths(plugins(), torch.device("cpu"))
    assert [preset.path for preset in presets] == ["eager", "compiled"][: 1 if complaint else 2]
    assert notes == ["only eager settings are tried: nothing compiles here (no compiler)"][: bool(complaint)]


def test_from_compiled_settings_eager_and_the_other_schedule_are_tried() -> None:
    compiled = RasterSettings(path="compiled", chunk=8, batch_values=1 << 19)
    trials = single_changes(compiled, [RasterSettings(), compiled], cuda=False, knobs=("path", "schedule"))
    told = [trial.changes for trial in trials]
    assert told == [{}, {"path": "eager", "chunk": 16, "batch_values": 1 << 18}, {"schedule": "segments"}]
    assert resolved(compiled) == (compiled, [])
    base, (note,) = resolved(RasterSettings(path="auto"))
    assert base == RasterSettings(path="eager")
    assert "begin with rasterizer.path=compiled" in note


def test_knobs_can_be_chosen_and_typos_get_the_nearest() -> None:
    assert check_knobs(None) == KNOBS
    assert check_knobs("cull, chunk") == ("cull", "chunk")
    with pytest.raises(ConfigError, match=r"'tilesize' cannot be swept\. Did you mean 'tile_size'"):
        check_knobs("tilesize")


def test_combinations_join_what_helps_alone() -> None:
    rows = [
        row(1.0, 1e-6),
        row(0.5, 1e-6, knob="path", path="compiled"),
        row(0.6, 1e-6, knob="schedule", path="compiled", schedule="segments"),  # not beside the one before
        row(0.8, 1e-3, knob="tile_cap", tile_cap=256),
        row(0.6, 1e-1, knob="tile_cap", tile_cap=64),
        row(1.3, 1e-6, knob="chunk", chunk=8),  # helps nothing
        row(0.95, 1e-6, knob="cull", cull="tight"),  # hardly
        Row(knob="evaluation", changes={"evaluation": "float16"}, failure="broken"),
    ]
    tried = [trial.changes for trial in combinations(rows, 8, 2e-3)]
    assert tried == [{"path": "compiled", "tile_cap": 256}, {"path": "compiled", "tile_cap": 64}]
    assert [trial.changes for trial in combinations(rows, 1, 1.0)] == [{"path": "compiled", "tile_cap": 64}]
    assert [trial.changes for trial in combinations(rows, 1, 2e-3)] == [{"path": "compiled", "tile_cap": 256}]
    assert combinations(rows, 0, 1.0) == []
    assert combinations(rows[:2], 8, 1.0) == []


def test_combinations_stay_few_and_spread_along_the_front() -> None:
    knobs = ("chunk", "cull", "alpha_min", "transmittance_stop", "tile_cap", "exponent")
    singles = [row(0.9 - 0.01 * i, 10.0 ** (i - 7), knob=knob, **{knob: i}) for i, knob in enumerate(knobs)]
    assert len(combinations([row(1.0, 1e-8), *singles], 5, 1e-3)) == 5
    assert evenly(5, 3) == [0, 2, 4]
    assert evenly(2, 3) == [0, 1]
    assert evenly(9, 1) == [0]
    assert evenly(9, 0) == evenly(0, 2) == []


# -- measuring -----------------------------------------------------------------------------------------------------


def test_the_truth_is_the_untiled_reference() -> None:
    subject = tiny_subject()
    check = check_truth(subject.shots[0], replace(subject.raster, **EXACT))
    assert check.splats > 20
    assert check.image < 1e-12
    assert check.gradient < 1e-9
    wrong = check_truth(subject.shots[0], replace(subject.raster, **EXACT, tile_cap=1))
    assert wrong.image > 0.01, "the check does not look at what is drawn"


def test_errors_of_trials_are_those_against_the_untiled_reference() -> None:
    subject = tiny_subject()
    shot, bench = subject.shots[0], Bench(subject, subject.raster)
    base = bench.measured(Trial(knob="base", changes={}))
    exact = bench.measured(Trial(knob="evaluation", changes={"evaluation": "float64", "exponent": "direct"}))
    tight = bench.measured(Trial(knob="cull", changes={"cull": "tight"}))
    assert base.max_error < 2e-5
    assert exact.max_error < 2e-6  # splats and geometry stay float32
    assert exact.gradient_error < 1e-5
    truth, _, _ = render_reference(shot.splats, shot.camera, subject.raster)
    assert float((bench.truths[0].image - truth).abs().max()) < 1e-12
    other, _, _ = render_reference(shot.splats, shot.camera, replace(subject.raster, cull="tight"))
    assert tight.max_error > 1e-3
    assert tight.max_error == pytest.approx(float((other - truth).abs().max()), abs=2e-5)
    assert tight.psnr == pytest.approx(-10 * math.log10(float((other - truth).square().mean())), abs=0.05)
    assert tight.ideal_psnr > base.ideal_psnr
    assert (base.knob, base.changes, base.failure) == ("base", {}, "")


def test_what_only_the_eager_path_does_is_told() -> None:
    halves = RasterSettings(path="compiled", accumulation="float16")
    assert fell_back(halves, torch.device("cpu"))
    assert not fell_back(replace(halves, path="eager"), torch.device("cpu"))
    told = replace(row(1, 0, accumulation="float16"), fell_back=True)
    assert told.settings == "accumulation=float16 (by the eager path)"


def test_what_fails_is_a_row_with_its_reason() -> None:
    bench = Bench(tiny_subject(), RasterSettings())
    assert "more than rasterizer.max_pairs=1" in bench.measured(Trial(knob="x", changes={"max_pairs": 1})).failure
    assert "must divide 16" in bench.measured(Trial(knob="x", changes={"tile_size": 5})).failure


def test_what_is_tried_compiled_is_compiled_by_two_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(settings: RasterSettings, learnt: Learnt, device: torch.device, helped: bool) -> None:
        raise RuntimeError(f"alpha_min {settings.alpha_min}, helped {helped}")

    monkeypatch.setattr("gsx.experiments.trade.rasterizer.bench.compiles", lambda settings, _: settings.path != "eager")
    monkeypatch.setattr("gsx.experiments.trade.rasterizer.bench.compile_now", refuse)
    bench = Bench(tiny_subject(), RasterSettings(path="eager"))
    assert bench.measured(Trial(knob="x", changes={})).failure == ""
    tried = bench.measured(Trial(knob="x", changes={"path": "compiled", "alpha_min": 0.01}))
    assert "alpha_min 0.01, helped True" in tried.failure


class Scripted(Bench):
    """Takes times from a list and writes down who asked."""

    def __init__(self, script: dict[int, list[float]]) -> None:
        self.base, self.script, self.asked = RasterSettings(), script, []

    def times(self, settings: RasterSettings) -> Times:
        """The next time of the row whose chunk this is."""
        self.asked.append(settings.chunk)
        taken = self.script[settings.chunk].pop(0)
        if taken < 0:
            raise RuntimeError("out of memory\nsecond line")
        return Times(forward=taken / 4, step=taken, peak_mb=None)


def test_rounds_take_all_rows_in_turn_and_ratios_forget_a_drift() -> None:
    # the machine slows down threefold from round to round; row 2 takes twice the time of the base all along
    bench = Scripted({16: [1.0, 3.0, 9.0], 2: [2.0, 6.0, 18.0], 3: [0.5, -1.0]})
    rows = [replace(row(1, 0), changes=c) for c in ({}, {"chunk": 2}, {"chunk": 3})]
    failed = Row(knob="x", changes={"chunk": 4}, failure="earlier")
    base, twice, broken, same = timed(bench, [*rows, failed], 3)
    assert (base.step_spread, twice.step_spread) == (0.0, 0.0)
    assert bench.asked == [16, 2, 3, 3, 2, 16, 16, 2]
    assert (base.step_ms, base.forward_ms, base.ratio) == (3000.0, 750.0, 1.0)
    assert (twice.step_ms, twice.forward_ms, twice.ratio) == (6000.0, 1500.0, 2.0)
    assert broken.failure == "RuntimeError: out of memory"
    assert same is failed


def test_what_a_time_varies_from_round_to_round_is_told() -> None:
    bench = Scripted({16: [1.0, 1.0, 1.0], 2: [2.0, 1.5, 2.5]})
    _, other = timed(bench, [replace(row(1, 0), changes=c) for c in ({}, {"chunk": 2})], 3)
    assert (other.ratio, other.step_spread) == (2.0, 0.25)
    assert "varied by 25% from round to round" in unsteady([other])[0]
    assert unsteady([row(1, 0), row(2, 0), other]) == []


def test_base_settings_that_fail_while_timed_are_refused() -> None:
    with pytest.raises(InputError, match=r"cannot be measured \(RuntimeError: out of memory"):
        timed(Scripted({16: [-1.0], 2: [1.0]}), [replace(row(1, 0), changes=c) for c in ({}, {"chunk": 2})], 1)


def test_times_of_combinations_are_told_at_the_pace_of_the_first_rounds() -> None:
    base, again, other = row(1.0, 0), replace(row(3.0, 0), ratio=1.0), replace(row(1.5, 0), ratio=0.5)
    told = at_pace(other, base, again)  # in rounds in which the machine was three times as slow
    assert (told.step_ms, told.forward_ms) == (50.0, pytest.approx(50.0 / 3))


def test_a_sweep_ends_in_a_page_and_json_without_anything_outside(tmp_path: Path) -> None:
    trade = sweep(
        tiny_subject(), [RasterSettings()], knobs=("tile_size", "cull"), repeats=1, max_error=1e-3, most_combinations=2
    )
    assert {r.settings for r in trade.rows} >= {"base settings", "tile_size=4", "tile_size=16", "cull=tight"}
    assert [r.step_ms for r in trade.rows] == sorted(r.step_ms for r in trade.rows)
    broken = Row(knob="evaluation", changes={"evaluation": "float16"}, failure="<no> half")
    page = write_trade(replace(trade, rows=[*trade.rows, broken]), tmp_path, 1e-3).read_text()
    assert page.count("<svg") == 4
    assert "&lt;no&gt; half" in page
    assert "://" not in page
    content = json.loads((tmp_path / "trade.json").read_text())
    assert len(content["rows"]) == len(trade.rows) + 1
    assert content["truth"]["evaluation"] == "float64"
    assert content["check"]["image"] < 1e-12
    assert {entry["purpose"] for entry in content["recommendation"]} == {"training", "rendering"}


def test_errors_are_drawn_on_a_logarithmic_axis_with_the_front_below() -> None:
    dots = [
        Dot(x=x, y=y, text="", label=f"<{x:.0f}>", colour=0) for x, y in ((1, 1e-2), (2, 1e-6), (3, 1e-4), (4, 1e-16))
    ]
    drawing = scatter(dots, x_label="ms", falling=True)
    assert [f"&lt;{x}&gt;" in drawing for x in (1, 2, 3, 4)] == [True, True, False, True]
    heights = [float(y) for y in re.findall(r'<circle [^>]*cy="([\d.]+)"', drawing)]
    assert heights[1] - heights[0] == pytest.approx(2 * (heights[2] - heights[0]), abs=0.2)  # four decades, and two
    ticks = Axis(1e-17, 1.0, log=True).ticks()
    assert 4 <= len(ticks) <= 9
    assert all(math.log10(tick) == pytest.approx(round(math.log10(tick))) for tick in ticks)


def test_base_settings_that_cannot_be_drawn_are_refused() -> None:
    with pytest.raises(InputError, match="max_pairs"):
        sweep(
            tiny_subject(max_pairs=1),
            [RasterSettings()],
            knobs=("cull",),
            repeats=1,
            max_error=1e-3,
            most_combinations=2,
        )


# -- subjects ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_views_of_a_file_frame_the_nearer_half_of_the_splats(size: float) -> None:
    g = torch.Generator().manual_seed(1)
    means = size * (torch.randn(500, 3, generator=g) * torch.tensor([1.0, 0.2, 1.0]) + 7)
    cameras, words = framing_cameras(means, 3, Path("x.ply"))
    assert words.startswith("3 views of 640x480 px")
    offsets = (means - means.median(0).values).norm(dim=1)
    for camera in cameras:
        positions, depths = camera.project(means[offsets <= offsets.median()].double())
        assert bool((depths > camera.near).all())
        assert bool(((positions >= 0) & (positions <= torch.tensor([640, 480]))).all())
        up = -camera.rotation[1]  # the thin direction is y, of which files have more below than above
        assert float(up[1]) < -0.8


def test_a_file_without_finite_splats_is_refused() -> None:
    with pytest.raises(InputError, match="no splats with finite positions"):
        framing_cameras(torch.full((3, 3), math.nan), 2, Path("x.ply"))


def test_a_splat_file_becomes_a_subject(tmp_path: Path) -> None:
    g = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=torch.randn(50, 3, generator=g),
        log_scales=torch.randn(50, 3, generator=g) - 2,
        quats=torch.randn(50, 4, generator=g),
        opacity_logits=torch.randn(50, generator=g),
        sh_dc=torch.randn(50, 3, generator=g),
        sh_rest=torch.randn(50, 8, 3, generator=g),
    )
    path = tmp_path / "x.ply"
    write_gaussians(path, gaussians)
    subject = open_subject(path, ["rasterizer.tile_size=16", "device=cpu"], 2, plugins())
    assert len(subject.shots) == 2
    assert subject.raster.tile_size == 16
    assert torch.allclose(subject.shots[0].splats.means, gaussians.means)
    assert not torch.equal(subject.shots[0].splats.colours, subject.shots[1].splats.colours), "colours follow the view"
    with pytest.raises(ConfigError, match="means nothing to a splat file"):
        open_subject(path, ["scene.width=20"], 2, plugins())
