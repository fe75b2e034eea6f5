"""What is said beside figures: caps that bind, pictures lost, splats left out."""

import logging
from pathlib import Path

import pytest
from module_contexts import build_module
from tiny import tiny_run

from gsx.core.files import read_json
from gsx.experiments.evaluation.remarks import gathered, remarks_of
from gsx.experiments.runs.progress import read_curves
from gsx.modules.exposure import Exposure, ExposureOptions
from gsx.modules.poses import PoseOptions, Poses

LINES = [
    {"step": 10},
    {"step": 20, "withheld": 3},
    {"step": 21, "pseudo": {"up": {"event": 20, "asked": {"1": 4, "2": 4}, "dropped": {"2": 1}, "warned": {}}}},
    {"step": 9, "pose_spread": 0.72, "poses": 40, "pose_motion": 0.61, "pose_seconds": 1.5},
    {"step": 30, "poses": 40, "pose_motion": 0.2, "pose_seconds": 1.0},
    {"step": 25, "exposure_spread": 0.1854, "exposures": 40, "exposure_seconds": 0.5},
    {"step": 30, "withheld": 5, "exposures": 40, "exposure_motion": 0.04, "exposure_seconds": 1.25},
    {"step": 41, "pseudo": {
        "up": {"event": 40, "asked": {"1": 4, "2": 4}, "dropped": {"2": 1}, "warned": {"agreement": {"2": 2}}},
        "boot": {"event": 40, "asked": {"1": 8}, "dropped": {}, "warned": {}},
    }},
]  # fmt: skip


def test_a_whole_run_is_summed_up_by_hand() -> None:
    found = gathered(LINES)
    assert found["withheld"] == {"step": 20, "primitives": 8}
    assert found["pseudo"]["up"] == {
        "asked": {"1": 8, "2": 8},
        "dropped": {"1": 0.0, "2": 0.25},
        "warned": {"agreement": {"1": 0.0, "2": 0.25}},
    }
    assert found["pseudo"]["boot"] == {"asked": {"1": 8}, "dropped": {"1": 0.0}, "warned": {}}
    exposure, poses = build_module(Exposure, ExposureOptions()), build_module(Poses, PoseOptions())
    figures = {"step": 25, "spread": 0.1854, "learnt": 40, "motions": [0.04], "seconds": 1.75}
    assert exposure.summary(LINES) == {"exposures": figures}
    figures = {"step": 9, "spread": 0.72, "corrected": 40, "motions": [0.61, 0.2], "seconds": 2.5}
    assert poses.summary(LINES) == {"poses": figures}
    assert gathered(LINES[:1]) == exposure.summary(LINES[:1]) == poses.summary(LINES[:1]) == {}


def test_in_words() -> None:
    assert remarks_of(gathered(LINES) | {"left_out": 2.5, "remarks": ["saved when it was evaluated"]}) == [
        "growth is held at backbone.max_primitives from step 20 on: the model may be too small",
        "up lost 25.0% of its x2 pictures",
        "25.0% of up's x2 pictures disagree with their input",
        "renders leave out 2.5 splats a view, whose values cannot be drawn",
        "saved when it was evaluated",
    ]
    exposure, poses = build_module(Exposure, ExposureOptions()), build_module(Poses, PoseOptions())
    assert list(exposure.remarks(exposure.summary(LINES))) == [
        "exposures of photos are spread by 18.5%, each has its own from step 25 on: the model has that of the mean "
        "photo; eval.colours=fitted looks past that"
    ]
    assert list(poses.remarks(poses.summary(LINES))) == [
        "poses of training photos were off by 0.72 px, they are corrected from step 9 on: those of test views are the "
        "scene's; eval.poses=aligned looks past that"
    ]
    assert list(poses.remarks({"poses": {"step": 9, "spread": 0.1, "corrected": 0}})) == []
    assert list(exposure.remarks({"exposures": {"step": 25, "spread": 0.001, "learnt": 0}})) == []
    assert remarks_of({"psnr": 30.0, "left_out": 0.0}) == []


def test_a_loss_to_an_upscaler_that_rounds_to_nothing_is_no_remark() -> None:
    zooms = {"2": {"psnr": 30.0, "upscaled_psnr": 30.004}, "4": {"psnr": 30.0, "upscaled_psnr": 30.25}}
    (remark,) = remarks_of({"psnr": 30.0, "zoom": zooms, "competitor": {"name": "span"}})
    assert remark == "zoomed renders lose to the x1 render enlarged by span at x4 (0.25 dB): zoom by that instead"


def test_a_cap_that_binds_is_said_once_and_written_down(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    words = ("iterations=60", "backbone.max_primitives=301", "backbone.density.gradient=1e-9", "rasterizer=eager")
    tiny_run(tmp_path / "run", words)
    said = {record.message for record in caplog.records if "backbone.max_primitives" in record.message}
    lines = read_curves(tmp_path / "run")
    evaluation = read_json(tmp_path / "run" / "evaluation.json")
    first = next(line for line in lines if line.get("withheld"))
    assert len([line for line in lines if line.get("withheld")]) > 1
    (told,) = (text for text in said if text.startswith("step "))  # of that step alone
    assert told.startswith(f"step {first['step']}: {first['withheld']} primitives")
    assert evaluation["withheld"]["step"] == first["step"]
    assert evaluation["primitives"] <= 301
    assert "growth is held at" in (tmp_path / "run" / "report.html").read_text()
