"""Comparisons with the baseline, by hand."""

from pathlib import Path
from typing import Any

import pytest

from gsx.experiments.reports.baselines import baseline_rows, compared
from gsx.experiments.run_folder.files import RunFiles


def run(
    psnr: dict[str, float], seconds: float = 100.0, augmenter: Any = None, seed: int = 0, **config: Any
) -> RunFiles:
    """A finished run with PSNR by zoom."""
    content = {"iterations": 10, "scene": {"name": "demo"}, "backbone": {"name": "gs3d"}, "seed": seed, **config}
    zoom = {factor: {"psnr": value} for factor, value in psnr.items()}
    evaluation = {"psnr": psnr["1"], "zoom": zoom, "train_seconds": seconds, "protocol": {"hash": "p"}}
    return RunFiles(
        folder=Path("run"),
        config=content | {"augmenter": augmenter or []},
        config_text="",
        environment={},
        lines=[],
        evaluation=evaluation,
        pictures={},
        pseudo={},
        photographs={},
        retakes={},
        status={},
        problems={},
    )


UP = {"upscale": {"name": "upscale", "narrow": 0.5}}
WIDE = {"upscale": {"name": "upscale", "narrow": 1.0}}


def test_gains_are_means_over_seeds_with_half_of_their_range() -> None:
    runs = [
        run({"1": 30.0, "2": 28.0, "4": 26.0}),
        run({"1": 31.0, "2": 27.0, "4": 25.0}, seed=1),
        run({"1": 29.9, "2": 28.5, "4": 27.0}, 150, UP),
        run({"1": 31.1, "2": 27.1, "4": 27.0}, 130, UP, seed=1),
    ]
    (row,) = baseline_rows(runs)
    assert (row["scene"], row["backbone"], row["augmenters"], row["seeds"]) == ("demo", "gs3d", "upscale", 2)
    assert row["gains"]["1"] == pytest.approx((0.0, 0.1))
    assert row["gains"]["2"] == pytest.approx((0.3, 0.2))
    assert row["gains"]["4"] == pytest.approx((1.5, 0.5))
    assert row["cost"] == pytest.approx(1.4)


def test_only_what_both_have_is_compared() -> None:
    ((entry,),) = compared([run({"1": 30.0, "2": 28.0}), run({"1": 30.5, "4": 27.0}, augmenter=UP)])
    assert entry.gains == {"1": [pytest.approx(0.5)]}


@pytest.mark.parametrize("change", [{"seed": 1}, {"iterations": 11}, {"backbone": {"name": "scaffold"}}])
def test_other_runs_are_no_control(change: dict[str, Any]) -> None:
    assert compared([run({"1": 30.0}), run({"1": 31.0}, augmenter=UP, **change)]) == []


def test_augmentations_that_differ_are_told_apart() -> None:
    runs = [run({"1": 30.0}), run({"1": 31.0}, augmenter=UP), run({"1": 32.0}, augmenter=WIDE)]
    assert [row["differences"] for row in baseline_rows(runs)] == ["upscale.narrow=0.5", "upscale.narrow=1.0"]
    assert [row["differences"] for row in baseline_rows(runs[:2])] == [""]


def test_folders_and_zooms_looked_at_make_no_difference() -> None:
    baseline = run({"1": 30.0}, folder="a", eval={"zoom": [1]}, init="warm_start")
    (row,) = baseline_rows(
        [baseline, run({"1": 31.0}, augmenter=UP, folder="b", eval={"zoom": [1, 2]}, init="scratch")]
    )
    assert row["gains"]["1"][0] == pytest.approx(1.0)
