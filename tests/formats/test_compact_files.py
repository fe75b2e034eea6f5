"""Compact splat files against bytes worked out by hand from their specifications, and the steps they promise."""

import gzip
import io
import json
import math
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gsx.core.data.camera import Camera, look_at
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians, splats_of
from gsx.core.rasterizer import RasterSettings, rasterize_tiled
from gsx.formats.arrays import arrays_of
from gsx.formats.compressed_ply import encode_compressed_ply, packed_11_10_11
from gsx.formats.glb import encode_glb
from gsx.formats.ply import elements_of
from gsx.formats.sog import (
    encode_sog,
    mean_words,
    nearest_number,
    number_book,
    quaternion_bytes,
    signed_log,
    vector_book,
)
from gsx.formats.splat_files import SpzForm, compensated, read_gaussians, write_gaussians
from gsx.formats.spz import encode_spz
from gsx.formats.turned import to_training_axes

KINDS = (".compressed.ply", ".spz", ".sog", ".glb")


def the_splat() -> Gaussians:
    """The one whose bytes are worked out by hand, in training axes."""
    return Gaussians(
        means=torch.tensor([[1.0, -2.0, 0.5]]),
        log_scales=torch.tensor([[0.01, 0.02, 0.05]]).log(),
        quats=torch.tensor([[0.8, 0.0, 0.6, 0.0]]),
        opacity_logits=torch.tensor([math.log(0.7 / 0.3)]),
        sh_dc=torch.tensor([[1.0, 0.0, -1.0]]),
        sh_rest=torch.zeros(1, 0, 3),
    )


def many(count: int, degree: int = 3, seed: int = 0) -> Gaussians:
    """Random splats, quaternions of any length."""
    generator = torch.Generator().manual_seed(seed)

    def random(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator)

    return Gaussians(
        means=5 * random(count, 3),
        log_scales=random(count, 3) - 3,
        quats=3 * random(count, 4),
        opacity_logits=2 * random(count),
        sh_dc=random(count, 3),
        sh_rest=0.2 * random(count, (degree + 1) ** 2 - 1, 3),
    )


def test_spz_of_a_splat_by_hand() -> None:
    data = gzip.decompress(encode_spz(arrays_of(to_training_axes(the_splat(), "rub"))))
    assert data[:16].hex() == "4e4753500300000001000000000c0000"
    assert data[16:25].hex() == "00100000200000f8ff"  # 1, 2, -0.5: y up, z back
    assert data[25] in (0xB2, 0xB3)  # 178.5
    assert data[26:29].hex() == "a68059"
    assert data[29:32].hex() == "566170"
    assert data[32:].hex() == "00c80ec0"


def test_spz_coefficients_by_hand() -> None:
    rest = torch.zeros(1, 15, 3)
    rest[0, 1] = rest[0, 6] = torch.tensor([0.3, 1.0, -2.0])  # z and 3z^2 - 1, the latter the same in all axes
    data = gzip.decompress(encode_spz(arrays_of(replace(the_splat(), sh_rest=rest))))
    coefficients = np.frombuffer(data[36:], np.uint8).reshape(15, 3)
    assert coefficients[1].tolist() == [168, 255, 0]
    assert coefficients[6].tolist() == [160, 255, 0]
    assert (np.delete(coefficients, [1, 6], 0) == 128).all()


def test_spz_of_version_2_is_read(tmp_path: Path) -> None:
    body = bytes.fromhex("4e4753500200000001000000000c000000100000200000f8ffb3a68059566170803380")
    (tmp_path / "two.spz").write_bytes(gzip.compress(body))
    read = read_gaussians(tmp_path / "two.spz")
    torch.testing.assert_close(read.means, the_splat().means)
    torch.testing.assert_close(read.quats, the_splat().quats, atol=5e-3, rtol=0)
    torch.testing.assert_close(read.log_scales.exp(), torch.tensor([[0.00980, 0.01950, 0.04979]]), atol=1e-5, rtol=0)
    torch.testing.assert_close(read.sh_dc, torch.tensor([[1.0065, 0.0131, -1.0065]]), atol=1e-4, rtol=0)


def test_spz_with_extensions_is_read_without_them(tmp_path: Path) -> None:
    data = bytearray(gzip.decompress(encode_spz(arrays_of(to_training_axes(the_splat(), "rub")))))
    for flags, readable in ((0, False), (2, True)):
        data[14] = flags
        (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data) + struct.pack("<IIB", 0xADBE0002, 1, 3)))
        if readable:
            torch.testing.assert_close(read_gaussians(tmp_path / "a.spz").means, the_splat().means)
        else:
            with pytest.raises(InputError, match="has not the bytes of 1 splats"):
                read_gaussians(tmp_path / "a.spz")


def test_compressed_ply_of_a_splat_by_hand() -> None:
    content = encode_compressed_ply(arrays_of(the_splat()))
    assert content.startswith(b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n")
    elements = elements_of(content)
    (chunk,), (vertex,) = elements["chunk"], elements["vertex"]
    assert (chunk["min_x"], chunk["max_y"], chunk["min_z"]) == (1, -2, 0.5)
    assert (vertex["packed_position"], vertex["packed_scale"]) == (0, 0)
    assert vertex["packed_rotation"] == 0x200ECA00
    assert vertex["packed_color"] in (0x000000B2, 0x000000B3)
    assert packed_11_10_11(np.array([[0.25, 0.5, 1.0]]))[0] == 0x401007FF


@pytest.mark.parametrize("count", [100, 900])
def test_a_sky_takes_no_precision_from_compressed_ply(tmp_path: Path, count: int) -> None:
    """Chunks of what is near are as small as without it, but for one with the faintest."""
    near = many(2000)
    scattered = torch.randn(count, 3, generator=torch.Generator().manual_seed(9))
    sky = replace(many(count), means=1000 * scattered / scattered.norm(dim=1, keepdim=True))
    both = Gaussians(**{name: torch.cat([value, vars(sky)[name]]) for name, value in vars(near).items()})
    solid, errors = near.means[near.opacity_logits > 0], []
    for name, gaussians in (("near", near), ("both", both)):
        write_gaussians(tmp_path / f"{name}.compressed.ply", gaussians)
        back = read_gaussians(tmp_path / f"{name}.compressed.ply").means
        errors.append((back[:, None] - solid).norm(dim=2).amin(0))
    assert float(errors[1].median()) < 1.5 * float(errors[0].median())
    assert float(errors[1].max()) < 1.5 * float(errors[0].max())


def test_glb_of_a_splat_by_hand() -> None:
    content = encode_glb(arrays_of(the_splat()))
    magic, version, length, size, kind = struct.unpack_from("<IIIII", content)
    assert (magic, version, length, kind) == (0x46546C67, 2, len(content), 0x4E4F534A)
    assert size % 4 == 0
    document, body = json.loads(content[20 : 20 + size]), content[28 + size :]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]

    def stored(name: str) -> str:
        view = document["bufferViews"][
            document["accessors"][attributes[f"KHR_gaussian_splatting:{name}"]]["bufferView"]
        ]
        return body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]].hex()

    assert stored("OPACITY") == "3333333f"
    np.testing.assert_allclose(
        np.frombuffer(bytes.fromhex(stored("SCALE")), "<f4"), [0.01, 0.02, 0.05], rtol=1e-6
    )  # linear
    assert stored("ROTATION") == np.array([0, 0.6, 0, 0.8], "<f4").tobytes().hex()
    assert document["nodes"] == [{"mesh": 0, "rotation": [0, 0, 1, 0]}]  # 180 degrees about z: y up
    assert document["accessors"][0]["min"] == [1, -2, 0.5]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("count", "degree"), [(1, 0), (255, 1), (256, 2), (257, 3), (10_000, 3)])
def test_splats_come_back_within_the_format_s_steps(tmp_path: Path, kind: str, count: int, degree: int) -> None:
    written = many(count, degree)
    write_gaussians(tmp_path / f"a{kind}", written)
    read = read_gaussians(tmp_path / f"a{kind}")
    if kind in (".compressed.ply", ".sog"):  # in another order
        order = torch.cdist(written.means.double(), read.means.double()).argmin(1)
        assert len(set(order.tolist())) == count
        read = Gaussians(**{name: value[order] for name, value in vars(read).items()})
    steps = {  # largest errors of means, log_scales, opacities, dc, coefficients, and angles in rad
        ".compressed.ply": (0.02, 0.005, 0.5 / 255, 0.03, 1 / 32, 0.0045),
        ".spz": (0.5 / 4096, 1 / 32, 0.5 / 255, 0.0131, 0.07, 0.0045),
        ".sog": (0.002, 0.3, 0.5 / 255, 0.3, 1.0, 0.016),  # code books: few entries where values are rare
        ".glb": (0, 1e-5, 1e-6, 0, 0, 1e-3),
    }[kind]
    far = (read.means - written.means).abs().max(), (read.log_scales - written.log_scales).abs().max()
    far += ((read.opacity_logits.sigmoid() - written.opacity_logits.sigmoid()).abs().max(),)
    inside = written.sh_dc.abs().amax(1) < 3.2
    far += ((read.sh_dc - written.sh_dc)[inside].abs().max(),)
    held = written.sh_rest.abs() < 0.9
    far += (
        (read.sh_rest - written.sh_rest)[held].abs().max() if held.any() else torch.zeros(()),
        angles(read, written).max(),
    )
    assert all(float(error) <= step * 1.01 for error, step in zip(far, steps, strict=True)), (far, steps)
    assert float((read.log_scales - written.log_scales).abs().mean()) < 0.02
    assert float((read.sh_dc - written.sh_dc).abs().mean()) < 0.02


def angles(a: Gaussians, b: Gaussians) -> torch.Tensor:
    """Between rotations, radians."""
    unit = [torch.nn.functional.normalize(one.quats.double(), dim=1) for one in (a, b)]
    return 2 * torch.acos((unit[0] * unit[1]).sum(1).abs().clamp(max=1))


EYES = ((12.0, 3.0, 4.0), (-2.0, -12.0, 3.0), (1.0, 2.0, -13.0))


def picture(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    """As a viewer draws them, over black."""
    splats = splats_of(gaussians, camera.centre)
    return rasterize_tiled(splats, camera, RasterSettings(), background=torch.zeros(3)).image


def large(count: int) -> Gaussians:
    """Splats that fill a picture."""
    made = many(count, 3, seed=1)
    return replace(made, means=made.means / 2, log_scales=made.log_scales + 2)


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_the_same_from_any_side(tmp_path: Path, kind: str) -> None:
    write_gaussians(tmp_path / f"a{kind}", written := large(40))
    read = read_gaussians(tmp_path / f"a{kind}")
    for eye in EYES:
        camera = look_at(eye, (0.0, 0.0, 0.0), fov_x=0.9, width=64, height=48)
        first = picture(written, camera)
        assert float((first - picture(read, camera)).abs().mean()) < (0.02 if kind == ".sog" else 0.01)  # 32 colours
        assert float(first.mean()) > 0.1


@pytest.mark.parametrize("axes", ["rub", "rdf"])
def test_a_world_with_y_up_and_z_back_is_seen_by_cameras_turned_with_it(tmp_path: Path, axes: str) -> None:
    write_gaussians(tmp_path / "a.spz", written := large(40), spz=SpzForm(axes=axes))
    stored = read_gaussians(tmp_path / "a.spz", axes="rdf")  # as it lies in the file
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0] if axes == "rub" else [1.0, 1.0, 1.0])).double()
    for eye in EYES:
        camera = look_at(eye, (0.0, 0.0, 0.0), fov_x=0.9, width=64, height=48)
        turned = replace(camera, rotation=camera.rotation @ turn)
        assert float((picture(written, camera) - picture(stored, turned)).abs().mean()) < 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_opacities_of_nearly_0_and_1_survive(tmp_path: Path, kind: str) -> None:
    write_gaussians(tmp_path / f"a{kind}", replace(many(2), opacity_logits=torch.tensor([-200.0, 200.0])))
    read = read_gaussians(tmp_path / f"a{kind}")
    assert bool(torch.isfinite(read.opacity_logits).all())
    assert sorted(read.opacity_logits.sigmoid().round(decimals=3).tolist()) == [0, 1]


@pytest.mark.parametrize("kind", KINDS)
def test_what_cannot_be_held_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a{kind}"
    with pytest.raises(InputError, match="no splats"):
        write_gaussians(path, many(0))
    spoilt = many(5)
    spoilt.means[3, 1] = math.nan
    with pytest.raises(InputError, match="1 of 15 values of 'means' are not finite"):
        write_gaussians(path, spoilt)
    if kind == ".spz":
        with pytest.raises(InputError, match="coordinates up to 2,048, the model has 2,050"):
            write_gaussians(path, replace(the_splat(), means=torch.tensor([[0.0, -2050.0, 0.0]])))
    assert not path.exists()


@pytest.mark.parametrize("kind", KINDS)
def test_no_byte_can_be_missing(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a{kind}"
    write_gaussians(path, many(3, 1))
    content = path.read_bytes()
    for end in range(
        0, len(content) - 9, max(7, len(content) // 500)
    ):  # the last 8 bytes of gzip are its checksum, which numbers check, too
        path.write_bytes(content[:end])
        with pytest.raises(InputError, match=r"cannot be read: .*anew|cannot be read: it is no GLB"):
            read_gaussians(path)


def test_a_compressed_ply_of_no_elements_is_told(tmp_path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nend_header\n"
    (tmp_path / "a.compressed.ply").write_text(head)
    with pytest.raises(InputError, match="no vertices, its elements are: none"):
        read_gaussians(tmp_path / "a.compressed.ply")


@pytest.mark.parametrize("kind", [".ply", *KINDS])
@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "a.glb"])
def test_files_are_read_by_their_first_bytes(tmp_path: Path, kind: str, name: str) -> None:
    write_gaussians(tmp_path / f"b{kind}", many(5, 1))
    expected = read_gaussians(tmp_path / f"b{kind}")
    (tmp_path / name).write_bytes((tmp_path / f"b{kind}").read_bytes())
    read = read_gaussians(tmp_path / name)
    assert all(torch.equal(value, vars(expected)[field]) for field, value in vars(read).items())
    assert compensated(tmp_path / name) is False


def test_sog_of_a_splat_by_hand() -> None:
    arrays = arrays_of(the_splat())
    words = mean_words(signed_log(arrays.means), np.full(3, -2.0), np.full(3, 2.0))
    assert words.tolist() == [[44124, 14768, 39411]]  # 44123.85, 14768.1 and 39410.5, rounded
    assert (words & 255).tolist() == [[0x5C, 0xB0, 0xF3]]
    assert (words >> 8).tolist() == [[0xAC, 0x39, 0x99]]
    assert quaternion_bytes(arrays.quats).tobytes().hex() == "80ec80fc"  # 127.5, 235.7 and 127.5
    with zipfile.ZipFile(io.BytesIO(encode_sog(arrays))) as archive:
        meta = json.loads(archive.read("meta.json"))
        with Image.open(io.BytesIO(archive.read("sh0.webp"))) as picture:
            assert picture.size == (4, 4)
            red, green, blue, alpha = picture.getpixel((0, 0))
    assert alpha in (0xB2, 0xB3)  # 178.5
    assert [meta["sh0"]["codebook"][index] for index in (red, green, blue)] == pytest.approx([1, 0, -1])
    assert (meta["version"], meta["count"]) == (2, 1)


def test_code_books_by_hand() -> None:
    """Three heaps of numbers and three entries: their means; k-means of vectors as many as there are: themselves."""
    values = np.array([0.0, 0.2, 5.0, 5.2, 5.4, 9.0])
    book = number_book(values, 3)
    assert book.tolist() == pytest.approx([0.1, 5.2, 9.0])
    assert nearest_number(np.array([-1.0, 2.7, 7.0, 7.2]), book).tolist() == [0, 1, 1, 2]
    vectors = np.random.default_rng(0).normal(size=(7, 4))
    found, labels = vector_book(vectors, 7)
    assert np.allclose(found[labels], vectors, atol=1e-6)
    pairs = np.repeat(np.eye(3) * 10, 5, 0) + np.random.default_rng(1).normal(size=(15, 3)) * 0.1
    found, labels = vector_book(pairs, 3)
    assert np.allclose(found, pairs.reshape(3, 5, 3).mean(1), atol=1e-5)
    assert labels.tolist() == [0] * 5 + [1] * 5 + [2] * 5
