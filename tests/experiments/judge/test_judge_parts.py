"""Parts of gsx judge: layouts of folders, intervals, SSIM variants."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from gsx.core.data.images import write_image
from gsx.core.errors import InputError
from gsx.core.quality.metrics import ssim
from gsx.experiments.judge.differences import NORMAL, QUANTILES, difference, half_width, quantile
from gsx.experiments.judge.layouts import layout_of
from gsx.experiments.judge.similarity_variants import all_ssim


def write_files(folder: Path, names: Sequence[str]) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(folder / name, torch.zeros(3, 4, 4))
    return folder


@pytest.mark.parametrize(
    ("names", "program", "folders"),
    [
        (["test/ours_7000/renders/0.png", "test/ours_30000/renders/0.png"], "3D-GS", ["renders"]),
        (["renders/0.png", "gt/0.png"], "3D-GS", ["renders"]),
        (
            ["test/ours_9/test_preds_1/0.png", "test/ours_9/test_preds_8/0.png"],
            "3D-GS",
            ["test_preds_1", "test_preds_8"],
        ),
        (["color/a/b.png", "gt-color/a/b.png"], "nerfbaselines", ["color"]),
        (["test/rgb/a.jpg", "test/gt-rgb/a.jpg", "test/depth/a.jpg"], "nerfstudio", ["rgb"]),
        (["eval_img_0000.png"], "nerfstudio", ["."]),
        (["x1/a.png", "x4/a.png"], "pictures", ["x1", "x4"]),
        (["1x/a.png", "zoom_2/a.png"], "pictures", ["1x", "zoom_2"]),
        (["a.png", "x4/a.png"], "pictures", [".", "x4"]),
        (["cam/a.png", "cam/b.png"], "pictures", ["."]),
    ],
)
def test_layouts_of_programs(names: list[str], program: str, folders: list[str], tmp_path: Path) -> None:
    layout = layout_of(write_files(tmp_path, names))
    assert layout.program == program
    assert [one.folder.name if one.folder != tmp_path else "." for one in layout.sets] == folders


def test_the_last_iteration_is_judged_and_photos_are_found(tmp_path: Path) -> None:
    names = [f"test/ours_{n}/{kind}/00000.png" for n in (7000, 30000) for kind in ("renders", "gt")]
    layout = layout_of(write_files(tmp_path, names))
    (pictures,) = layout.sets
    assert pictures.folder.parent.name == "ours_30000"
    assert [path.parent.name for path in pictures.truths.values()] == ["gt"]
    assert "ours_7000" in layout.notes[0]


def test_packed_pictures_are_named(tmp_path: Path) -> None:
    (tmp_path / "predictions.tar.gz").touch()
    with pytest.raises(InputError, match=r"predictions\.tar\.gz: unpack"):
        layout_of(tmp_path)


def test_quantiles_of_students_t() -> None:
    # Abramowitz and Stegun, table 26.10, 97.5 %
    expected = {1: 12.706, 5: 2.571, 10: 2.228, 11: 2.201, 15: 2.131, 30: 2.042, 120: 1.980}
    assert {n: round(quantile(n), 3) for n in expected} == expected
    assert len(QUANTILES) == 10
    assert quantile(10**9) == pytest.approx(NORMAL, abs=1e-6)


def test_half_the_interval_of_a_mean_by_hand() -> None:
    # mean 2, standard deviation 1, n = 3: 4.303 / sqrt(3)
    assert half_width([1, 2, 3]) == pytest.approx(4.303 / math.sqrt(3))
    assert half_width([5]) is None


def test_views_are_paired() -> None:
    one, other = {"a": 30.0, "b": 20.0, "c": 10.0}, {"a": 29.0, "b": 19.0, "d": 50.0}
    found = difference([one], [other])
    assert found is not None
    assert (found.mean, found.values, found.over_views, found.over_repetitions) == (1.0, 2, 0.0, None)


def test_repetitions_are_paired_where_both_have_as_many() -> None:
    ours, theirs = [{"a": 10.0}, {"a": 12.0}], [{"a": 9.0}, {"a": 11.0}]
    paired = difference(ours, theirs)
    assert paired is not None
    assert paired.over_repetitions == 0
    alone = difference(ours, theirs[:1])
    assert alone is not None
    # standard error of two values with standard deviation sqrt(2): 1
    assert alone.over_repetitions == pytest.approx(12.706)


def test_no_shared_view_has_no_difference() -> None:
    assert difference([{"a": 1.0}], [{"b": 1.0}]) is None


@pytest.mark.parametrize("size", [(40, 60), (22, 22), (15, 40)])
@pytest.mark.parametrize("masked", [False, True])
def test_all_variants_of_ssim_at_once(size: tuple[int, int], masked: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(3, *size, generator=generator)
    image = (truth + 0.1 * torch.randn(truth.shape, generator=generator)).clamp(0, 1)
    counted = torch.rand(size, generator=generator) > 0.3 if masked else None
    for name, value in all_ssim(image, truth, counted).items():
        assert value == pytest.approx(ssim(image, truth, name, counted), abs=1e-12)
