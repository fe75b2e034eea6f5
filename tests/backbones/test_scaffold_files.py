"""Splat files of the anchor backbones: the published columns, and one view as a standard file."""

from pathlib import Path

import pytest
import torch
from small_scene import small_scene, spread
from test_anchors import NAMES, NEURAL, small_anchors, stir

from gsx.backbones.anchor_grids import LevelGrids
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import splats_of
from gsx.core.quality.metrics import psnr
from gsx.core.rasterizer import rasterize
from gsx.formats.ply import read_ply
from gsx.formats.splat_files import read_gaussians, write_columns, write_gaussians


def numbers(prefix: str, count: int) -> list[str]:
    return [f"{prefix}{i}" for i in range(count)]


NEURAL_TAIL = [
    *numbers("f_offset_", 30), *numbers("f_anchor_feat_", 32), "opacity", *numbers("scale_", 6), *numbers("rot_", 4),
]  # fmt: skip
PUBLISHED = {
    "scaffold": (["x", "y", "z", "nx", "ny", "nz", *NEURAL_TAIL], 316),
    "octree_scaffold": (["x", "y", "z", "level", "extra_level", "info", *NEURAL_TAIL], 316),
    "octree_gs3d": (
        ["x", "y", "z", "level", "extra_level", *numbers("f_offset_", 3), *numbers("f_dc_", 3), *numbers("f_rest_", 45),
         "opacity", *numbers("scale_", 6), *numbers("rot_", 4)],
        268,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_properties_and_bytes_are_the_published_ones(name: str, tmp_path: Path) -> None:
    backbone = small_anchors(name)
    stir(backbone)
    if isinstance(backbone.grid, LevelGrids):
        backbone.table["bias"].uniform_(0, 0.5, generator=torch.Generator().manual_seed(0))
    path = tmp_path / "anchors.ply"
    write_columns(path, backbone.file_columns(), backbone.file_notes())
    data = path.read_bytes()
    header, end = data.split(b"end_header\n")[0].decode(), data.index(b"end_header\n") + len(b"end_header\n")
    assert "format binary_little_endian 1.0" in header
    properties = [line.split()[1:] for line in header.splitlines() if line.startswith("property")]
    order, row = PUBLISHED[name]
    assert [found for _, found in properties] == order
    assert {kind for kind, _ in properties} == {"float"}
    assert len(data) - end == row * len(backbone.table)


@pytest.mark.parametrize("name", NAMES)
def test_columns_hold_the_raw_values(name: str, tmp_path: Path) -> None:
    backbone = small_anchors(name)
    stir(backbone)
    path, table = tmp_path / "anchors.ply", backbone.table
    write_columns(path, backbone.file_columns())
    columns, k = read_ply(path), backbone.representation.offsets
    for row in (0, 7, len(table) - 1):
        assert [columns[axis][row] for axis in "xyz"] == table["anchors"][row].tolist()
        for axis in range(3):
            for j in range(k):
                assert columns[f"f_offset_{axis * k + j}"][row] == table["offsets"][row, j, axis].item(), "axis-major"
        assert [columns[f"scale_{i}"][row] for i in range(6)] == table["log_scales"][row].tolist()
        if name in NEURAL:
            assert [columns[f"f_anchor_feat_{i}"][row] for i in range(32)] == table["features"][row].tolist()
            assert [columns[f"rot_{i}"][row] for i in range(4)] == [1, 0, 0, 0]
            assert columns["opacity"][row] == pytest.approx(-2.1972246)  # logit of 0.1
        else:
            assert [columns[f"rot_{i}"][row] for i in range(4)] == table["quats"][row].tolist()
            assert columns["opacity"][row] == table["opacity_logits"][row].item()
            assert [columns[f"f_dc_{i}"][row] for i in range(3)] == table["sh_dc"][row, 0].tolist()
            for channel in range(3):
                for band in range(15):
                    found = columns[f"f_rest_{channel * 15 + band}"][row]
                    assert found == table["sh_rest"][row, band, channel].item(), "channel-major"
        if isinstance(backbone.grid, LevelGrids):
            assert columns["level"][row] == int(table["level"][row])
    if name == "octree_scaffold":
        v, farthest = columns["info"][:2]
        assert (v, farthest) == (pytest.approx(backbone.grid.levels.cell), pytest.approx(backbone.grid.levels.farthest))
        assert not columns["info"][2:].any()


@pytest.mark.parametrize("name", ["octree_scaffold", "octree_gs3d"])
def test_comments_hold_what_a_viewer_needs_to_choose_levels(name: str) -> None:
    backbone = small_anchors(name)
    note, levels = backbone.file_notes()[-1], backbone.grid.levels
    assert f"levels {levels.count}, fork 2, standard_dist {levels.farthest!r}" in note
    assert f"init_pos {levels.origin!r}, voxel_size {levels.cell!r}" in note


@pytest.mark.parametrize("name", NAMES)
def test_filter_sizes_follow_where_there_is_a_filter(name: str) -> None:
    backbone = small_anchors(name, "filter=mip")
    columns = backbone.file_columns()
    assert list(columns)[-1] == "filter_3D"
    assert torch.equal(columns["filter_3D"], backbone.table["filter"])
    assert "filter_3D" in backbone.file_notes()[0]
    assert "filter_3D" not in small_anchors(name).file_columns()


@pytest.mark.parametrize("filtered", ["none", "mip"])
@pytest.mark.parametrize("name", NAMES)
def test_one_view_as_a_standard_file_shows_the_same_picture(name: str, filtered: str, tmp_path: Path) -> None:
    scene = small_scene(spread(300) * 2)
    backbone = small_anchors(name, f"filter={filtered}", scene=scene)
    stir(backbone)
    last = backbone.options.published_iterations
    camera, background = scene.train[1].camera.zoom(4), torch.tensor([0.1, 0.5, 0.9])
    with torch.no_grad():
        write_gaussians(tmp_path / "view.ply", backbone.explicit(camera, last))
        again = splats_of(read_gaussians(tmp_path / "view.ply"), camera.centre)
        pictures = [
            rasterize(splats, camera, backbone.raster, background=background).image
            for splats in (backbone.draw(camera, last).splats, again)
        ]
    assert pictures[0].std() > 0.05
    assert psnr(pictures[1].clamp(0, 1), pictures[0].clamp(0, 1)) > 50


def test_explicit_anchors_have_gaussians_without_a_camera() -> None:
    backbone = small_anchors("octree_gs3d")
    gaussians = backbone.explicit(None, 1)
    assert len(gaussians.means) == len(backbone.table)
    assert gaussians.sh_rest.shape[1] == 15


@pytest.mark.parametrize("name", NEURAL)
def test_networks_have_none_and_say_what_to_do(name: str) -> None:
    with pytest.raises(InputError, match=rf"backbone {name} decodes .*`gsx export RUN FILE\.ply --view NAME`"):
        small_anchors(name).explicit(None, 1)
