"""Initial points against hand-worked bounds and files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused

from gsx.formats.ply import write_ply
from gsx.scenes.points import random_points, read_points


def test_random_points_fill_the_box_evenly() -> None:
    low, high = torch.tensor([-1.0, 0.0, 5.0]), torch.tensor([1.0, 0.5, 9.0])
    cloud = random_points(20000, low, high, torch.Generator().manual_seed(3))
    share = (cloud.positions - low) / (high - low)
    assert cloud.positions.dtype == torch.float32
    assert 0 <= share.min() < 0.001
    assert 0.999 < share.max() <= 1
    # an axis' mean has standard error 0.002, its variance is 1/12
    assert (share.mean(0) - 0.5).abs().max() < 0.01
    assert (share.var(0) - 1 / 12).abs().max() < 0.003
    assert cloud.colours.unique().tolist() == [127]


def test_random_points_depend_on_the_seed_alone() -> None:
    corner = torch.ones(3)
    first, again, other = (
        random_points(5, -corner, corner, torch.Generator().manual_seed(seed)).positions for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_points_of_a_file(tmp_path: Path) -> None:
    columns = {axis: np.array([1.0, np.nan, 3.0]) * scale for axis, scale in zip("xyz", (1, 10, 100), strict=True)}
    colours = {name: np.array([level, 0, 255 - level], np.uint8) for level, name in enumerate(("red", "green", "blue"))}
    write_ply(tmp_path / "a.ply", columns | colours)
    cloud = read_points(tmp_path / "a.ply")
    assert cloud.positions.tolist() == [[1, 10, 100], [3, 30, 300]]
    assert cloud.colours.tolist() == [[0, 1, 2], [255, 254, 253]]
    write_ply(tmp_path / "b.ply", columns)
    assert read_points(tmp_path / "b.ply").colours.unique().tolist() == [127]
    write_ply(tmp_path / "c.ply", columns | {name: np.full(3, 0.5) for name in colours})
    assert read_points(tmp_path / "c.ply").colours.unique().tolist() == [128]


def test_files_without_usable_points_are_refused(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"x": np.zeros(2), "y": np.zeros(2)})
    refused("no x, y, z but x, y", read_points, tmp_path / "a.ply")
    write_ply(tmp_path / "b.ply", {axis: np.full(2, np.inf) for axis in "xyz"})
    refused("no point with finite coordinates", read_points, tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("given", "found"),
    [
        (np.array([0.0, 0.5, 1.0], np.float32), [0, 128, 255]),
        (np.array([0, 32768, 65535], np.uint16), [0, 128, 255]),
        (np.array([0, 7, 255], np.uint8), [0, 7, 255]),
        (np.array([0, 7, 255], np.uint16), [0, 7, 255]),
        (np.array([0.0, 128.0, 255.0], np.float32), [0, 128, 255]),
        (np.array([0.0, 0.5, np.nan], np.float32), [0, 128, 127]),
        (np.array([-0.1, 0.5, 1.2]), [0, 128, 255]),
        (np.array([0, 128, 255], np.int32), [0, 128, 255]),
        (np.array([0, 7, 70_000], np.int32), [127, 127, 127]),
        (np.array([-3, 7, 100], np.int8), [127, 127, 127]),
        (np.array([0.0, 7, 65535]), [127, 127, 127]),
        (np.full(3, np.nan), [127, 127, 127]),
    ],
    ids=[
        "float",
        "16 bits",
        "8 bits",
        "8 in 16",
        "float of bytes",
        "not finite",
        "overshoot",
        "int",
        "large int",
        "negative int",
        "large float",
        "none finite",
    ],
)
def test_colours_may_be_of_several_kinds(given: np.ndarray, found: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    columns = dict.fromkeys("xyz", np.zeros(3, np.float32)) | dict.fromkeys(("red", "green", "blue"), given)
    monkeypatch.setattr("gsx.scenes.points.read_ply", lambda path: columns)
    assert read_points(Path("a.ply")).colours.tolist() == [[value] * 3 for value in found]


def test_splats_given_as_points_keep_their_colours(tmp_path: Path) -> None:
    """0.5 + 0.28209479 f_dc, within what is displayed."""
    columns = {axis: np.arange(2, dtype=np.float32) for axis in "xyz"}
    bands = {f"f_dc_{i}": np.array(pair, np.float32) for i, pair in enumerate([(1, 5), (0, -5), (-1, 0)])}
    write_ply(tmp_path / "a.ply", columns | bands)
    assert read_points(tmp_path / "a.ply").colours.tolist() == [[199, 128, 56], [255, 0, 128]]
