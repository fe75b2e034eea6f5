"""GLB and glTF as other programs write them: nodes, accessors and colours against numbers worked out here."""

import base64
import json
import logging
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from foreign_gltf import PREFIX, Builder, glb
from test_compact_files import many

from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians, splats_of
from gsx.formats.arrays import arrays_of
from gsx.formats.splat_files import is_linear, read_gaussians
from gsx.formats.spz import encode_spz

C0 = 0.28209479177387814
TURN = np.diag([-1.0, -1.0, 1.0])
"""From glTF's axes to those of training worlds."""


def read(folder: Path, document: dict[str, Any], body: bytes) -> Gaussians:
    (folder / "a.glb").write_bytes(glb(document, body))
    return read_gaussians(folder / "a.glb")


def read_with_node(folder: Path, gaussians: Gaussians, *nodes: dict[str, Any]) -> Gaussians:
    """Splats below a chain of nodes, the last of which has them."""
    builder = Builder()
    chain = [node | ({"children": [number + 1]} if number + 1 < len(nodes) else {"mesh": 0})
             for number, node in enumerate(nodes)]  # fmt: skip
    return read(folder, builder.document([[builder.splats(gaussians)]], chain), builder.body)


def matrix_of(quat: Sequence[float]) -> np.ndarray:
    """Rotation of (x, y, z, w)."""
    x, y, z, w = np.array(quat) / np.linalg.norm(quat)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def covariances(gaussians: Gaussians) -> np.ndarray:
    quats = gaussians.quats.double().numpy()[:, [1, 2, 3, 0]]
    factors = np.stack([matrix_of(quat) for quat in quats]) * gaussians.log_scales.double().exp().numpy()[:, None]
    return factors @ factors.transpose(0, 2, 1)


def check_moved(read: Gaussians, written: Gaussians, linear: np.ndarray, offset: np.ndarray) -> None:
    """Means, covariances and colours from everywhere are those of the specification. linear, offset: of the node."""
    linear, offset = TURN @ linear, TURN @ offset
    means = written.means.double().numpy() @ linear.T + offset
    np.testing.assert_allclose(read.means.numpy(), means, rtol=2e-6, atol=1e-5)
    expected = linear @ covariances(written) @ linear.T
    np.testing.assert_allclose(covariances(read), expected, rtol=1e-4, atol=2e-6 * float(np.abs(expected).max()))
    rotation = linear / np.linalg.norm(linear, axis=0)
    for eye in ([30.0, 1, 2], [-3.0, 40, 5], [1.0, 2, -50]):
        colours = splats_of(read, torch.tensor(eye)).colours
        seen = (means - np.array(eye)) @ rotation  # directions in the file's own axes
        centred = Gaussians(**{**vars(written), "means": torch.from_numpy(seen).float()})
        torch.testing.assert_close(colours, splats_of(centred, torch.zeros(3)).colours, atol=2e-5, rtol=0)


QUAT = (0.1, -0.5, 0.3, 0.8)


@pytest.mark.parametrize(
    ("nodes", "linear", "offset"),
    [
        ([{}], np.eye(3), np.zeros(3)),
        ([{"rotation": [0, 0, 1, 0]}], TURN, np.zeros(3)),
        ([{"rotation": [1, 0, 0, 0]}], np.diag([1.0, -1, -1]), np.zeros(3)),
        ([{"rotation": QUAT, "translation": [1, 2, 3], "scale": [2, 2, 2]}], 2 * matrix_of(QUAT), np.array([1, 2, 3])),
        ([{"scale": [0.5, 2, 3]}], np.diag([0.5, 2, 3]), np.zeros(3)),
        ([{"rotation": QUAT, "scale": [0.5, 2, 3]}], matrix_of(QUAT) * [0.5, 2, 3], np.zeros(3)),
        ([{"translation": [0, 5, 0]}, {"rotation": QUAT}, {"translation": [1, 0, 0], "scale": [3, 3, 3]}],
         3 * matrix_of(QUAT), np.array([0, 5, 0]) + matrix_of(QUAT)[:, 0]),
        ([{"matrix": [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 7, 8, 9, 1]}],
         np.array([[0, -2.0, 0], [2, 0, 0], [0, 0, 2]]), np.array([7, 8, 9])),
    ],
    ids=["none", "turned", "flipped", "similarity", "stretched", "turned and stretched", "parents", "matrix"],
)  # fmt: skip
def test_splats_lie_where_their_node_is(
    tmp_path: Path, nodes: list[dict[str, Any]], linear: np.ndarray, offset: np.ndarray
) -> None:
    written = many(20, 3)
    check_moved(read_with_node(tmp_path, written, *nodes), written, linear, offset)


def test_data_turned_about_z_without_a_node_s_rotation_is_exact(tmp_path: Path) -> None:
    """As splat-transform writes: only signs change."""
    written = many(9, 3)
    back = read_with_node(tmp_path, read_with_node(tmp_path, written, {}), {})
    for name in ("means", "sh_dc", "sh_rest"):
        assert torch.equal(vars(back)[name], vars(written)[name])


@pytest.mark.parametrize(
    ("nodes", "words"),
    [
        ([{"scale": [-1, 1, 1]}], "mirrors"),
        ([{"scale": [0, 1, 1]}], "scale of 0"),
        ([{"scale": [1, 2, 3]}, {"rotation": QUAT}], "shears"),
        ([{"matrix": [1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}], "shears"),
        ([{"translation": [1e29, 0, 0]}, {"translation": [2e30, 0, 0]}], "'translation' is"),
        ([{"scale": [1e20] * 3}, {"scale": [1e20] * 3}], "beyond all numbers"),
        ([{"rotation": [0, 0, 1]}], "'rotation' is .*no 4 finite numbers"),
    ],
)
def test_nodes_that_cannot_move_splats_are_named(tmp_path: Path, nodes: list[dict[str, Any]], words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_with_node(tmp_path, many(3, 1), *nodes)


def test_several_nodes_meshes_and_primitives_are_put_together(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    builder, one, other = Builder(), many(3, 1), many(2, 0, seed=1)
    triangles = {"attributes": {"POSITION": builder.accessor(np.zeros((3, 3)))}}
    nodes = [{"children": [1, 2, 3]}, {"mesh": 0}, {"mesh": 1, "translation": [0, 0, 1]}, {"mesh": 1}, {"mesh": 1}]
    meshes = [[builder.splats(one), triangles], [builder.splats(other)]]
    found = read(tmp_path, builder.document(meshes, nodes), builder.body)  # the last node is in no scene
    turned = torch.tensor([-1.0, -1, 1])
    expected = [one.means * turned, other.means * turned + torch.tensor([0.0, 0, 1]), other.means * turned]
    torch.testing.assert_close(found.means, torch.cat(expected))
    assert found.sh_rest.shape == (7, 3, 3)
    assert not found.sh_rest[3:].any()
    assert "1 primitives of its scene are no splats" in caplog.text


def test_bytes_strides_and_sparse_values_by_hand(tmp_path: Path) -> None:
    builder = Builder()
    primitive = builder.splats(many(2, 0))
    attributes = primitive["attributes"]
    attributes["COLOR_0"] = builder.accessor(np.full((2, 4), 255), 5121, normalized=True)
    attributes["_OWN"] = 99
    positions = builder.view(struct.pack("<8h", 100, -200, 300, 0, 400, 500, -600, 0), byteStride=8)
    attributes["POSITION"] = len(builder.accessors)
    builder.accessors.append({"bufferView": positions, "componentType": 5122, "count": 2, "type": "VEC3"})
    attributes[f"{PREFIX}:ROTATION"] = builder.accessor(
        np.array([[0, 0, 0, 127], [-128, 0, 0, 0]]), 5120, normalized=True
    )
    attributes[f"{PREFIX}:SCALE"] = builder.accessor(np.array([[65535, 13107, 0], [6, 7, 8]]), 5123, normalized=True)
    attributes[f"{PREFIX}:OPACITY"] = len(builder.accessors)
    sparse = {"count": 1, "indices": {"bufferView": builder.view(b"\1"), "componentType": 5121},
              "values": {"bufferView": builder.view(b"\x33")}}  # fmt: skip
    builder.accessors.append(
        {"componentType": 5121, "normalized": True, "count": 2, "type": "SCALAR", "sparse": sparse}
    )
    node = {"mesh": 0, "scale": [0.01] * 3, "rotation": [0, 0, 1, 0]}  # KHR_mesh_quantization
    found = read(tmp_path, builder.document([[primitive]], [node]), builder.body)
    torch.testing.assert_close(found.means, torch.tensor([[1.0, -2, 3], [4, 5, -6]]))
    torch.testing.assert_close(found.opacity_logits.sigmoid(), torch.tensor([0, 0.2]), atol=2e-6, rtol=1e-5)
    scales = found.log_scales.exp()
    torch.testing.assert_close(scales[0, :2], torch.tensor([0.01, 0.002]))
    assert 0 < float(scales[0, 2]) < 1e-9
    torch.testing.assert_close(found.quats.abs(), torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0]]))


@pytest.mark.parametrize("name", ["a.gltf", "a.glb"])
@pytest.mark.parametrize("kind", ["data", "file"])
def test_text_with_its_buffers(tmp_path: Path, kind: str, name: str) -> None:
    builder, written = Builder(), many(4, 1)
    document = builder.document([[builder.splats(written)]], [{"mesh": 0, "rotation": [0, 0, 1, 0]}])
    uri = "data:application/octet-stream;base64," + base64.b64encode(builder.body).decode()
    document["buffers"][0]["uri"] = uri if kind == "data" else "my%20splats.bin"
    (tmp_path / "my splats.bin").write_bytes(builder.body)
    (tmp_path / name).write_text(json.dumps(document))
    assert torch.equal(read_gaussians(tmp_path / name).means, written.means)
    (tmp_path / "my splats.bin").unlink()
    if kind == "file":
        with pytest.raises(InputError, match=r"buffer 'my splats.bin' cannot be read"):
            read_gaussians(tmp_path / name)
    for outside in ("../b.bin", "/b.bin", "https://example.org/b.bin"):
        document["buffers"][0]["uri"] = outside
        (tmp_path / name).write_text(json.dumps(document))
        with pytest.raises(InputError, match="is no file next to it: export it as GLB"):
            read_gaussians(tmp_path / name)


@pytest.mark.parametrize("place", ["outer", "inner"])
def test_splats_kept_as_spz(tmp_path: Path, place: str) -> None:
    """Proposals of Cesium: the node turns what SPZ holds."""
    builder, written = Builder(), many(4, 1)
    spz = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": builder.view(encode_spz(arrays_of(written)))}}
    rules = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extensions = {PREFIX: rules | {"extensions": spz}} if place == "inner" else {PREFIX: rules} | spz
    primitive = {"mode": 0, "attributes": {}, "extensions": extensions}
    document = builder.document([[primitive]], [{"mesh": 0, "rotation": [0, 0, 1, 0]}])
    torch.testing.assert_close(read(tmp_path, document, builder.body).means, written.means, atol=1.3e-4, rtol=0)


# -- colours -----------------------------------------------------------------------------------------------------------


def srgb(light: float) -> float:
    return 12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055


def with_space(folder: Path, gaussians: Gaussians, space: str) -> Gaussians:
    builder = Builder()
    primitive = builder.splats(gaussians, colorSpace=space)
    return read(folder, builder.document([[primitive]], [{"mesh": 0, "rotation": [0, 0, 1, 0]}]), builder.body)


def test_linear_colours_of_degree_0_become_srgb_exactly(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lights = torch.tensor([[0.0, 0.001, 0.21404114], [0.5, 1.0, 1.7], [-0.3, 0.0031308, 0.04]])
    written = Gaussians(**{**vars(many(3, 0)), "sh_dc": (lights - 0.5) / C0})
    shown = 0.5 + C0 * with_space(tmp_path, written, "lin_rec709_display").sh_dc
    expected = [[srgb(max(light, 0.0)) for light in row] for row in lights.tolist()]
    np.testing.assert_allclose(shown.numpy(), expected, atol=2e-6)
    assert expected[0][2] == pytest.approx(0.5, abs=1e-6)
    assert "become sRGB, each to within 0.0000 RMS" in caplog.text


def test_linear_harmonics_are_fitted_and_the_error_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    made = many(30, 3)
    dc, rest = (torch.full((30, 3), 0.3) - 0.5) / C0, made.sh_rest / 10
    written = Gaussians(**{**vars(made), "sh_dc": dc, "sh_rest": rest})
    found = with_space(tmp_path, written, "lin_rec709_display")
    errors = []
    for eye in torch.randn(40, 3, generator=torch.Generator().manual_seed(0)) * 100:
        light, shown = (splats_of(one, eye).colours for one in (written, found))
        errors.append(shown - light.double().apply_(srgb))
    rms = float(torch.cat(errors).square().mean().sqrt())
    logged = float(caplog.text.partition("to within ")[2].split()[0])
    assert rms < 0.02
    assert logged == pytest.approx(rms, rel=0.3)


def test_a_file_is_told_apart_by_its_colours(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match="colours are of 'acescg', gsx reads srgb_rec709_display and lin_rec709_display"
    ):
        with_space(tmp_path, many(2, 0), "acescg")


def test_linear_colours_are_known_by_their_file(tmp_path: Path) -> None:
    for space, linear in (("lin_rec709_display", True), ("srgb_rec709_display", False)):
        with_space(tmp_path, many(2, 0), space)
        assert is_linear(tmp_path / "a.glb") is linear


def test_splats_that_name_no_rules_are_read_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    builder = Builder()
    primitive = builder.splats(many(2, 0))
    primitive["extensions"][PREFIX] = {}
    read(tmp_path, builder.document([[primitive]], [{"mesh": 0}]), builder.body)
    assert "splats have no kernel, using 'ellipse'" in caplog.text
    assert "splats have no colorSpace, using 'srgb_rec709_display'" in caplog.text


# -- what is refused ---------------------------------------------------------------------------------------------------


def refused(folder: Path, change: Any, words: str) -> None:
    builder = Builder()
    primitive = builder.splats(many(2, 1))
    document = builder.document([[primitive]], [{"mesh": 0}])
    change(document, primitive)
    with pytest.raises(InputError, match=words):
        read(folder, document, builder.body)


def of_zeros(document: dict[str, Any], count: int) -> None:
    """Make the first accessor one without a buffer view."""
    document["accessors"].insert(0, {"componentType": 5126, "type": "VEC3", "count": count})


def rules_of(primitive: dict[str, Any]) -> dict[str, Any]:
    return primitive["extensions"][PREFIX]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d, p: rules_of(p).update(kernel="disc"), "kernel is 'disc', gsx draws 'ellipse' alone"),
        (lambda d, p: rules_of(p).update(projection="orthographic"), "projection is 'orthographic'"),
        (lambda d, p: rules_of(p).update(extensions={"EXT_disc": {}}), "need 'EXT_disc', which is not read"),
        (lambda d, p: p.pop("extensions"), "holds no splats .*, but 1 other primitives, though their attributes"),
        (lambda d, p: p.update(extensions={}, attributes={"POSITION": 0}), "but 1 other primitives. Choose another"),
        (lambda d, p: p["attributes"].pop(f"{PREFIX}:SCALE"), "lack attribute KHR_gaussian_splatting:SCALE:"),
        (lambda d, p: p.update(attributes={"POSITION": 0, "_SCALE": 1}), "as drafts of the extension did"),
        (lambda d, p: p["attributes"].pop(f"{PREFIX}:SH_DEGREE_1_COEF_1"), "harmonics lack coefficients, it has 2"),
        (lambda d, p: p["attributes"].update({f"{PREFIX}:SCALE": 1}), "SCALE has 2 x 4 values, not 2 x 3"),
        (lambda d, p: d["accessors"][0].update(count=10**12), "its buffer view fewer"),
        (lambda d, p: d["accessors"][0].update(count=1.5), "'count' is 1.5, no whole number"),
        (lambda d, p: d["accessors"][0].update(type="MAT4"), "no type that splats have"),
        (lambda d, p: d["accessors"][0].pop("bufferView"), None),
        (lambda d, p: of_zeros(d, 10**9), "than the file has bytes"),
        (lambda d, p: of_zeros(d, 10**15) or d.update(buffers=[{"byteLength": 2**52}]), "buffer 0 has .* of 4,503,"),
        (lambda d, p: of_zeros(d, 5) or d.update(buffers=[3]), r"buffers\[0\] is missing"),
        (lambda d, p: d["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}), "compressed .EXT_mesh"),
        (lambda d, p: d["bufferViews"][0].update(byteLength=10**9), "ends beyond its buffer"),
        (lambda d, p: d["nodes"].append({"children": [1]}) or d.update(scenes=[{"nodes": [0, 1]}]), "two parents"),
        (lambda d, p: d.update(nodes=[{"mesh": 7}]), r"meshes\[7\] is missing"),
        (lambda d, p: d.update(buffers=[{"byteLength": 10**9}]), "buffer 0 has .* of 1,000,000,000 bytes"),
        (lambda d, p: d["asset"].update(version="1.0"), "glTF of version 1.0"),
    ],
)  # fmt: skip
def test_what_is_not_read_is_named(tmp_path: Path, change: Any, words: str | None) -> None:
    if words is not None:
        refused(tmp_path, change, words)
        return
    builder = Builder()
    document = builder.document([[builder.splats(many(2, 1))]], [{"mesh": 0}])
    change(document, None)
    assert not read(tmp_path, document, builder.body).means.any()  # an accessor without a buffer view is of zeros


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (f"{PREFIX}:SCALE", -1.0, "a scale is below 0, but scales are no logarithms"),
        (f"{PREFIX}:OPACITY", 3.0, r"an opacity is beyond \[0, 1\], but opacities are no logits"),
    ],
)
def test_values_that_are_not_activated_are_refused(tmp_path: Path, name: str, value: float, words: str) -> None:
    builder = Builder()
    primitive = builder.splats(many(2, 0))
    width = 3 if name.endswith("SCALE") else 1
    primitive["attributes"][name] = builder.accessor(np.full((2, width), value))
    with pytest.raises(InputError, match=words):
        read(tmp_path, builder.document([[primitive]], [{"mesh": 0}]), builder.body)


def test_rows_that_are_not_finite_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    written = many(4, 1)
    written.means[1, 2] = math.nan
    written.sh_rest[2, 0, 0] = math.inf
    assert len(read_with_node(tmp_path, written, {}).means) == 2
    assert "a.glb: 2 of 4 splats have values that are not finite" in caplog.text
