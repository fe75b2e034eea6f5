"""Figures of named protocols against formulas in NumPy and double precision, on pictures full of detail."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from evaluating import SIZE, Grey, run_of
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.runs.compose import compose

Picture = NDArray[np.float64]
"""[3, H, W], levels of 255."""
RESULTS = Path(__file__).parents[3] / "benchmarks" / "results" / "agreement_cpu.json"


class Speckled(Grey):
    """A photograph in which every level occurs."""

    def image(self, camera: Camera) -> Tensor:
        levels = torch.randint(256, (3, camera.height, camera.width), generator=seeded(self.name))
        return levels.to(torch.uint8)


class MaskedSpeckles(Speckled):
    """The corners do not count."""

    def counted(self, camera: Camera) -> Tensor:
        y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        return (y + x > 6) & (y + x < camera.height + camera.width - 9)


def seeded(name: str) -> torch.Generator:
    """A generator for each view."""
    return torch.Generator().manual_seed(ord(name))


def render_of(truth: Tensor, name: str) -> Tensor:
    """A render some levels off, beyond white and black as well; it falls between levels."""
    return truth + (6 / 255) * torch.randn(truth.shape, generator=seeded(name))


def nearest(levels: Picture) -> Picture:
    """Integers, by torchvision's rule."""
    return np.floor(np.clip(levels + 0.5, 0, 255))


def lower(levels: Picture) -> Picture:
    """Integers, by NumPy's conversion."""
    return np.clip(levels, 0, 255).astype(np.uint8).astype(np.float64)


def floats(levels: Picture) -> Picture:
    """Within the display's range."""
    return np.clip(levels, 0, 255)


def mean_squares(one: Picture, other: Picture, counted: NDArray[np.bool_]) -> float:
    """The mean over pixels that count and channels."""
    return float((((one - other) / 255) ** 2)[:, counted].mean())


def likeness(one: Picture, other: Picture, counted: NDArray[np.bool_], border: str) -> float:
    """Wang et al. 2004, equation 13, by the 121 weights of each window at once; `border`: of NumPy's pad, or none."""
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    weights = np.outer(line, line) / line.sum() ** 2

    def blurred(values: Picture) -> Picture:
        padded = values if border == "none" else np.pad(values, ((0, 0), (5, 5), (5, 5)), mode=border)  # type: ignore
        windows = sliding_window_view(padded, (11, 11), axis=(1, 2))
        return np.einsum("chwij,ij->chw", windows, weights)

    x, y = one / 255, other / 255
    mx, my = blurred(x), blurred(y)
    vx, vy, covariance = blurred(x * x) - mx**2, blurred(y * y) - my**2, blurred(x * y) - mx * my
    found = (2 * mx * my + 1e-4) * (2 * covariance + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    middles = counted[5:-5, 5:-5] if border == "none" else counted
    return float(found[:, middles].mean())


RULES: dict[str, tuple[Callable[[Picture], Picture], str, bool]] = {
    "inria": (nearest, "constant", False),
    "nerfbaselines": (lower, "none", True),
    "nerfstudio": (floats, "none", False),
    "gsplat": (floats, "reflect", False),
}
"""To levels, borders of windows, whether masked pixels count as black ones."""


@pytest.mark.parametrize("photo", [Speckled, MaskedSpeckles])
@pytest.mark.parametrize("name", RULES)
def test_each_protocol_measures_by_its_own_rules(
    name: str, photo: type[Speckled], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    to_levels, border, black = RULES[name]
    evaluator = Evaluator(run_of(tmp_path, photo), compose([f"protocol={name}"], plugins()).evaluation)
    draw = evaluator.renders.render
    drawn = {view.name: render_of(view.image(), view.name) for view in evaluator.run.scene.test}
    monkeypatch.setattr(
        evaluator.renders, "render", lambda view, factor=1: replace(draw(view, factor), image=drawn[view.name])
    )
    views, levels, similarities = evaluator.views(), [], []
    for view in evaluator.run.scene.test:
        inside = view.counted()
        counted = np.ones(SIZE[::-1], dtype=bool) if inside is None else inside.numpy()
        one, other = (255 * picture.double().numpy() for picture in (drawn[view.name], view.image()))
        one, other = to_levels(one) * counted, np.round(other) * counted
        everywhere = counted | black
        levels.append(-10 * np.log10(mean_squares(one, other, everywhere)))
        similarities.append(likeness(one, other, everywhere, border))
    assert [view["psnr"] for view in views] == pytest.approx(levels, abs=2e-5)
    assert [view["ssim"] for view in views] == pytest.approx(similarities, abs=2e-5)


def test_rules_differ_by_more_than_the_agreement_is_worth() -> None:
    """So that agreement with one of them says something."""
    truth = torch.rand(3, *SIZE[::-1], generator=seeded("a"))
    one, other = (255 * picture.double().numpy() for picture in (render_of(truth, "a"), truth))
    counted = np.ones(SIZE[::-1], dtype=bool)
    squares = [mean_squares(to_levels(one), other, counted) for to_levels in (nearest, lower, floats)]
    assert min(abs(a / b - 1) for a, b in pairwise(squares)) > 1e-4
    borders = [likeness(one, other, counted, border) for border in ("constant", "none", "reflect")]
    assert min(abs(a - b) for a, b in pairwise(borders)) > 1e-4


def test_the_committed_comparison_with_nerfbaselines_agrees() -> None:
    """0.001 dB and 0.0001 SSIM for every view, by nerfbaselines' own functions (benchmarks/agreement.py)."""
    rows = json.loads(RESULTS.read_text())["sections"]["agreement"]["rows"]
    assert {row["scene"] for row in rows} >= {"demo", "fox"}
    assert all(row["off_psnr"] < 1e-3 and row["off_ssim"] < 1e-4 for row in rows)
