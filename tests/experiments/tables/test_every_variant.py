"""Every variant trains 60 steps on the built-in scene, redrawn offline."""

import json
from pathlib import Path

import pytest

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.experiments.runs.compose import Compositions

VARIANTS = sorted(path.stem for path in (Path(__file__).parents[3] / "conf" / "variant").glob("*.yaml"))
SMALL = ["dataset=demo", "budget=smoke", "iterations=60", "scene.train_views=8", "scene.test_views=2",
         "scene.samples=1", "scene.points=800", "training.test_points=0", "training.log_every=1", "rasterizer=eager",
         "device=cpu"]  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def one_cache(tmp_path_factory: pytest.TempPathFactory):
    """What scene_sr learns, and the pictures of the scene, once for all."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("GSX_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_it_trains(variant: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert main([f"variant={variant}", *SMALL, f"folder={folder}"]) == 0
    evaluation = json.loads((folder / "evaluation.json").read_text())
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert evaluation["step"] == 60
    assert 10 < evaluation["psnr"] < 40
    assert not any(line.get("skipped") for line in lines)
    with Compositions(plugins()) as compositions:
        augmenters = compositions.settings([f"variant={variant}"]).augmenters
    seen = {name for line in lines for name in line.get("terms", {})} - {"own"}
    assert seen == set(augmenters)  # pseudo views have entered the loss
