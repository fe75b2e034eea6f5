"""Splat files: properties, order and bytes as the 3D-GS release writes them."""

import math
import struct
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians, splats_of
from gsx.formats.splat_files import read_gaussians, write_gaussians

PROPERTIES = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


def gaussians(count: int, bands: int = 15, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=g)

    return Gaussians(
        means=random(3), log_scales=random(3) - 3, quats=random(4), opacity_logits=random(),
        sh_dc=random(3), sh_rest=random(bands, 3),
    )  # fmt: skip


def one_row() -> Gaussians:
    """Numbers that tell every property: coefficient k = 1..15 of channel c is 100 (c + 1) + k."""
    rest = 100 * torch.arange(1.0, 4.0)[None, :] + torch.arange(1.0, 16.0)[:, None]
    return Gaussians(
        means=torch.tensor([[1.0, 2, 3]]),
        log_scales=torch.tensor([[-1.0, -2, -3]]),
        quats=torch.tensor([[0.5, 0.25, 0.125, 0.75]]),  # w, x, y, z
        opacity_logits=torch.tensor([-4.5]),
        sh_dc=torch.tensor([[10.0, 20, 30]]),
        sh_rest=rest[None],
    )


def test_header_and_bytes_of_one_row(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", one_row(), comments=["made by a test"])
    lines = ["ply", "format binary_little_endian 1.0", "comment made by a test", "element vertex 1"]
    lines += [f"property float {name}" for name in PROPERTIES] + ["end_header", ""]
    red, green, blue = (range(start + 1, start + 16) for start in (100, 200, 300))
    numbers = [1, 2, 3, 0, 0, 0, 10, 20, 30, *red, *green, *blue, -4.5, -1, -2, -3, 0.5, 0.25, 0.125, 0.75]
    assert len(numbers) == 62
    assert (tmp_path / "a.ply").read_bytes() == "\n".join(lines).encode() + struct.pack("<62f", *numbers)


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
@pytest.mark.parametrize("count", [1, 7])
def test_round_trip_is_exact(count: int, bands: int, tmp_path: Path) -> None:
    written = gaussians(count, bands)
    write_gaussians(tmp_path / "a.ply", written)
    back = read_gaussians(tmp_path / "a.ply")
    for name, value in vars(written).items():
        assert torch.equal(getattr(back, name), value), name


@pytest.mark.parametrize(
    ("field", "name"),
    [("means", "y"), ("quats", "rot_1"), ("sh_dc", "f_dc_1"), ("log_scales", "scale_1")],
)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite_are_refused(field: str, name: str, value: float, tmp_path: Path) -> None:
    spoilt = gaussians(5)
    getattr(spoilt, field)[[0, 3], 1] = value
    with pytest.raises(InputError, match=f"2 of 5 values of '{name}' are not finite"):
        write_gaussians(tmp_path / "a.ply", spoilt)
    assert list(tmp_path.iterdir()) == []


def test_refused_file_leaves_the_old_one(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", gaussians(2))
    before = (tmp_path / "a.ply").read_bytes()
    with pytest.raises(InputError, match="1 of 2 values of 'opacity'"):
        write_gaussians(tmp_path / "a.ply", replace(gaussians(2), opacity_logits=torch.tensor([0.0, math.nan])))
    assert (tmp_path / "a.ply").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_doubles_too_large_for_the_file_are_refused(tmp_path: Path) -> None:
    huge = replace(gaussians(2), means=torch.full((2, 3), 1e300, dtype=torch.float64))
    with pytest.raises(InputError, match="2 of 2 values of 'x'"):
        write_gaussians(tmp_path / "a.ply", huge)


@pytest.mark.parametrize("name", ["x", "opacity", "scale_2", "rot_3", "f_dc_0"])
def test_missing_property_is_named(name: str, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", gaussians(3))
    content = (tmp_path / "a.ply").read_bytes()
    line = f"property float {name}\n".encode()
    assert content.count(line) == 1
    (tmp_path / "a.ply").write_bytes(content.replace(line, f"property float other_{name}\n".encode()))
    with pytest.raises(InputError, match=f"lacks property '{name}'"):
        read_gaussians(tmp_path / "a.ply")


def test_gradients_do_not_hinder_writing(tmp_path: Path) -> None:
    trained = replace(gaussians(2), means=torch.ones(2, 3, requires_grad=True))
    write_gaussians(tmp_path / "a.ply", trained)
    assert torch.equal(read_gaussians(tmp_path / "a.ply").means, torch.ones(2, 3))


def test_viewer_draws_the_activated_values_with_all_bands() -> None:
    raw = replace(
        gaussians(1),
        means=torch.tensor([[1.0, 2.0, 8.0]]),
        log_scales=torch.log(torch.tensor([[0.1, 0.2, 0.3]])),
        opacity_logits=torch.tensor([math.log(0.25 / 0.75)]),
        sh_dc=torch.zeros(1, 3),
        sh_rest=torch.zeros(1, 15, 3),
    )
    raw.sh_rest[0, 11] = torch.tensor([0.1, 0.2, -9.0])  # k = 12: 0.746353 straight up
    splats = splats_of(raw, torch.tensor([1.0, 2.0, 5.0]))
    torch.testing.assert_close(splats.scales, torch.tensor([[0.1, 0.2, 0.3]]))
    torch.testing.assert_close(splats.log_opacities, torch.tensor([math.log(0.25)]))
    torch.testing.assert_close(splats.colours, torch.tensor([[0.574635, 0.649271, 0.0]]), atol=2e-6, rtol=0)
    assert torch.equal(splats.quats, raw.quats)


@pytest.mark.parametrize("bands", [0, 3, 8])
def test_viewer_draws_files_of_lower_degree(bands: int) -> None:
    raw = gaussians(4, bands)
    full = replace(raw, sh_rest=torch.cat([raw.sh_rest, torch.zeros(4, 15 - bands, 3)], 1))
    centre = torch.tensor([0.0, -3.0, 1.0])
    torch.testing.assert_close(splats_of(raw, centre).colours, splats_of(full, centre).colours)
