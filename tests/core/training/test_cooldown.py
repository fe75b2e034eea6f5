"""Learning rates that go down to nothing at the end of a run."""

from pathlib import Path

import pytest
import torch
from tiny import trained
from torch import Tensor

from gsx.core.training.run import TrainingOptions


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

    def models_of(cooldown: float) -> list[dict[str, Tensor]]:
        """After five steps and after all."""
        words = ("iterations=8", f"backbone={backbone}", "rasterizer=eager", f"training.cooldown={cooldown}")
        runs = [trained(tmp_path, steps, *words) for steps in (5, 8)]
        return [{name: value.detach() for name, value in run.backbone.table.parameters.items()} for run in runs]

    (five, whole), (five_cooled, cooled) = models_of(0), models_of(0.5)
    for name, value in five.items():
        assert torch.equal(value, five_cooled[name])
        moved, less = (whole[name] - value).norm(), (cooled[name] - value).norm()
        if moved > 0:
            assert 0.2 < float(less / moved) < 0.8  # three quarters, a half, a quarter of three steps
