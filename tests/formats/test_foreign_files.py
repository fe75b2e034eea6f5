"""PLY files as other programs write them: made here by hand, property by property, and read by name."""

import math
import struct
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.formats.splat_files import compensated, read_gaussians, write_gaussians

C0 = 0.28209479177387814
VALUES = {"x": 1.0, "y": -2.0, "z": 0.5, "opacity": 0.847298, "scale_0": -4.60517, "scale_1": -3.91202,
          "scale_2": -2.99573, "rot_0": 0.8, "rot_1": 0.0, "rot_2": 0.6, "rot_3": 0.0, "f_dc_0": 1.0, "f_dc_1": 0.0,
          "f_dc_2": -1.0}  # fmt: skip
"""Of one splat; f_rest_i is i / 100, zero what else is asked for."""
XYZ, NORMALS, DC = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
SCALES, ROTATION = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]


def rest(count: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(count)]


ORDERS = {
    "INRIA": [*XYZ, *NORMALS, *DC, *rest(45), "opacity", *SCALES, *ROTATION],
    "gsplat": [*XYZ, *DC, *rest(45), "opacity", *SCALES, *ROTATION],
    "Brush": [*XYZ, *SCALES, "opacity", *ROTATION, *DC, *rest(45)],
    "Octree-GS, with a column of its own": [*XYZ, "level", *DC, *rest(45), "opacity", *SCALES, *ROTATION],
}


def value_of(name: str) -> float:
    return int(name.removeprefix("f_rest_")) / 100 if name.startswith("f_rest_") else VALUES.get(name, 0.0)


def written(
    path: Path, names: Sequence[str], rows: Sequence[dict[str, float]] = ({},), comments: Sequence[str] = (),
    types: dict[str, str] | None = None,
) -> Path:  # fmt: skip
    """A file of these properties; each row says what it has otherwise than VALUES."""
    types = types or {}
    kinds = [types.get(name, "float") for name in names]
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {one}" for one in comments)]
    head += [f"element vertex {len(rows)}", *(f"property {k} {n}" for k, n in zip(kinds, names, strict=True))]
    code = "<" + "".join({"float": "f", "uchar": "B", "ushort": "H", "double": "d"}[kind] for kind in kinds)
    body = [struct.pack(code, *(row.get(name, value_of(name)) for name in names)) for row in rows]
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + b"".join(body))
    return path


@pytest.mark.parametrize("program", ORDERS)
def test_properties_are_found_by_name_in_any_order(tmp_path: Path, program: str) -> None:
    read = read_gaussians(written(tmp_path / "a.ply", ORDERS[program]))
    assert read.means.tolist() == [[1.0, -2.0, 0.5]]
    assert read.opacity_logits.tolist() == [pytest.approx(0.847298)]
    assert read.log_scales[0].tolist() == pytest.approx([-4.60517, -3.91202, -2.99573])
    assert read.quats[0].tolist() == pytest.approx([0.8, 0.0, 0.6, 0.0])
    assert read.sh_dc.tolist() == [[1.0, 0.0, -1.0]]
    # all red coefficients, then green, then blue: coefficient k of channel c is f_rest_(15 c + k)
    assert read.sh_rest.shape == (1, 15, 3)
    assert read.sh_rest[0, 4].tolist() == pytest.approx([0.04, 0.19, 0.34])


@pytest.mark.parametrize(("count", "bands"), [(0, 0), (9, 3), (24, 8), (72, 15)])
def test_bands_of_other_degrees(tmp_path: Path, count: int, bands: int) -> None:
    names = [*XYZ, *DC, *rest(count), "opacity", *SCALES, *ROTATION]
    read = read_gaussians(written(tmp_path / "a.ply", names))
    assert read.sh_rest.shape == (1, bands, 3)
    if bands:  # of degree 4, too, the first band is where it was
        each = count // 3
        assert read.sh_rest[0, 1].tolist() == pytest.approx([0.01, (each + 1) / 100, (2 * each + 1) / 100])


def test_colours_in_bytes_become_the_constant_band(tmp_path: Path) -> None:
    """nerfstudio, ply_color_mode=rgb."""
    colours = ["red", "green", "blue"]
    names = [*XYZ, *NORMALS, *colours, "opacity", *SCALES, *ROTATION]
    row = {"red": 255, "green": 0, "blue": 51}
    read = read_gaussians(written(tmp_path / "a.ply", names, [row], types=dict.fromkeys(colours, "uchar")))
    assert (0.5 + C0 * read.sh_dc[0]).tolist() == pytest.approx([1.0, 0.0, 0.2], abs=1e-6)


@pytest.mark.parametrize(
    "names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), tuple("rgb")]
)
@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("uchar", (255, 0, 51)),
        ("ushort", (65535, 0, 13107)),
        ("ushort", (255, 0, 51)),
        ("float", (1.0, 0.0, 0.2)),
        ("double", (1.0, 0.0, 0.2)),
        ("float", (255.0, 0.0, 51.0)),
    ],
)
def test_colours_of_any_unit_become_the_constant_band(
    tmp_path: Path, names: tuple[str, ...], kind: str, values: tuple[float, ...]
) -> None:
    properties = [*XYZ, *names, "opacity", *SCALES, *ROTATION]
    row = dict(zip(names, values, strict=True))
    read = read_gaussians(written(tmp_path / "a.ply", properties, [row], types=dict.fromkeys(names, kind)))
    assert (0.5 + C0 * read.sh_dc[0]).tolist() == pytest.approx([1.0, 0.0, 0.2], abs=1e-6)


def test_colours_of_no_known_unit_are_refused(tmp_path: Path) -> None:
    names = [*XYZ, "red", "green", "blue", "opacity", *SCALES, *ROTATION]
    with pytest.raises(InputError, match=r"from -3 to 9000 are of no known unit: export bytes, or floats in \[0, 1\]"):
        read_gaussians(written(tmp_path / "a.ply", names, [{"red": -3.0, "green": 9000.0}]))


@pytest.mark.parametrize(("kind", "value"), [("uchar", 51), ("float", 0.2), ("double", 0.2), ("ushort", 13107)])
def test_alpha_stands_in_for_a_missing_opacity(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str, value: float
) -> None:
    names = [*XYZ, *DC, "alpha", *SCALES, *ROTATION]
    read = read_gaussians(written(tmp_path / "a.ply", names, [{"alpha": value}], types={"alpha": kind}))
    assert float(read.opacity_logits.sigmoid()) == pytest.approx(0.2, rel=1e-6)
    assert "a.ply: property opacity is missing, using alpha" in caplog.text


def test_doubles_are_read_and_those_beyond_floats_are_left_out(tmp_path: Path) -> None:
    names = ORDERS["INRIA"]
    rows = [{"x": 1.0}, {"x": 1e300}]
    read = read_gaussians(written(tmp_path / "a.ply", names, rows, types=dict.fromkeys(names, "double")))
    assert read.means.tolist() == [[1.0, -2.0, 0.5]]


def test_big_endian_files_with_faces_first_are_read(tmp_path: Path) -> None:
    little = written(tmp_path / "a.ply", ORDERS["gsplat"]).read_bytes()
    head, _, body = little.partition(b"end_header\n")
    head = head.replace(b"little", b"big").replace(b"element", b"element face 1\nproperty list uchar int i\nelement", 1)
    swapped = struct.pack(f">{len(body) // 4}f", *struct.unpack(f"<{len(body) // 4}f", body))
    (tmp_path / "b.ply").write_bytes(head + b"end_header\n" + struct.pack(">Biii", 3, 0, 0, 0) + swapped)
    read, expected = read_gaussians(tmp_path / "b.ply"), read_gaussians(tmp_path / "a.ply")
    assert all(torch.equal(value, vars(expected)[field]) for field, value in vars(read).items())


def test_rotations_of_any_length_draw_the_same(tmp_path: Path) -> None:
    """OpenSplat does not normalise them."""
    row = {name: 7 * value_of(name) for name in ROTATION}
    read = read_gaussians(written(tmp_path / "a.ply", ORDERS["INRIA"], [row]))
    unit = read.quats[0] / read.quats[0].norm()
    assert unit.tolist() == pytest.approx([0.8, 0, 0.6, 0])


def test_a_3d_filter_beside_the_scales_is_fused(tmp_path: Path) -> None:
    """Mip-Splatting keeps filter_3D in the files of its training: s' = sqrt(s^2 + f^2), o' = o prod s / s'."""
    row = {"scale_0": math.log(3.0), "scale_1": math.log(0.75), "scale_2": math.log(4.0), "filter_3D": 1.0}
    row["opacity"] = math.log(0.6 / 0.4)
    read = read_gaussians(written(tmp_path / "a.ply", [*ORDERS["INRIA"], "filter_3D"], [row]))
    wide = [math.sqrt(10), 1.25, math.sqrt(17)]
    assert read.log_scales.exp()[0].tolist() == pytest.approx(wide, rel=1e-6)
    expected = 0.6 * 3 / wide[0] * 0.75 / wide[1] * 4 / wide[2]
    assert float(read.opacity_logits.sigmoid()) == pytest.approx(expected, rel=1e-5)


def test_rows_that_are_not_finite_are_left_out_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = [{"x": 1.0}, {"x": math.nan}, {"x": 3.0, "f_rest_44": math.inf}, {"x": 4.0, "opacity": math.inf}]
    read = read_gaussians(written(tmp_path / "a.ply", ORDERS["INRIA"], rows))
    assert read.means[:, 0].tolist() == [1.0, 4.0]
    assert float(read.opacity_logits[1].sigmoid()) == 1.0  # an opacity of 1 has no finite logit
    assert "2 of 4 splats" in caplog.text
    write_gaussians(tmp_path / "again.ply", read)  # what was read can be written


def test_a_signalling_nan_is_left_out_without_a_warning_of_numpys(tmp_path: Path) -> None:
    path = written(tmp_path / "a.ply", ORDERS["INRIA"], [{"x": 1.0}, {"x": 2.0}])
    content = path.read_bytes()
    assert content.count(struct.pack("<f", 2.0)) == 1
    path.write_bytes(content.replace(struct.pack("<f", 2.0), struct.pack("<I", 0x7F800001)))
    assert read_gaussians(path).means[:, 0].tolist() == [1.0]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ([*XYZ, *DC, "opacity", *SCALES[:2], *ROTATION], "lacks property 'scale_2'.*flat splats"),
        ([*XYZ, "opacity", *SCALES, *ROTATION], "'f_dc_0', or red, green and blue"),
        ([*XYZ, *NORMALS], "'scale_0' and is a point cloud: give it as scene.points=FILE"),
        ([*XYZ, "red", "green", "blue", "alpha"], "is a point cloud"),
        ([*XYZ, *DC], "is no splat file of 3D-GS: export it anew"),
        (["u", "v"], "lacks property 'x' and is no splat file of 3D-GS, but has u, v"),
        (
            [
                *XYZ,
                *[f"f_offset_{i}" for i in range(30)],
                "f_anchor_feat_0",
                "opacity",
                "scale_0",
                "scale_1",
                "scale_2",
                "scale_3",
                *ROTATION,
            ],
            "it holds anchors of Scaffold-GS, whose Gaussians a network decodes.*--bake",
        ),
        ([*XYZ, "level", "extra_level", "f_anchor_feat_0", *SCALES, *ROTATION], "it holds anchors of Octree-GS"),
        ([*XYZ, "trbf_center", "motion_0", *SCALES, *ROTATION], "splats that move"),
        (["packed_position", "packed_rotation", "packed_scale", "packed_color"], "has no packed splats"),
        ([*XYZ, *DC[:1], "opacity", *SCALES, *ROTATION], "lacks property 'f_dc_1'"),
        ([*XYZ, *DC, *rest(44), "opacity", *SCALES, *ROTATION], "44 f_rest properties"),
        ([*XYZ, *DC, *rest(8), "f_rest_9", "opacity", *SCALES, *ROTATION], "from 0 to 8"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, names: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_gaussians(written(tmp_path / "a.ply", names))


def test_a_mesh_is_named(tmp_path: Path) -> None:
    content = written(tmp_path / "a.ply", [*XYZ, *NORMALS]).read_bytes()
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header"
    (tmp_path / "a.ply").write_bytes(content.replace(b"end_header", faces) + struct.pack("<Biii", 3, 0, 0, 0))
    with pytest.raises(InputError, match="is a mesh: give splats"):
        read_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        ((), False),
        (["Exported from Brush", "SplatRenderMode: mip"], True),
        (["splatrendermode: MIP"], True),
        (["SplatRenderMode: mip", "SplatRenderMode: default"], False),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["made by mip and antialiased 1 tools"], False),
    ],
)
def test_comments_say_whether_opacities_are_compensated(tmp_path: Path, comments: list[str], expected: bool) -> None:
    assert compensated(written(tmp_path / "a.ply", ORDERS["INRIA"], comments=comments)) is expected


@pytest.mark.parametrize("told", [True, False])
def test_spz_has_a_flag_for_it(tmp_path: Path, told: bool) -> None:
    one = Gaussians(
        means=torch.zeros(1, 3), log_scales=torch.zeros(1, 3), quats=torch.eye(4)[:1], opacity_logits=torch.zeros(1),
        sh_dc=torch.zeros(1, 3), sh_rest=torch.zeros(1, 0, 3),
    )  # fmt: skip
    write_gaussians(tmp_path / "a.spz", one, compensated=told)
    assert compensated(tmp_path / "a.spz") is told
