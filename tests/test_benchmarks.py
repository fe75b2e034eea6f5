"""The benchmarks on tiny sizes: that they measure what they say, on yardsticks that are right themselves."""

import itertools
import json
import math
import sys
from dataclasses import replace
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from raster_scenes import any_path
from reference_rasterizer import render_reference
from torch import Tensor

import rasterizer as benchmark
import step
from gsx.core.errors import InputError
from gsx.core.rasterizer.projection import project
from gsx.engine import compiled
from measuring import knobs, naive, rival, stages
from measuring.adapter import LOOPS, blend_screen, learnable, loops_timed, settings_of
from measuring.cases import Case, camera_of, gradient_of, pairs_of, picture, splats_of
from measuring.limits import BACKWARD_FLOPS, FORWARD_FLOPS, Limit, backward_bytes, evaluation_limit, forward_bytes
from measuring.memory import HostPeaks, peak_memory, unmeasurable
from measuring.prototype import factors_of
from measuring.results import Section, cell, read_sections, scaling_plot, stamped, write_results
from measuring.scaling import growth
from measuring.watches import LEAST, Patience, Watch, take_turns

CPU = torch.device("cpu")
CASE = Case(splats=60, width=43, height=30)


def run(folder: Path, *words: str) -> int:
    return benchmark.main(["--quick", "--paths", "eager", "--no-memory", "--to", str(folder), *words])


def results(folder: Path) -> dict:
    return json.loads((folder / "rasterizer_cpu_quick.json").read_text())


def test_naive_loop_draws_the_truth_and_its_gradient() -> None:
    settings = settings_of("eager", "rasterizer.cull=tight")
    splats, truth = splats_of(CASE, CPU), splats_of(CASE, CPU)
    camera, gradient = camera_of(CASE), gradient_of(CASE, CPU)
    image = naive.render(project(splats, camera, settings), camera, settings)
    reference = render_reference(truth, camera, settings)[0]
    assert torch.allclose(image.double(), reference, atol=1e-5)
    image.backward(gradient)
    reference.backward(gradient.double())
    for name, leaf in vars(splats).items():
        other = getattr(truth, name).grad
        assert torch.allclose(leaf.grad, other, rtol=1e-3, atol=1e-4 * float(other.abs().max())), name


def test_cases_are_the_same_each_time_and_lie_on_the_raster() -> None:
    one, two = splats_of(CASE, CPU), splats_of(CASE, CPU)
    assert all(torch.equal(value, getattr(two, name)) for name, value in vars(one).items())
    places, depths = camera_of(CASE).project(one.means.detach())
    assert bool(((places >= 0) & (places <= torch.tensor([43.0, 30.0]))).all())
    assert 1 <= float(depths.min()) < float(depths.max()) <= 11
    pixels = one.scales.detach() / depths[:, None] * 43
    assert 0.4999 < float(pixels.min()) < 0.8
    assert 4 < float(pixels.max()) < 6.001


def test_pairs_are_those_of_the_picture() -> None:
    from gsx.core.rasterizer import rasterize

    settings = settings_of("eager")
    assert pairs_of(CASE, CPU, settings) == rasterize(splats_of(CASE, CPU), camera_of(CASE), settings).intersections


def test_rivals_take_turns_after_one_call_each() -> None:
    calls: list[str] = []

    def job(name: str):
        def work(watch: Watch) -> None:
            watch.begin()
            calls.append(name)
            watch.lap("only")

        return work

    timings = take_turns({"a": job("a"), "b": job("b")}, CPU, Patience(5, 100.0))
    assert calls == ["a", "b"] * 6
    assert len(timings["a"].rounds) == 5
    calls.clear()
    take_turns({"a": job("a")}, CPU, Patience(50, 0.0))
    assert len(calls) == 1 + LEAST


def test_memory_traffic_and_operations_by_hand() -> None:
    # splat: 14 numbers in, 9 out; pair: 4 times 8 bytes and 9 numbers; pixel: 4 numbers
    assert forward_bytes(1, 0, 0) == 92
    assert forward_bytes(0, 1, 0) == 68
    assert forward_bytes(2, 3, 5) == 2 * 92 + 3 * 68 + 5 * 16
    assert backward_bytes(2, 3, 5) == 2 * 184 + 3 * 112 + 5 * 32
    assert (sum(FORWARD_FLOPS.values()), sum(BACKWARD_FLOPS.values())) == (22, 50)
    # 1 ns for the exponential and 22 operations at 11 a nanosecond: 3 ns
    rates = [Limit("a", 1e9, "exp/s"), Limit("b", 5e8, "exp/s"), Limit("c", 11e9, "flop/s")]
    assert evaluation_limit(rates, 22) == pytest.approx(1e9 / 3)


@pytest.fixture
def hollow_heap() -> Tensor:
    """Leave one free chunk of 200 MB inside malloc's heap, as a long-lived process does, below the tensor returned."""
    torch.ones(5_000_000)  # from now on malloc serves 20 MB from its heap
    chunks = [torch.ones(5_000_000) for _ in range(10)]
    lid = torch.ones(5_000_000)
    del chunks
    return lid


@pytest.mark.usefixtures("hollow_heap")
@pytest.mark.skipif(bool(unmeasurable(CPU)), reason=unmeasurable(CPU))
def test_peaks_are_those_of_the_phase() -> None:
    watch = HostPeaks()
    watch.begin()
    kept = torch.ones(5_000_000)
    torch.ones(10_000_000)
    watch.lap("first")
    torch.ones(2_500_000)
    watch.lap("second")
    assert watch.phases["first"] == pytest.approx(60e6, rel=0.05)
    assert watch.phases["second"] == pytest.approx(30e6, rel=0.05)
    assert len(kept)


@pytest.mark.skipif(bool(unmeasurable(CPU)), reason=unmeasurable(CPU))
def test_peak_memory_of_a_process_of_its_own() -> None:
    case = Case(splats=2000, width=648, height=420)
    peaks = peak_memory("eager", case, CPU, settings_of("eager"))
    picture_mb = 648 * 420 * 4 * 4 / 1e6  # three channels and coverage
    assert picture_mb < peaks["forward"] < 40 * picture_mb
    assert peaks["whole"] > peaks["backward"] > picture_mb


def test_every_section_runs_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, "--only", "limits,splats,step,gpu") == 0
    found = results(tmp_path)
    rows = {name: section["rows"] for name, section in found["sections"].items()}
    assert list(rows) == ["limits", "splats", "step", "gpu"]
    assert {row["path"] for row in rows["splats"]} == {"eager", "naive"}
    eager, loop = rows["splats"][:2]
    assert eager["naive_ratio"] == pytest.approx(loop["total_ms"] / eager["total_ms"])
    assert eager["forward_rate"] == pytest.approx(eager["pairs"] * 64 / eager["forward_ms"] / 1e3)
    assert all(row["forward_share"] > 0 for row in rows["gpu"])
    assert rows["step"][0]["steps"] == 2
    page = (tmp_path / "rasterizer_cpu_quick.md").read_text()
    assert "rasterizer_cpu_quick.svg" in page
    assert (tmp_path / "rasterizer_cpu_quick.svg").read_text().count("<polyline") == 3
    assert "--to " + tmp_path.name in page
    assert str(tmp_path.parent) not in page + json.dumps(found)
    assert "gsplat: not runnable here" in capsys.readouterr().out


def a_section(value: str) -> Section:
    return stamped("A table", [["x1", "x1"]], [{"x1": value}], ["a note"], 0.1, "python this.py")


def test_a_section_measured_again_replaces_itself_alone_whatever_the_machine(tmp_path: Path) -> None:
    one, two = {"cpu": "A", "threads": 1}, {"cpu": "A", "threads": 2}
    write_results(tmp_path, "r", two, {"fox": a_section("29.19"), "demo": a_section("26.56")})
    write_results(tmp_path, "r", one, {"demo": a_section("26.57")})
    write_results(tmp_path, "r", one, {"lego": a_section("31.81")})
    found = read_sections(tmp_path / "r.json")
    told = {name: (part["rows"][0]["x1"], part["machine"]["threads"]) for name, part in found.items()}
    assert told == {"fox": ("29.19", 2), "demo": ("26.57", 1), "lego": ("31.81", 1)}


def test_the_page_names_with_each_section_what_machines_differ_in(tmp_path: Path) -> None:
    write_results(tmp_path, "r", {"cpu": "A", "threads": 2}, {"fox": a_section("29.19")})
    alone = (tmp_path / "r.md").read_text()
    assert "* threads: 2" in alone
    assert "Machine of this section" not in alone
    write_results(tmp_path, "r", {"cpu": "A", "threads": 1, "gpu": "G"}, {"demo": a_section("26.57")})
    top, fox, demo = (tmp_path / "r.md").read_text().split("## ")
    assert "* cpu: A" in top
    assert "threads" not in top
    assert fox.rstrip().endswith("Machine of this section: threads 2.")
    assert demo.rstrip().endswith("Machine of this section: threads 1, gpu G.")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ('{"sections": {', "cannot be read"),
        ("[]", "is no file of sections"),
        ('{"machine": {}, "sections": {}}', "is no file of sections"),  # the machine of all, as it was once
        ('{"sections": {"fox": {"rows": []}}}', "section 'fox' without columns, command, commit"),
    ],
)
def test_files_that_cannot_be_added_to_are_refused_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, sentence: str
) -> None:
    path = tmp_path / "rasterizer_cpu_quick.json"
    path.write_text(content)
    with pytest.raises(InputError, match="is left as it is"):
        write_results(tmp_path, path.stem, {}, {"fox": a_section("29.19")})
    assert run(tmp_path, "--only", "limits") == 2
    told = capsys.readouterr().err
    assert sentence in told
    assert "limits ..." not in told
    assert path.read_text() == content


def test_committed_results_are_what_the_writer_reads_and_their_pages_are_theirs() -> None:
    from measuring.results import markdown

    files = sorted(benchmark.RESULTS.rglob("*.json"))
    assert files
    for file in files:
        sections = read_sections(file)
        drawn = file.with_suffix(".svg").is_file()
        assert file.with_suffix(".md").read_text() == markdown(file.stem, sections, drawn), file.name


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--only", "splat"], "Did you mean 'splats'?"),
        (["--paths", "fast"], "--paths has no 'fast'"),
        (["--only", "prototype"], "needs --prototype FILE"),
        (["--only", "prototype", "--prototype", "nowhere.py"], "is no Python file"),
        (["--repeats", "0"], "must be at least 1"),
    ],
)
def test_mistakes_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], sentence: str
) -> None:
    assert benchmark.main(["--quick", "--paths", "eager", "--to", str(tmp_path), *words]) == 2
    assert sentence in capsys.readouterr().err


def test_gsplat_is_not_measured_without_a_gpu() -> None:
    assert "CUDA" in rival.missing(CPU)


def test_gsplat_is_asked_for_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    splats, camera, asked = splats_of(CASE, CPU), camera_of(CASE).crop(5, -3, 20, 10), {}

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **rest):
        seen = means @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
        asked.update(rest, places=(seen @ Ks[0].T)[:, :2] / seen[:, 2:], opacities=opacities)
        return torch.zeros(1, height, width, 3), None, {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    image = rival.render(splats, camera, settings_of("eager", "rasterizer.dilation=0.4"))
    assert image.shape == (3, 10, 20)
    assert torch.allclose(asked["places"], camera.project(splats.means)[0], atol=1e-4)
    assert torch.equal(asked["opacities"], splats.log_opacities.exp())
    assert (asked["near_plane"], asked["eps2d"]) == (camera.near, 0.4)


def test_growth_compares_time_per_pair() -> None:
    def row(splats: int, pairs: int, total: float) -> dict:
        return {"path": "eager", "raster": "8x8", "splats": splats, "pairs": pairs, "total_ms": total}

    # 1 ms a pair at 10 k splats, 1.5 ms at 1 M; the smallest case does not count
    text = growth([row(100, 7, 700.0), row(10_000, 50, 50.0), row(100_000, 400, 500.0), row(1_000_000, 4000, 6000.0)])
    assert text.endswith("eager 8x8: 1.50.")


def test_cells_have_three_digits() -> None:
    assert [cell(v) for v in (None, "a", 1234567, 1234.5, 12.345, 0.12345, 0.0)] == [
        "", "a", "1,234,567", "1,234", "12.3", "0.123", "0",
    ]  # fmt: skip


def test_plot_needs_two_points_of_a_curve() -> None:
    def row(pairs: int, raster: str = "8x8") -> dict:
        return {"path": "compiled", "raster": raster, "pairs": pairs, "total_ms": 2.0 * pairs}

    assert not scaling_plot([row(10), row(10, "9x9")])
    assert scaling_plot([row(10), row(1000)]).count("<circle") == 2


# -- prototype -----------------------------------------------------------------------------------------------------


def test_factors_are_half_the_inverse_covariance() -> None:
    u0, u1, u2 = factors_of(torch.tensor([[4.0, 1.5, 2.0]], dtype=torch.float64))[0]
    upper = torch.stack([torch.stack([u0, u1]), torch.stack([u2 * 0, u2])])
    covariance = torch.tensor([[4.0, 1.5], [1.5, 2.0]], dtype=torch.float64)
    assert torch.allclose(upper.T @ upper, torch.linalg.inv(covariance) / 2)


STAND_IN = """
import torch
from measuring import naive
from measuring.adapter import learnable, settings_of, to_raster, to_tiles
from measuring.prototype import flat_camera, screen_of

W, H = 40, 24
CAMERA = flat_camera(W, H)


def random_splats(n):
    draw = torch.Generator().manual_seed(0)
    covariance = torch.tensor([[3.0, 0.5, 2.0]]).repeat(n, 1)
    means = torch.rand(n, 2, generator=draw) * torch.tensor([W, H])
    return means, covariance, torch.full((n,), 0.05), torch.rand(n, 3, generator=draw), torch.rand(n, generator=draw)


class Prototype:
    # the interface of the prototype, one "pair" for each splat
    def __init__(self, splats, tile):
        self.screen, self.order = screen_of(*splats)
        self.tile, self.splat = tile, self.order

    def pair(self):
        self.screen = learnable(self.screen)

    def gather(self):
        pass

    def forward(self):
        self.picture = naive.render(self.screen, CAMERA, settings_of("eager", "rasterizer.cull=tight"))
        self.image = to_tiles(self.picture.detach(), CAMERA, self.tile) + OFFSET
        self.T = torch.ones_like(self.image[..., 0])

    def backward(self, gradient):
        seen = to_raster(gradient, CAMERA, self.tile)
        return None, torch.autograd.grad(self.picture, [self.screen.channels], seen, retain_graph=True)[0]


def measure(n, tile, repeats):
    return {"total": 1.0}
"""


def stand_in(folder: Path, offset: float) -> str:
    path = folder / "stand_in.py"
    path.write_text(STAND_IN.replace("OFFSET", str(offset)))
    return str(path)


def test_prototype_is_timed_on_the_same_splats(tmp_path: Path) -> None:
    assert run(tmp_path, "--only", "prototype", "--prototype", stand_in(tmp_path, 0.0)) == 0
    section = results(tmp_path)["sections"]["prototype"]
    prototype, eager = section["rows"]
    phases = ("pair_ms", "forward_ms", "backward_ms")
    assert eager["total_ms"] == pytest.approx(sum(eager[phase] for phase in phases), rel=0.5)
    assert eager["share"] == pytest.approx(eager["total_ms"] / prototype["total_ms"])
    assert float(section["notes"][1].split("colours to ")[1].split(" ")[0]) < 1e-5


def test_another_picture_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, "--only", "prototype", "--prototype", stand_in(tmp_path, 2e-4)) == 2
    assert "draw different pictures" in capsys.readouterr().err


def test_eager_path_draws_what_the_naive_loop_draws() -> None:
    settings, camera = settings_of("eager", "rasterizer.cull=tight"), camera_of(CASE)
    with torch.no_grad():
        pictures = [picture(path, splats_of(CASE, CPU), camera, settings) for path in ("eager", "naive")]
    assert torch.allclose(*pictures, atol=1e-5)


def evaluation(psnr: float, seconds: float) -> dict:
    zoom = {
        factor: {"psnr": psnr - loss, "enlarged_psnr": psnr - 2} for factor, loss in zip("124", (0, 1, 3), strict=True)
    }
    return {"zoom": zoom, "primitives": 10, "train_seconds": seconds}


def test_gains_of_pseudo_details_are_taken_seed_by_seed() -> None:
    """31 and 35 against 30 and 33: gains of 1 and 2, though the means differ by more than any seed's spread."""
    import augmenters

    pairs = [(evaluation(31.0, 30.0), evaluation(30.0, 20.0)), (evaluation(35.0, 22.0), evaluation(33.0, 20.0))]
    row = augmenters.line("gs3d", "upscale", pairs)
    assert (row["x1"], row["gain1"]) == ("33.00", "+1.50 ± 0.50")
    assert (row["x4"], row["gain4"], row["enlarged"]) == ("30.00", "+1.50 ± 0.50", "31.00")
    assert (row["cost"], row["seconds"], row["seeds"]) == ("1.30", 26, 2)
    assert "gain1" not in augmenters.line("gs3d", "control", pairs)


def test_controls_are_trained_before_what_branches_from_them() -> None:
    import augmenters

    for family in augmenters.FAMILIES.values():
        assert next(iter(augmenters.asked(family, False))) == "control"
        both = {**augmenters.asked(family, False), **augmenters.asked(family, True)}
        assert set(both) == {"control", *family.added}


def test_seeds_of_the_experiment_are_kept_and_added_to(tmp_path: Path) -> None:
    """zoom - Mip-Splatting at x4: 0.5 with seed 0, 0.1 with seed 1, which is measured twice; seed 2 has no `zoom`."""
    import zoom_truth

    given = zoom_truth.arguments(["--share", "0.4", "--to", str(tmp_path)])

    def row(name: str, seed: int, x4: str) -> dict:
        figures = {"x1": "27.000", "x4": x4, "over4": "-0.250", "s": "20.4"}
        return {"share": "0.4", "scene": "demo", "name": name, "seed": seed, "commit": "abc"} | figures

    for rows in (
        [row("zoom", 0, "25.500"), row("Mip-Splatting", 0, "25.000"), row("zoom", 1, "30.000")],
        [row("zoom", 1, "26.100"), row("Mip-Splatting", 1, "26.000"), row("Mip-Splatting", 2, "27.500")],
    ):
        zoom_truth.keep(rows, given, {"cpu": "any"}, (0.0, "command"))
    assert [(r["name"], r["seed"]) for r in zoom_truth.read_rows(tmp_path)] == [
        *(("Mip-Splatting", seed) for seed in range(3)),
        *(("zoom", seed) for seed in range(2)),
    ]
    base, zoom = read_sections(tmp_path / "zoom_truth_cpu.json")["table"]["rows"]
    assert (base["seeds"], base["x4"], base.get("more_x4")) == (3, "26.17 ± 1.25", None)
    assert (zoom["seeds"], zoom["x4"], zoom["more_x4"]) == (2, "25.80 ± 0.30", "+0.30 ± 0.20")
    assert (zoom["over4"], zoom["x2"], zoom["s"]) == ("-0.25 ± 0.00", "", 20)


def test_figures_of_the_experiment_are_read_from_its_table() -> None:
    import zoom_truth

    line = {"row": "zoom", "metric": "PSNR x4", "ours": "25.50049"}
    more = [line | {"metric": "SSIM"}, line | {"metric": "detail x4", "ours": ""}]
    assert zoom_truth.figures([line, *more]) == {"zoom": {"x4": "25.500"}}


def test_gains_of_a_prior_are_taken_seed_by_seed(tmp_path: Path) -> None:
    """At x4: 0.5 with seed 0, 0.7 with seed 1; seed 2 has no baseline."""
    import prior

    given = prior.arguments(["--to", str(tmp_path)])

    def row(name: str, seed: int, x4: float, **more: float) -> dict:
        return {"scene": "demo", "name": name, "seed": seed, "commit": "abc", "x4": x4, "s": 50.0} | more

    for one in (
        row("none", 0, 28.0, detail4=0.2),
        row("none", 1, 28.2, detail4=0.2),
        row("photos, span", 0, 28.5, detail4=0.3, upscaled4=28.0),
        row("photos, span", 1, 28.9, detail4=0.34, upscaled4=28.5),
        row("photos, span", 2, 30.0, detail4=0.5, upscaled4=29.0),
    ):
        prior.keep(one, given, {"cpu": "any"}, (0.0, "command"))
    (gain,) = read_sections(tmp_path / "prior_cpu.json")["gains"]["rows"]
    assert (gain["seeds"], gain["x4"], gain["detail4"]) == (2, "+0.60 ± 0.10", "1.60 ± 0.10")
    assert (gain["over_upscaled"], gain["s"], gain["x1"]) == ("+0.45 ± 0.05", "1.00 ± 0.00", "")


def test_figures_of_a_prior_are_read_from_its_evaluation(tmp_path: Path) -> None:
    import prior

    content = {"psnr": 30.0, "zoom": {"4": {"psnr": 28.0, "consistency": {"render": 25.0}}}, "train_seconds": 50.0}
    (tmp_path / "evaluation.json").write_text(json.dumps(content))
    assert prior.figures(tmp_path) == {"x1": 30.0, "x4": 28.0, "agree4": 25.0, "s": 50.0}
    given = prior.arguments(["--rows", "none; none, more steps"])
    assert list(prior.rows_of(given)) == ["none", "none, more steps"]


def test_bad_photographs_are_counted_over_seeds() -> None:
    import captures

    found = [
        {"bad": 5, "good": 45, "found": 4, "wrongly": 1, "shift": 0.02, "off": [0.1, 0.4]},
        {"bad": 5, "good": 45, "found": 5, "wrongly": 0, "shift": 0.04, "off": [3.0]},
    ]
    row = captures.fault_row("fox", "pose", found)
    assert (row["found"], row["others"], row["shift"]) == ("9 of 10", "1 of 90", "0.03 ± 0.01")
    assert row["off"] == "0.4"
    turned = {"name": "a", "shift": [-value for value in captures.pair_of("pose", "a", captures.TURNED)]}
    assert captures.error_of(turned) == 0
    assert "found" not in captures.fault_row("fox", "none", [found[0] | {"bad": 0, "found": 0}])


# -- whole commands ------------------------------------------------------------------------------------------------

TINY = ["scene.width=32", "scene.height=24", "scene.points=50", "scene.train_views=2", "scene.test_views=1"]
TINY += ["scene.samples=1", "iterations=2", "training.test_points=0", "eval.flight=false"]
TINY += ["rasterizer=eager", "device=cpu"]


def test_whole_commands_are_run_once_and_told_by_their_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import commands
    from gsx.cli.dispatch import main
    from measuring import runs

    asked: list[list[str]] = []

    def gsx(words: list[str], *rest: object) -> None:
        asked.append(words)
        assert main(words) == 0  # here, which spares the start of a process

    monkeypatch.setattr(runs, "gsx", gsx)
    words = ["--only", "demo", "--runs", str(tmp_path / "runs"), "--to", str(tmp_path), *TINY]
    commands.main(words)
    commands.main(words)
    assert [words[:2] for words in asked] == [["eval.zoom=[1,2,4]", "scene.width=32"]]
    [row] = read_sections(tmp_path / "commands_cpu.json")["commands"]["rows"]
    evaluation = json.loads((tmp_path / "runs" / "demo" / "evaluation.json").read_text())
    assert row["command"].startswith("`gsx 'eval.zoom=[1,2,4]' scene.width=32")
    assert (row["state"], row["steps"], row["primitives"]) == ("ok", 2, evaluation["primitives"])
    assert row["x1"] == f"{evaluation['psnr']:.2f}"
    finest = evaluation["zoom"]["4"]
    assert row["x4"] == f"{finest['psnr']:.2f} ({finest['enlarged_psnr']:.2f})"
    assert 0 <= row["evaluating"] <= row["whole"]


def test_seconds_of_evaluation_are_those_told_or_between_lines_of_the_log(tmp_path: Path) -> None:
    from measuring.runs import evaluate_seconds

    (tmp_path / "log.txt").write_text(
        "2026-11-22 23:59:00,500 INFO evaluating 1 test views at zoom [1.0]\n"  # an earlier `gsx eval`
        "2026-11-22 23:59:50,500 INFO evaluating 10 test views at zoom [1.0, 2.0]\n"
        "2026-11-23 00:00:10,000 INFO held-out PSNR 11.47 dB\n"
        "a line of a message that has several\n"
    )
    assert evaluate_seconds(tmp_path, {}) == 19.5
    assert evaluate_seconds(tmp_path, {"evaluate_seconds": 3.25}) == 3.25
    (tmp_path / "log.txt").write_text("nothing\n")
    assert evaluate_seconds(tmp_path, {}) is None


def test_a_multirun_over_processes_is_compared_within_its_rounds() -> None:
    import sweep

    table = sweep.section({"one after the other": [10.0, 30.0, 20.0], "processes": [5.0, 10.0, 16.0]}, 0.0, "")
    alone, together = table["rows"]
    assert (alone["seconds"], together["seconds"]) == ("20.0", "10.0")
    assert "ratio" not in alone
    assert together["ratio"] == "2.00 (1.25 to 3.00)"  # 10/5, 30/10, 20/16


def test_the_capture_for_memory_is_read_with_its_cameras(tmp_path: Path) -> None:
    import memory
    from gsx.builtin import plugins
    from gsx.experiments.runs.compose import compose
    from gsx.experiments.runs.load_scene import load_scene

    memory.make_capture(tmp_path, photos=6, size=(64, 48))
    scene = load_scene(compose([*memory.SUBJECTS["many"], f"scene.path={tmp_path}"], plugins()))
    assert [view.camera.size for view in scene.train] == [(64, 48)] * 6
    for view in scene.train:
        assert view.image().shape == (3, 48, 64)
        places, depths = view.camera.project(torch.zeros(1, 3))
        assert torch.allclose(places, torch.tensor([[32.0, 24.0]]), atol=1e-3)
        assert float(depths) == pytest.approx(math.hypot(3, 0.5), rel=1e-5)


def test_thirds_of_a_photo_have_as_many_pixels_each() -> None:
    """Of a pinhole as well as of a lens whose angles are its distances from the axis."""
    import lenses
    from gsx.core.data.camera import look_at
    from gsx.lenses.models import Distortion

    pinhole = look_at((0, -3, 0), (0, 0, 0), fov_x=1.2, width=60, height=50)
    for camera in (pinhole, replace(pinhole, lens=Distortion(fisheye=True))):
        borders, angle = lenses.borders_of(camera), lenses.tangents(camera)
        counts = [int(((angle >= low) & (angle < high)).sum()) for low, high in itertools.pairwise(borders)]
        assert sum(counts) == 3000
        assert max(counts) - min(counts) <= 30  # pixels at equal distances are not divided
    assert float(lenses.tangents(pinhole)[0, 0]) == pytest.approx(math.hypot(29.5, 24.5) / pinhole.fx, rel=1e-5)
    radius = math.hypot(29.5, 24.5) / camera.fx
    assert float(lenses.tangents(camera)[0, 0]) == pytest.approx(math.tan(radius), rel=1e-5)


def test_the_level_of_marked_pixels() -> None:
    import lenses

    psnr = lenses.decibels(torch.tensor([[0.01, 0.04], [0.0001, 9.0]]))
    assert psnr(torch.tensor([[True, False], [False, False]])) == pytest.approx(20)
    assert psnr(torch.tensor([[True, True], [False, False]])) == pytest.approx(-10 * math.log10(0.025))


def test_a_phase_has_the_largest_of_its_peaks(monkeypatch: pytest.MonkeyPatch) -> None:
    import memory

    readings = iter([5e6, 3e6, 7e6])
    monkeypatch.setattr(memory, "host_peak", lambda: next(readings))
    monkeypatch.setattr(memory, "forget_peak", lambda: None)
    peaks = memory.Peaks()
    peaks.gsx_run_started(SimpleNamespace(scene=SimpleNamespace(train=[])))
    views = SimpleNamespace(raster_scale={1: 1, 2: 2}.get)
    for number in (1, 2):
        peaks.gsx_step_finished(SimpleNamespace(step=number, views=views))
    assert peaks.phases == {"start": 5, "steps": 3, "finer steps": 7, "evaluation": 0}


def test_shared_cores_are_compared_within_a_round() -> None:
    import shared_cores

    row = shared_cores.row_of("another run", {"before": [30.0, 10.0, 80.0], "now": [10.0, 8.0, 20.0]})
    assert (row["before"], row["now"], row["ratio"]) == (30.0, 10.0, "3.00 (1.25 to 4.00)")


def test_trades_are_trained_and_the_page_is_written_from_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import trades
    from gsx.cli.dispatch import main
    from measuring import runs

    monkeypatch.setattr(runs, "gsx", lambda words, *rest: main(words))  # here, which spares the start of a process
    monkeypatch.setitem(trades.SUBJECTS, "demo", ("scene=demo", *TINY))
    page = tmp_path / "page.md"
    page.write_text("# Above\n\n<!-- demo: written by benchmarks/trades.py -->\n| old |\n\n## Below\n")
    words = ["--only", "demo,fox", "--trades", "colour", "--runs", str(tmp_path / "runs"), "--to", str(tmp_path)]
    trades.main([*words, "--page", str(page)])
    rows = read_sections(tmp_path / "trades_cpu.json")["demo"]["rows"]
    assert [row["setting"] for row in rows] == ["as given", "SH degree 1"]
    folders = [tmp_path / "runs" / "demo" / f"SH_degree_1_{seed}" for seed in (0, 1)]
    one, two = (json.loads((folder / "evaluation.json").read_text())["psnr"] for folder in folders)
    assert rows[1]["x1"] == f"{(one + two) / 2:.2f} ± {abs(one - two) / 2:.2f}"
    text = page.read_text()
    assert text.startswith("# Above\n\n<!-- demo")
    assert text.endswith("\n\n## Below\n")
    assert f"| SH degree 1 | {rows[1]['x1']} |" in text
    assert "old" not in text
    page.write_text(text.replace("SH degree 1", "something"))
    trades.main(["--page-only", "--to", str(tmp_path), "--page", str(page)])
    assert page.read_text() == text


def test_settings_of_trades_compose_and_scale_steps() -> None:
    import trades
    from gsx.builtin import plugins
    from gsx.experiments.runs.compose import Compositions

    with Compositions(plugins()) as compositions:
        for name, words in trades.settings_of_trades(",".join(trades.TRADES), 900).items():
            settings = compositions.settings(["backbone=gs3d", trades.ADAPTIVE, *words])
            steps = {trades.HALF: 450, trades.TWICE: 1800}.get(name)
            assert steps is None or settings.general.iterations == steps


def test_fronts_of_trades_by_hand() -> None:
    """Means over seeds at x4, MB in the mean, seconds of the last seed."""
    import trades

    def run(x4: float, megabytes: float, seconds: float) -> dict:
        return {"zoom": {"4": {"psnr": x4}}, "megabytes": megabytes, "train_seconds": seconds}

    settings = [[run(26.0, 20, 90), run(26.2, 20, 100)], [run(26.3, 5, 60), run(26.5, 6, 80)], [run(25, 20, 50)] * 2]
    assert trades.fronts_of(settings) == {"time": [2, 1], "MB": [1]}


def test_settings_of_the_rasterizer_are_measured_against_float64(tmp_path: Path) -> None:
    """The base settings are within rounding; what changes the picture is further off; formats that fail are named."""
    import trades

    words = ["--what", "rasterizer", "--quick", "--paths", "eager", "--to", str(tmp_path)]
    trades.main([*words, "rasterizer.alpha_max=0.995"])
    rows = read_sections(tmp_path / "trades_rasterizer_cpu_quick.json")["settings"]["rows"]
    by_name = {row["setting"]: row for row in rows}
    assert rows[0]["setting"] == "base settings"
    assert rows[0]["ratio"] == 1.0
    assert rows[0]["max_error"] < 2e-6
    assert by_name["evaluation=float64"]["gradient"] < 1e-5
    assert by_name["alpha_min=0.016"]["max_error"] > 0.005
    assert by_name["pixel=window"]["most_error"] > 0.001
    assert any(row.get("front") == "yes" for row in rows)
    assert len(by_name) == len(rows)


@pytest.mark.parametrize("cuda", [False, True])
@pytest.mark.parametrize("cull", ["published", "tight"])
def test_changes_of_the_rasterizer_are_valid_settings(cull: str, cuda: bool) -> None:
    base = any_path(cull=cull)
    changes = knobs.changes_of(base, ["eager", "compiled"], cuda)
    assert changes[:2] == [{}, {"path": "compiled"}]
    assert all(replace(base, **change) != base for change in changes[1:])
    assert ({"tile_size": 32} in changes) == (cull == "tight")
    assert {"path": "compiled", "schedule": "chunks" if cuda else "segments"} in changes
    assert not any("path" in change for change in knobs.changes_of(base, ["eager"], cuda))


def test_errors_of_a_picture_made_by_hand() -> None:
    """Of 20,000 pixels 2 may be left out, so that the third largest counts; channels of a pixel count once."""
    shot = knobs.shots_of(None, 1, quick=True, device=CPU)[0][0]
    fields = {name: torch.ones_like(value).double() for name, value in vars(shot.splats).items()}
    truth = {"image": torch.zeros(3, 100, 200, dtype=torch.float64)} | fields
    image = torch.zeros(3, 100, 200)
    image[0, 0, 0], image[1, 0, 0], image[2, 5, 5], image[1, 99, 199], image[0, 50, 50] = 0.5, -0.25, -0.4, 0.25, 0.125
    errors = knobs.errors_of([shot], [truth | {"image": image, "colours": 1.25 * fields["colours"]}], [truth])
    assert (errors["max_error"], errors["most_error"]) == (0.5, 0.25)
    assert (errors["gradient"], errors["field"]) == (pytest.approx(0.25), "colours")
    squares = 0.5**2 + 0.25**2 + 0.4**2 + 0.25**2 + 0.125**2
    assert errors["psnr"] == pytest.approx(10 * math.log10(60000 / squares))


def test_orientations_of_round_splats_count_against_their_scales() -> None:
    truth = {"scales": torch.full((1, 3), 10.0).double(), "quats": torch.zeros(1, 4).double()}
    picture = {"scales": truth["scales"], "quats": torch.tensor([[1e-6, 0, 0, 0]])}
    error, field = knobs.gradient_error([picture], [truth], [torch.full((1, 3), 0.1)])
    assert (error, field) == (pytest.approx(1e-6 / (1e-3 * math.sqrt(3) * 10 * 0.1)), "quats")


def test_the_page_of_trades_is_that_of_the_committed_figures() -> None:
    import trades

    text = trades.PAGE.read_text()
    assert trades.page(text, read_sections(benchmark.RESULTS / "trades_cpu.json")) == text


def test_starts_tell_training_views_beside_held_out_ones(tmp_path: Path) -> None:
    import starts

    def run(psnr: float, seen: float, primitives: int, seconds: float) -> dict[str, object]:
        zooms = {zoom: {"psnr": psnr - float(zoom)} for zoom in ("1", "2", "4")}
        return {"zoom": zooms, "seen": seen, "primitives": primitives, "train_seconds": seconds}

    one = {arm: run(30.0, 33.0, 100, 10.0) for arm in starts.ARMS} | {"adaptive": run(31.5, 31.0, 40, 5.0)}
    two = {arm: run(30.4, 33.0, 100, 10.0) for arm in starts.ARMS} | {"adaptive": run(31.5, 31.0, 60, 5.0)}
    first, _, third, *_ = starts.rows_of("room", [one, two])
    assert (first["gap"], third["gap"]) == ("+3.80 ± 0.20", "+0.50 ± 0.00")
    assert (third["more1"], third["share"], third["times"]) == ("+1.30 ± 0.20", "0.50", "0.50")
    lines = [{"step": step, "psnr": float(step)} for step in range(1, 101)] + [{"step": 100, "test_psnr": 1.0}]
    (tmp_path / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert starts.seen_in_training(tmp_path) == sum(range(91, 101)) / 10


def test_runs_in_fewer_steps_are_compared_with_published_ones_in_all_of_theirs() -> None:
    import sooner

    def run(psnr: float, gap: float, seconds: float) -> dict[str, object]:
        zooms = {zoom: {"psnr": psnr - float(zoom)} for zoom in ("1", "2", "4")}
        return {"zoom": zooms, "gap": gap, "primitives": 100, "train_seconds": seconds}

    published, short = ("gs3d", 1.0), ("gs3d_zoom", 0.5)
    arms = sooner.arms_of("demo")
    found = [{arm: run(30.0, 0.8, 20.0) for arm in arms} | {short: run(31.0 + seed, 0.2, 11.0)} for seed in (0, 1)]
    rows = {(row["arm"], row["steps"]): row for row in sooner.rows_of("demo", found)}
    assert set(rows) == {("gs3d", 900), ("gs3d_zoom", 675), ("gs3d_zoom", 450)}
    assert rows["gs3d_zoom", 450]["more4"] == "+1.50 ± 0.50"
    assert (rows["gs3d_zoom", 450]["times"], rows["gs3d_zoom", 450]["gap"]) == ("0.55", "+0.20 ± 0.00")
    assert (sooner.steps_of("demo", published[1]), sooner.steps_of("fox_4", short[1])) == (900, 750)


def test_a_stage_within_another_stops_its_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter([0.0, 1.0, 3.0, 6.0, 6.5, 10.0])
    monkeypatch.setattr(stages.time, "perf_counter", lambda: next(now))
    clock = stages.StageClock()
    inner = clock.clocked("inner", lambda: 7)
    with clock.stage("outer"):  # begins at 0
        assert inner() == 7  # 1 to 3
        inner()  # 6 to 6.5
    assert clock.seconds == {"outer": 1 + 3 + 3.5, "inner": 2 + 0.5}


def test_a_stage_is_slower_beyond_a_tenth_and_half_a_millisecond() -> None:
    def row(old: float | None, now: float) -> dict[str, object]:
        return {"backbone": "gs3d", "stage": "loss", "old": old, "ms": now}

    assert step.slower([row(10.0, 10.9), row(1.0, 1.4), row(10.0, 5.0), row(None, 5.0)]) == []
    assert step.slower([row(10.0, 11.2)]) == ["gs3d, loss: 10.0 ms before, 11.2 now"]


@pytest.mark.skipif(not compiled.available(), reason="no working compiler on this machine")
def test_loops_are_timed_by_the_names_they_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsx.engine.lanes.chunks_at_most", lambda lengths, chunk: 1)
    settings, own = replace(settings_of("compiled"), unrolled=2), compiled.compiled_loop
    screen = learnable(project(splats_of(CASE, CPU), camera_of(CASE), settings))
    with loops_timed() as spent:
        picture, _ = blend_screen(screen, camera_of(CASE), settings)
        picture.sum().backward()
    assert set(spent) == {name for names in LOOPS.values() for name in names}
    assert min(spent.values()) > 0
    assert compiled.compiled_loop is own


@pytest.mark.parametrize(("module", "path"), [place[1:] for place in stages.PLACES])
def test_stages_begin_with_functions_that_exist(module: str, path: str) -> None:
    """A stage whose function was renamed would count as everything else."""
    assert callable(attrgetter(path)(import_module(module)))


def test_least_times_of_stages_by_hand() -> None:
    limits = [Limit("copy", 1e9, "B/s"), Limit("fma", 1e10, "flop/s"), Limit("exp", 1e9, "exp/s")]
    counts = {"primitives": 1000, "numbers": 59000, "shown": 500, "pairs": 2000, "pixels": 100}
    least = step.least_times(counts, limits)
    assert least["Adam"] == (pytest.approx(59000 * 28 / 1e9 * 1e3), "memory")
    evaluations = 64 * 2000
    forward = evaluations / 1e9 + evaluations * sum(FORWARD_FLOPS.values()) / 1e10
    assert least["blending"] == (pytest.approx(1e3 * forward), "arithmetic")
