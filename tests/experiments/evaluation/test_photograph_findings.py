"""Training photographs beside the model: shifts, gains and parts that are known, and what is said of them."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny import tiny_run
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsx.cli.dispatch import main
from gsx.core.data.camera import Camera
from gsx.core.data.resize import to_uint8
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.chosen_views import distinct
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.evaluation.lpips import LpipsOptions
from gsx.experiments.evaluation.photographs import Finding, concentrated, gains_of, remarks_on
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.runs.photo_check import findings_of, summary_lines
from gsx.modules.alignment import Motion, move_camera, rotation_by
from gsx.modules.image_shift import estimate_shift

PIXELS = 1 << 20


def waves(across: float = 0.0, down: float = 0.0) -> Tensor:
    """A smooth picture of 80 x 60 px, as it looks when it has moved by so many px."""
    x, y = torch.arange(80.0)[None] - across, torch.arange(60.0)[:, None] - down
    grey = 0.5 + 0.15 * (0.35 * x + 0.1 * y).sin() + 0.1 * (0.2 * x - 0.4 * y).sin() + 0.1 * (0.07 * x * 1.0).cos()
    return torch.stack([grey, 0.9 * grey, 0.8 * grey])


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.3, -0.7), (-2.5, 0.4)])
def test_a_shift_is_found_whatever_the_exposure(shift: tuple[float, float]) -> None:
    """To the accuracy of the interpolation between pixels."""
    found = estimate_shift(waves(), 0.6 * waves(*shift) + 0.05, None)
    assert found == pytest.approx(shift, abs=0.06)


def slow(across: float, down: float) -> Tensor:
    """A picture of 160 x 120 px with long waves under short ones, moved."""
    x, y = torch.arange(160.0)[None] - across, torch.arange(120.0)[:, None] - down
    long = 0.2 * (0.04 * x + 0.03 * y).sin() + 0.1 * (0.02 * x - 0.06 * y).cos()
    return torch.stack([0.5 + long + 0.05 * (0.7 * x + 0.2 * y).sin() * (0.3 * x - 0.8 * y).cos()] * 3)


def test_a_large_shift_is_found_coarse_to_fine() -> None:
    assert estimate_shift(slow(0, 0), slow(9, -7), None) == pytest.approx((9, -7), abs=0.1)


def test_a_shift_is_told_by_what_counts_and_hardly_by_what_stands_before_it() -> None:
    photograph, counted = waves(1.0, 0.5), torch.ones(60, 80, dtype=torch.bool)
    photograph[:, 20:32, 30:44] = 1.0
    assert estimate_shift(waves(), photograph, None) == pytest.approx((1.0, 0.5), abs=0.15)
    photograph[:, :, :40] = waves(-2.0, -2.0)[:, :, :40]
    counted[:, :45] = False
    assert estimate_shift(waves(), photograph, counted) == pytest.approx((1.0, 0.5), abs=0.03)


def test_what_is_plain_around_a_thing_does_not_hold_it() -> None:
    """A thing before white, most of the picture, which a blurred and noisy model shows as well as a photograph does."""

    def thing(across: float = 0.0, down: float = 0.0) -> Tensor:
        x, y = torch.arange(80.0)[None] - 40 - across, torch.arange(60.0)[:, None] - 30 - down
        near = torch.sigmoid(14 - (x.square() + y.square()).sqrt())
        return near * waves(across, down) + 1 - near

    generator = torch.Generator().manual_seed(0)
    learnt = avg_pool2d(thing()[None], 5, 1, 2, count_include_pad=False)[0]
    noise = 0.04 * torch.randn(learnt.shape, generator=generator) * (learnt.amin(0) < 0.95)
    assert estimate_shift(learnt + noise, thing(0.6, -0.4), None) == pytest.approx((0.6, -0.4), abs=0.1)


def test_a_spot_in_a_faint_picture_does_not_stand_for_all_of_it() -> None:
    """It alone has slopes to speak of, and stands still."""
    faint, moved = (0.5 + 0.05 * (picture - 0.5) for picture in (waves(), waves(1.3, -0.7)))
    faint[:, 30:33, 40:43] = moved[:, 30:33, 40:43] = 0.9
    assert estimate_shift(faint, moved, None) == pytest.approx((1.3, -0.7), abs=0.1)


def test_a_plain_picture_a_stripe_and_a_small_one_tell_no_shift() -> None:
    stripes = (0.4 * torch.arange(80.0)).sin().expand(3, 60, 80) / 2 + 0.5
    for picture in (torch.full((3, 60, 80), 0.5), stripes, waves()[:, :9, :9]):
        assert estimate_shift(picture, picture, None) is None


def test_gains_are_stops_of_each_channel() -> None:
    image = 0.2 + 0.3 * torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(0))
    photograph = image * torch.tensor([2.0, 1.0, 0.5])[:, None, None]
    photograph[:, :5] = 0.0
    assert gains_of(image, photograph, None) == pytest.approx((0.5 * 2, 0, -1), abs=1e-5)
    assert gains_of(image, torch.zeros_like(image), None) is None


def test_how_much_of_the_error_lies_in_few_squares() -> None:
    """64 squares, of which 3 are counted: one of error 1, all others of 0.1."""
    error = torch.full((64, 64), 0.1)
    error[8:16, 24:32] = 1.0
    assert concentrated(error, None) == pytest.approx((1 + 2 * 0.1) / (1 + 63 * 0.1))
    assert concentrated(torch.zeros(64, 64), None) == 0
    counted = torch.zeros(64, 64, dtype=torch.bool)
    counted[:32, :40] = True  # 20 squares, of which one is counted
    assert concentrated(error * counted, counted) == pytest.approx(1 / (1 + 19 * 0.1))


def finding(name: str, psnr: float = 30.0, stops: float = 0.0, **more: object) -> Finding:
    """One of the ordinary kind, but for `more`."""
    ordinary = {"shift": (0.05, 0.0), "concentrated": 0.3, "sharpness": 1.0, "masked": 0.0}
    return Finding(**{"name": name, "psnr": psnr, "gains": (stops, stops, stops), **ordinary, **more})


def test_what_is_said_of_photographs_against_the_others() -> None:
    findings = [
        *(finding(f"ordinary{i}", stops=0.1) for i in range(6)),
        finding("dark", stops=-0.4),
        finding("warm", gains=(0.4, 0.1, -0.2)),
        finding("moved", shift=(1.5, -2.0)),
        finding("blurred", sharpness=0.4),
        finding("passer-by", psnr=25.0, concentrated=0.8),
        finding("good, with a highlight", psnr=35.0, concentrated=0.8),
        *(finding(f"untold{i}", masked=0.25, gains=None, shift=None, sharpness=None) for i in range(20)),
    ]
    said = {one.name: told for one, told in zip(findings, remarks_on(findings, "never", False), strict=True)}
    assert [name for name, told in said.items() if told] == ["dark", "warm", "moved", "blurred", "passer-by"]
    assert said["dark"] == ["0.50 stops darker than the others: training.exposure.when=auto learns exposures"]
    assert said["warm"][0].startswith("its colours are balanced otherwise, channels by up to 0.60 stops")
    beside = "it is displaced by 2.5 px from its render (+1.5 across, -2.0 down): "
    assert said["moved"] == [beside + "training.poses.when=always corrects poses"]
    assert remarks_on(findings, "never", False, True)[8] == [beside + "even with its pose corrected"]
    assert "0.40 of its neighbours' fine contrast" in said["blurred"][0]
    assert said["passer-by"][0].startswith("80% of its error lies in 5% of it")
    assert remarks_on(findings, "auto", True)[6] == ["0.50 stops darker than the others: its exposure was learnt"]
    assert remarks_on(findings, "auto", False)[6][0].endswith("training.exposure.when=always learns exposures")


def test_where_all_poses_are_a_little_off_none_is_named() -> None:
    findings = [finding(str(i), shift=(0.8 * math.cos(i), 0.8 * math.sin(i))) for i in range(9)]
    assert not any(remarks_on(findings, "never", False))


# -- of a run ----------------------------------------------------------------------------------------------------------


class Taken:
    """A photograph that was taken already."""

    def __init__(self, picture: Tensor) -> None:
        self.picture = to_uint8(picture)

    def image(self, camera: Camera) -> Tensor:
        return self.picture

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    """A tiny run that is finished."""
    return tiny_run(tmp_path_factory.mktemp("photographs") / "run", ["iterations=3", "scene.train_views=8"])


def test_the_photographs_that_a_model_did_not_take_are_named(run: Run) -> None:
    """All are what the model shows, but for three: at half the light, 2 px to the right, with something white in it."""
    pictures, views = {}, run.scene.train
    for number, view in enumerate(views):
        camera = replace(view.camera, cx=view.camera.cx + 2) if number == 3 else view.camera
        pictures[view.name] = render(run, camera, PIXELS).image.detach().clamp(0, 1) * (0.5 if number == 1 else 1)
    pictures[views[5].name][:, 8:16, 16:24] = 1.0
    before = run.views
    photos = [replace(view, source=Taken(pictures[view.name])) for view in views]
    run.views = replace(before, scene=replace(run.scene, train=photos))
    try:
        found = {one.name: one for one in findings_of(run, PIXELS)}
    finally:
        run.views = before
    dark, shifted, covered = (found[views[number].name] for number in (1, 3, 5))
    assert {name for name, one in found.items() if one.remarks} == {dark.name, shifted.name, covered.name}
    assert dark.gains == pytest.approx((-1, -1, -1), abs=0.05)
    assert shifted.shift == pytest.approx((2, 0), abs=0.1)
    assert (dark.remarks[0][:24], shifted.remarks[0][:25]) == ("1.00 stops darker than t", "it is displaced by 2.0 px")
    assert "of its error lies in" in covered.remarks[0]
    assert covered.concentrated > 0.95
    names = [one.name for one in found.values()]
    assert set(names[:3]) == {dark.name, shifted.name, covered.name}


def test_a_test_view_is_drawn_where_its_left_half_was_taken(run: Run) -> None:
    """A photograph of the model itself, taken from a camera that is turned by 6 px: its right half is met from there.
    What lies in the left half alone decides where that is."""
    view = replace(run.scene.test[0], camera=run.scene.test[0].camera.zoom(4))
    turn = torch.tensor([2.0, 6.0, 1.0], dtype=torch.float64) / view.camera.focal
    taken = move_camera(view.camera, Motion(rotation=rotation_by(turn), move=torch.zeros(3, dtype=torch.float64)))
    picture = render(run, taken, PIXELS).image.clamp(0, 1)
    scene, lpips = run.scene, LpipsOptions(trunk="", head="", net="vgg", input_range="unit")
    options = EvalOptions(zoom=[1], quantise=True, ssim="inria", tile_pixels=PIXELS, lpips=lpips)
    run.views = replace(run.views, scene=replace(scene, test=[replace(view, source=Taken(picture))]))
    try:
        given = Evaluator(run, options).evaluate()
        aligned = Evaluator(run, replace(options, poses="aligned")).evaluate()
        beside = picture.clone()
        beside[..., view.camera.width // 2 :] = 0.5
        found = [
            Evaluator(run, replace(options, poses="aligned")).renders.camera(replace(view, source=Taken(shown)))
            for shown in (picture, beside)
        ]
    finally:
        run.views = replace(run.views, scene=scene)
    assert aligned["psnr"] > given["psnr"] + 3
    assert torch.equal(found[0].rotation, found[1].rotation)
    assert torch.equal(found[0].translation, found[1].translation)
    assert not torch.equal(found[0].rotation, view.camera.rotation)
    assert "left half" in aligned["protocol"]["poses"]
    assert aligned["protocol"]["hash"] != given["protocol"]["hash"]
    with pytest.raises(ValueError, match="choose from given, aligned"):
        replace(options, poses="found")


def test_findings_lie_in_the_run_and_in_its_report(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run.folder / "report.html").read_text()
    assert f"gsx photographs {run.folder}" in before
    assert main(["photographs", str(run.folder), "--worst", "2"]) == 0
    assert capsys.readouterr().out.strip() == str(run.folder / "report.html")
    index = json.loads((run.folder / "photographs" / "index.json").read_text())
    assert sorted(entry["name"] for entry in index["views"]) == sorted(view.name for view in run.scene.train)
    figures = [entry["psnr"] for entry in index["views"]]
    assert figures == sorted(figures)
    assert ["files" in entry for entry in index["views"]] == [True, True] + [False] * 6
    report = (run.folder / "report.html").read_text()
    assert "8 photographs compared with their renders" in report
    assert report.count('alt="truth of ' + index["views"][0]["name"]) == 1
    assert "repeats it" not in report
    drawn = sorted(path.name for path in (run.folder / "photographs").iterdir())
    assert len(drawn) == 1 + 2 * 3
    assert main(["photographs", str(run.folder), "--worst", "1"]) == 0
    assert len(list((run.folder / "photographs").iterdir())) == 1 + 3
    index["step"] = 2
    (run.folder / "photographs" / "index.json").write_text(json.dumps(index))
    assert "repeats it" in write_report(run.folder).read_text()


def test_a_damaged_index_is_told_and_makes_no_run_unfinished(run: Run) -> None:
    path = run.folder / "photographs" / "index.json"
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    before = read_run(run.folder)
    for content in ('{"views": 3}', '{"views": [{"name": 1}]}', "{"):
        path.write_text(content)
        files = read_run(run.folder)
        assert (files.photographs, list(files.problems)) == ({}, ["photographs/index.json"])
        assert (files.unfinished, state_of(files)) == (before.unfinished, state_of(before))
    path.write_text('{"step": 3, "median_psnr": null, "views": [{"name": "a", "psnr": null, "remarks": []}]}')
    assert "1 photographs compared" in write_report(run.folder).read_text()


def test_views_that_several_steps_show_are_looked_at_once(run: Run) -> None:
    views = run.scene.train
    assert distinct([*views, *views]) == list(views)


def test_lines_on_the_terminal() -> None:
    assert summary_lines([finding("a"), finding("b", psnr=31.0)], 10) == [
        "training photos: 2, median 30.50 dB; with remarks: 0"
    ]
    wrong = [replace(finding(name), remarks=["is odd", "and old"]) for name in "abc"]
    assert summary_lines(wrong, 2) == [
        "training photos: 3, median 30.00 dB; with remarks: 3",
        *(f"{name}  30.00 dB  is odd; and old" for name in "ab"),
        "and 1 more in photographs/index.json",
    ]


def test_mistakes_are_named(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photographs").mkdir()
    for words, told in (
        ([str(tmp_path)], "is not a run folder"),
        ([str(run.folder), "--worst", "0"], "give a whole number of 1 or more"),
        ([str(run.folder), "scene.nothing=1"], "Unknown key 'scene.nothing' for"),
        ([], "train from that folder: gsx ./photographs"),
    ):
        assert main(["photographs", *words]) == 2
        assert told in capsys.readouterr().err
