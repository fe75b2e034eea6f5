"""Pictures of a run of four splats against an analytic truth: what is written, and that crops are crops."""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn import Parameter

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.images import image_size, read_image
from gsx.core.data.resize import linear_from_display, to_uint8
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.data.window import Window
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.quality.metrics import bicubic, psnr, quantise, ssim
from gsx.core.rasterizer import RasterSettings, Rendering, TiledRendering
from gsx.core.training.backbone import DrawnSplats
from gsx.core.training.parameter_table import ParameterTable
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.render import render
from gsx.core.training.run import Progress, Run, TrainingOptions
from gsx.core.training.sampler import Sampler
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.evaluation import evaluated_renders
from gsx.experiments.evaluation.competitor import competitor_for, context_of
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.reports import pictures
from gsx.experiments.reports.pictures import (
    Pictures,
    colour_ramp,
    error_map,
    extremes,
    file_names,
    most_detailed,
    reduced,
    spread,
)
from gsx.regenerators.classical import PlainOptions, Resampled

WIDTH, HEIGHT = 80, 64


class FourSplats:
    """A backbone that hands out four fixed splats."""

    def draw(self, camera: Camera, step: int) -> DrawnSplats:
        splats = Splats(
            means=torch.tensor([[-0.5, 0, 0], [0.4, 0.2, 0.1], [0, -0.4, 0.3], [0.2, 0.5, -0.2]]),
            scales=torch.tensor([[0.2, 0.1, 0.1], [0.05, 0.3, 0.1], [0.15, 0.15, 0.15], [0.1, 0.02, 0.1]]),
            quats=torch.tensor([[1.0, 0, 0, 0], [0.9, 0.1, 0.2, 0], [1, 0, 0, 0], [0.7, 0, 0, 0.7]]),
            log_opacities=torch.tensor([0.9, 0.8, 0.7, 0.95]).log(),
            colours=torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.2, 0.3, 0.9], [1, 1, 0.2]]),
        )
        return DrawnSplats(splats=splats, rows=None)

    table = ParameterTable({"means": Parameter(torch.zeros(4, 3))})
    raster = RasterSettings()
    absolute_gradient = False

    def regulariser(self, drawn: DrawnSplats) -> None: ...

    def observe(self, drawn: DrawnSplats, rendering: Rendering, step: int, weight: float = 1.0) -> dict[str, Tensor]:
        return {}

    def accumulate(self, seen: dict[str, Tensor]) -> None: ...

    def densify_and_prune(self, step: int) -> dict[str, int]:
        return {}

    def update(self, step: int) -> None: ...

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        raise NotImplementedError


class Stripes:
    """Truth at any zoom: grey, and fine diagonal stripes in the lower right quarter, as slopes of the viewing rays."""

    def __init__(self, finest: float = math.inf) -> None:
        self.finest = finest

    def image(self, camera: Camera) -> Tensor:
        x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        wave = 0.5 + 0.4 * torch.sin(300 * (x[None, :] + y[:, None]))
        inside = (x[None, :] > 0.05) & (y[:, None] > 0.05)
        grey = torch.where(inside, wave, 0.5)
        return (grey * 255).to(torch.uint8).expand(3, -1, -1)

    def max_zoom(self, camera: Camera) -> float:
        return self.finest


def cameras(count: int) -> list[Camera]:
    """On an arc around the splats."""
    eyes = [(2 * math.sin(a), -0.3, -2 * math.cos(a)) for a in torch.linspace(0, 1, count).tolist()]
    return [look_at(eye, (0, 0, 0), up=(0, -1, 0), fov_x=1, width=WIDTH, height=HEIGHT) for eye in eyes]


def make_run(folder: Path, views: int = 3, finest: float = math.inf) -> Run:
    test = [View(f"shots/{i}.png", camera, Stripes(finest)) for i, camera in enumerate(cameras(views))]
    scene = Scene(
        name="stripes",
        train=test,
        test=test,
        points=PointCloud(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8)),
        background=torch.tensor([0.5, 0.5, 0.5]),
        extent=1.0,
    )
    training = TrainingOptions(
        ssim_weight=0.2, random_background=False, log_every=1, checkpoint_every=1, checkpoints_kept=1, test_points=0
    )
    generator = torch.Generator().manual_seed(0)
    return Run(
        config={},
        folder=folder,
        backbone=FourSplats(),
        raster=RasterSettings(),
        training=training,
        iterations=10,
        photos=PhotoCache(torch.device("cpu")),
        generator=generator,
        views=TrainingViews(scene=scene),
        sampler=Sampler(views, 0),
        progress=Progress(step=10),
    )


OPTIONS = EvalOptions(
    zoom=[1, 2, 4],
    quantise=True,
    ssim="inria",
    tile_pixels=1 << 20,
    lpips=LpipsOptions(trunk="", head="", net="vgg", input_range="unit"),
)


def figures(run: Run, *, zoom: tuple[float, ...] = (1, 2, 4), psnrs: list[float] | None = None) -> dict[str, Any]:
    """The parts of evaluation.json that pictures are made from."""
    known = psnrs or [20.0 + i for i in range(len(run.scene.test))]
    views = [
        {"name": view.name, "group": "", "psnr": value, "ssim": 0.5, "lpips": None, "perceptual": {}}
        for view, value in zip(run.scene.test, known, strict=True)
    ]
    return {"views": views, "zoom": {str(factor): {"psnr": 20.0} for factor in zoom}}


def write_pictures(run: Run, options: EvalOptions, evaluation: dict[str, Any]) -> None:
    """Draw a run as an evaluation does that has found these figures."""
    evaluator = Evaluator(run, replace(options, zoom=[float(factor) for factor in evaluation["zoom"]]))
    drawing = Pictures(run.folder / "renders", run.step)
    evaluator.views()
    drawing.choose(evaluation["views"])
    evaluator.zooms(evaluation["views"], drawing)
    drawing.write_index()


def read_index(run: Run) -> dict[str, Any]:
    return json.loads((run.folder / "renders" / "index.json").read_text())


def stored(run: Run, file: str) -> Tensor:
    return read_image(run.folder / "renders" / file).float() / 255


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = make_run(tmp_path)
    write_pictures(run, OPTIONS, figures(run))
    return run


def test_the_index_lists_exactly_the_files_there_are(run: Run) -> None:
    index = read_index(run)
    listed = [file for entry in [*index["views"], *index["zoom"]] for file in entry["files"].values()]
    assert sorted([*listed, "index.json"]) == sorted(path.name for path in (run.folder / "renders").iterdir())
    assert len(listed) == 3 * 3 + 3 * 2 * 3
    assert index["views"][0]["files"]["truth"] == "shots_0.truth.png"
    assert {file for file in listed if ".x4." in file} == {
        f"shots_{i}.x4.{kind}.png" for i in range(3) for kind in ("truth", "render", "enlarged")
    }


def test_whole_views_are_the_truth_and_the_measured_render(run: Run) -> None:
    for view, entry in zip(run.scene.test, read_index(run)["views"], strict=True):
        shown = quantise(render(run, view.camera).image)
        assert torch.equal(stored(run, entry["files"]["truth"]), view.image())
        assert torch.equal(stored(run, entry["files"]["render"]), shown)
        assert (stored(run, entry["files"]["error"]) - error_map(shown, view.image())).abs().max() < 0.6 / 255
        assert entry["name"] == view.name
        assert entry["size"] == [WIDTH, HEIGHT]


def test_zoomed_crops_are_crops_of_the_whole_zoomed_pictures(run: Run) -> None:
    view = run.scene.test[1]
    for entry in read_index(run)["zoom"][2:4]:
        finer = view.zoom(entry["factor"])
        assert finer is not None
        window = Window(*entry["window"])
        whole = {
            "truth": finer.image(),
            "render": quantise(render(run, finer.camera).image),
            "enlarged": bicubic(quantise(render(run, view.camera).image), *finer.camera.size),
        }
        assert entry["view"] == view.name
        for kind, image in whole.items():
            slack = 0.51 / 255 if kind == "enlarged" else 0
            assert (stored(run, entry["files"][kind]) - window.cut(image)).abs().max() <= slack


def test_crops_seen_from_afar_and_at_odd_zooms(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    write_pictures(run, OPTIONS, figures(run, zoom=(0.25, 1, 1.5)))
    entries = read_index(run)["zoom"]
    assert [entry["factor"] for entry in entries] == [0.25, 1.5] * 3
    for entry in entries:
        view = next(view for view in run.scene.test if view.name == entry["view"])
        zoomed = view.zoom(entry["factor"])
        assert zoomed is not None
        window, pair = Window(*entry["window"]), (stored(run, entry["files"][kind]) for kind in ("truth", "enlarged"))
        resized = bicubic(quantise(render(run, view.camera).image), *zoomed.camera.size)
        for image, whole in zip(pair, (zoomed.image(), resized), strict=True):
            assert (image - window.cut(whole)).abs().max() <= 0.51 / 255


def test_crops_carry_the_psnr_of_what_is_shown(run: Run) -> None:
    for entry in read_index(run)["zoom"]:
        truth, render, enlarged = (stored(run, entry["files"][kind]) for kind in ("truth", "render", "enlarged"))
        assert entry["psnr"] == pytest.approx(psnr(render, truth))
        assert entry["enlarged_psnr"] == pytest.approx(psnr(enlarged, truth))


def test_crops_show_what_an_upscaler_makes_of_the_x1_render(tmp_path: Path) -> None:
    """Lanczos' filter with three lobes, and PIL's."""
    run = make_run(tmp_path, views=1)
    options = replace(OPTIONS, zoom=[2], pairs=0)
    competitor = competitor_for(
        run.scene, "lanczos", lambda: Resampled(PlainOptions(name="lanczos")), options.zoom, context_of(run, "lanczos")
    )
    drawing = Pictures(run.folder / "renders", run.step)
    Evaluator(run, options, competitor).evaluate(drawing)
    drawing.write_index()
    (entry,) = read_index(run)["zoom"]
    upscaled, truth = (stored(run, entry["files"][kind]) for kind in ("upscaled", "truth"))
    assert entry["upscaled_psnr"] == pytest.approx(psnr(upscaled, truth))
    [view] = run.scene.test
    whole = Image.fromarray(to_uint8(render(run, view.camera).image).permute(1, 2, 0).numpy())
    larger = whole.resize((2 * whole.width, 2 * whole.height), Image.Resampling.LANCZOS)
    expected = torch.from_numpy(numpy.array(larger)).permute(2, 0, 1) / 255
    assert (upscaled - Window(*entry["window"]).cut(expected)).abs().max() <= 1.01 / 255


def test_crops_show_the_detail(run: Run) -> None:
    for entry in read_index(run)["zoom"]:
        if entry["factor"] == 4:  # 320 x 256 with stripes right of column 172 and below row 140
            assert entry["window"][0] > 100
            assert entry["window"][1] == 256 - 192
            assert entry["window"][2:] == [192, 192]


def test_a_crop_is_no_larger_than_the_raster(run: Run) -> None:
    assert [entry["window"] for entry in read_index(run)["zoom"] if entry["factor"] == 2] == [[0, 0, 160, 128]] * 3


def test_best_and_worst_are_drawn_and_named(tmp_path: Path) -> None:
    run = make_run(tmp_path, views=9)
    write_pictures(run, OPTIONS, figures(run, zoom=(1,), psnrs=[5.0, 5, 9, 5, 5, 5, 1, 5, 5]))
    index = read_index(run)
    assert len(index["views"]) == pictures.DRAWN_VIEWS
    roles = {entry["name"]: entry["role"] for entry in index["views"]}
    assert roles["shots/2.png"] == "best"
    assert roles["shots/6.png"] == "worst"
    assert sorted(roles.values()) == ["", "", "", "", "best", "worst"]
    assert index["zoom"] == []


def test_zooms_without_truth_are_left_out(tmp_path: Path) -> None:
    run = make_run(tmp_path, finest=2)
    evaluation = figures(run)
    evaluation["zoom"]["4"] = {"unavailable": "no truth at x4"}
    write_pictures(run, OPTIONS, evaluation)
    assert {entry["factor"] for entry in read_index(run)["zoom"]} == {2}
    write_pictures(run, OPTIONS, figures(run))
    assert {entry["factor"] for entry in read_index(run)["zoom"]} == {2}


def test_pictures_of_an_earlier_evaluation_are_removed_and_others_left(run: Run) -> None:
    other = run.folder / "renders" / "mine.png"
    other.write_bytes(b"kept")
    write_pictures(run, OPTIONS, figures(run, zoom=(1, 2)))
    assert other.read_bytes() == b"kept"
    assert not list((run.folder / "renders").glob("*.x4.*"))
    assert len(list((run.folder / "renders").glob("*.x2.*"))) == 9


def test_pictures_of_an_evaluation_that_broke_off_are_removed(run: Run) -> None:
    (run.folder / "renders" / "index.json").unlink()
    left = run.folder / "renders" / "gone.x8.enlarged.png"
    left.write_bytes(b"")
    write_pictures(run, OPTIONS, figures(run))
    assert not left.exists()


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"views": [{"files": {"render": null}}], "zoom": []}'])
def test_an_index_that_is_none_is_replaced(run: Run, content: str) -> None:
    (run.folder / "renders" / "index.json").write_text(content)
    write_pictures(run, OPTIONS, figures(run))
    assert len(read_index(run)["views"]) == 3


def test_equal_images_have_no_number_in_json(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    write_pictures(run, OPTIONS, figures(run, psnrs=[math.inf, 20.0, 21.0]))
    assert "Infinity" not in (run.folder / "renders" / "index.json").read_text()
    assert [entry["psnr"] for entry in read_index(run)["views"]] == [None, 20, 21]


def test_nothing_is_rendered_or_traced_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered: Counter[tuple[int, int]] = Counter()
    traced: Counter[tuple[int, int]] = Counter()

    def counted(run: Run, camera: Camera, pixels: int, supersample: int) -> TiledRendering:
        rendered[camera.size] += 1
        return render(run, camera, pixels, supersample)

    def image(self: Stripes, camera: Camera) -> Tensor:
        traced[camera.size] += 1
        return plain(self, camera)

    plain = Stripes.image
    monkeypatch.setattr(evaluated_renders, "render", counted)
    monkeypatch.setattr(Stripes, "image", image)
    run = make_run(tmp_path)
    Evaluator(run, OPTIONS).evaluate(Pictures(tmp_path / "renders", run.step))
    assert rendered == {(80, 64): 3, (160, 128): 3, (320, 256): 3}
    assert traced[160, 128] == traced[320, 256] == 3


def test_progress_tells_of_all_work(tmp_path: Path) -> None:
    told: list[tuple[float, str]] = []
    for finest, work in ((math.inf, 3 * (1 + 4 + 16)), (2, 3 * (1 + 4))):
        evaluator = Evaluator(make_run(tmp_path, finest=finest), OPTIONS)
        evaluator.evaluate(advance=lambda amount, part: told.append((amount, part)))
        assert evaluator.work() == sum(amount for amount, _ in told) == work
        told.clear()


def test_figures_are_those_of_each_picture_by_itself(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    evaluation = Evaluator(run, OPTIONS).evaluate()
    views = run.scene.test
    small = {view: quantise(render(run, view.camera).image) for view in views}
    for factor in (1, 2, 4):
        expected = []
        for view in views:
            finer = view.zoom(factor)
            assert finer is not None
            shown = quantise(render(run, finer.camera).image)
            enlarged = quantise(bicubic(small[view], *finer.camera.size))
            expected.append([f(i, finer.image()) for i in (shown, enlarged) for f in (psnr, inria)])
        entry = evaluation["zoom"][str(factor)]
        means = [sum(column) / len(views) for column in zip(*expected, strict=True)]
        told = [entry[key] for key in ("psnr", "ssim", "enlarged_psnr", "enlarged_ssim")]
        assert told == pytest.approx(means, abs=1e-9)
        assert entry["beats_enlarged"] == (None if factor == 1 else means[0] > means[2])


def inria(image: Tensor, truth: Tensor) -> float:
    return ssim(image, truth, "inria")


# -- parts ---------------------------------------------------------------------------------------------------------


def test_errors_are_black_to_bright_and_saturate() -> None:
    truth = torch.full((3, 1, 4), 0.5)
    image = truth + torch.tensor([0, 0.1, 0.2, 0.4])
    image[0, 0, 1] -= 0.03  # mean over the channels: 0.09
    shown = error_map(image, truth)
    ends = [torch.tensor(colour) / 255 for _, colour in pictures.ERROR_COLOURS]
    assert torch.allclose(shown[:, 0, 0], ends[0])
    assert torch.allclose(shown[:, 0, 2], ends[-1])
    assert torch.allclose(shown[:, 0, 3], ends[-1])
    lower, upper = ends[2], ends[3]  # 0.09 / 0.2 = 0.45 lies between 0.32 and 0.47
    assert torch.allclose(shown[:, 0, 1], torch.lerp(lower, upper, (0.45 - 0.32) / (0.47 - 0.32)), atol=1e-5)


def test_lightness_of_the_ramp_rises_evenly() -> None:
    values = torch.linspace(0, 1, 101)
    light = linear_from_display(colour_ramp(values[None])[:, 0])
    luminance = light.T @ torch.tensor([0.2126, 0.7152, 0.0722])  # IEC 61966-2-1
    lightness = torch.where(luminance > 216 / 24389, 116 * luminance.pow(1 / 3) - 16, luminance * 24389 / 27)  # CIE L*
    assert (lightness.diff() > 0).all()
    assert (lightness / lightness[-1] - values).abs().max() < 0.03


def test_the_most_detailed_window() -> None:
    image = torch.full((3, 100, 120), 0.5)
    image[:, 40:56, 80:96] = (torch.arange(256).view(16, 16) % 2).float()
    assert most_detailed(image, 16) == Window(80, 40, 16, 16)
    assert most_detailed(image, 500) == Window(0, 0, 120, 100)
    assert most_detailed(image[:, :56, 31:98], 48) == Window(67 - 48, 56 - 48, 48, 48)
    assert most_detailed(image[:, :3, :5], 48) == Window(0, 0, 5, 3)


def test_large_pictures_are_reduced_and_light() -> None:
    wide = torch.rand(3, 10, 4000)
    assert reduced(wide).shape == (3, 4, pictures.PICTURE_WIDTH)
    assert float(reduced(wide).mean()) == pytest.approx(float(wide.mean()), abs=0.01)
    assert torch.equal(reduced(wide[:, :, :1600]), wide[:, :, :1600])


def test_large_pictures_are_jpeg_and_crops_never(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "LOSSLESS_PIXELS", WIDTH * HEIGHT - 1)
    run = make_run(tmp_path, views=1)
    write_pictures(run, OPTIONS, figures(run))
    index = read_index(run)
    assert {Path(file).suffix for file in index["views"][0]["files"].values()} == {".jpg"}
    assert {Path(file).suffix for entry in index["zoom"] for file in entry["files"].values()} == {".png"}
    assert image_size(tmp_path / "renders" / index["views"][0]["files"]["truth"]) == (WIDTH, HEIGHT)


def test_which_views_are_shown() -> None:
    assert spread(3, 6, {0, 2}) == [0, 1, 2]
    assert spread(11, 6, {0, 10}) == [0, 2, 4, 6, 8, 10]
    assert spread(100, 6, {17, 18}) == [0, 17, 18, 20, 40, 59]
    assert spread(1, 6, {0}) == [0]
    assert extremes([21.0, 30.0, 19.0]) == (1, 2)
    assert extremes([21.0, None, 19.0]) == (0, 1)


def test_file_names_are_safe_and_distinct() -> None:
    assert file_names(["a/b c.JPG", "a_b_c.png", "../x", "é", "r_0001"]) == ["a_b_c", "a_b_c_2", "x", "view", "r_0001"]
