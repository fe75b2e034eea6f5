"""Learning rates that go down to nothing at the end of a run."""

from pathlib import Path

import pytest
import torch
from tiny import tiny_run

from gsx.core.training.run import Run, TrainingOptions


@pytest.mark.parametrize(
    ("cooldown", "paces"),
    [
        (0.0, [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]),
        (0.05, [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]),  # less than a step
        (0.2, [1, 1, 1, 1, 1, 1, 1, 1, 1, 0.5]),
        (0.5, [1, 1, 1, 1, 1, 1, 0.8, 0.6, 0.4, 0.2]),
        (1.0, [1, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1]),
    ],
)
def test_paces_of_ten_steps(cooldown: float, paces: list[float]) -> None:
    options = TrainingOptions(ssim_weight=0.2, random_background=False, log_every=1, checkpoint_every=1,
                              checkpoints_kept=1, test_points=0, cooldown=cooldown)  # fmt: skip
    assert [options.pace(step, 10) for step in range(1, 11)] == pytest.approx(paces)


@pytest.mark.parametrize("backbone", ["gs3d", "scaffold"])
def test_a_run_is_as_ever_until_then_and_moves_by_less_from_then_on(backbone: str, tmp_path: Path) -> None:
    """Of eight steps the last four are cooled, the first of these not yet: five are those of a run without."""

    def run_of(cooldown: float, stop_after: int | None = None) -> Run:
        words = ("iterations=8", f"backbone={backbone}", "rasterizer=eager", f"training.cooldown={cooldown}")
        return tiny_run(tmp_path / f"{cooldown}_{stop_after}", (*words, "training.test_points=0"), stop_after)

    (five, whole), (five_cooled, cooled) = ([run_of(share, stop) for stop in (5, None)] for share in (0, 0.5))
    for name, value in five.backbone.table.parameters.items():
        assert torch.equal(value, five_cooled.backbone.table.parameters[name])
        moved = (whole.backbone.table.parameters[name] - value).detach().norm()
        less = (cooled.backbone.table.parameters[name] - value).detach().norm()
        if moved > 0:
            assert 0.2 < float(less / moved) < 0.8  # three quarters, a half, a quarter of three steps
