"""SOG of versions 1 and 2 as other programs write it: ZIPs and folders made by hand, pixel by pixel."""

import io
import json
import logging
import math
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from foreign_splats import Sog, files_of, packed, unpacked, version_1, version_2, zipped
from PIL import Image

from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.formats.arrays import arrays_of
from gsx.formats.sog import encode_sog
from gsx.formats.splat_files import compensated, read_gaussians
from gsx.formats.suffixes import splat_file_at


def as_png(files: dict[str, bytes]) -> dict[str, bytes]:
    """The format's page allows pictures of other kinds, named in meta.json."""
    meta = {"meta.json": files["meta.json"].replace(b".webp", b".png")}
    pictures = {name: packed(np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))[0].tolist(), "PNG")
                for name, content in files.items() if name != "meta.json"}  # fmt: skip
    return meta | {name.replace(".webp", ".png"): content for name, content in pictures.items()}


PLACES: dict[str, Callable[[Path, dict[str, bytes]], Path]] = {
    "a ZIP": lambda folder, files: zipped(folder / "a.sog", files),
    "a ZIP that is packed": lambda folder, files: zipped(folder / "a.sog", files, how=zipfile.ZIP_DEFLATED),
    "a ZIP of a folder": lambda folder, files: zipped(folder / "a.sog", files, "scene/"),
    "a folder": lambda folder, files: unpacked(folder / "scene", files),
    "its meta.json": lambda folder, files: unpacked(folder / "scene", files) / "meta.json",
    "PNG in a folder": lambda folder, files: unpacked(folder / "scene", as_png(files)),
}


@pytest.mark.parametrize("place", PLACES)
def test_version_2_by_hand(tmp_path: Path, place: str) -> None:
    read = read_gaussians(PLACES[place](tmp_path, files_of(version_2())))
    far = math.exp(2) - 1  # the ends of the range of sign(x) ln(1 + |x|)
    torch.testing.assert_close(read.means, torch.tensor([[1.0, -2, 0.5], [-far, far, -far]]), atol=1e-4, rtol=0)
    assert read.log_scales.tolist() == [[-4, -2, -2], [-2, -2, -2]]
    first = torch.tensor([0.8, 0, 0.6, 0])
    torch.testing.assert_close(read.quats, torch.stack([first, torch.eye(4)[0]]), atol=3e-3, rtol=0)
    assert read.opacity_logits.sigmoid().tolist() == pytest.approx([0.2, 1], abs=1e-5)
    assert read.sh_dc.tolist() == [[1, -1, -2], [-1, -1, -1]]
    assert read.sh_rest.tolist() == [[[1.0] * 3] * 3, [[-4, -2, 1], [-2, 1, -1], [1, -1, -4]]]


@pytest.mark.parametrize("place", PLACES)
def test_version_1_by_hand(tmp_path: Path, place: str) -> None:
    read = read_gaussians(PLACES[place](tmp_path, files_of(version_1())))
    torch.testing.assert_close(read.means[0], torch.tensor([1.0, -2, 0.5]), atol=1e-4, rtol=0)
    torch.testing.assert_close(read.log_scales, torch.tensor([[-4.08, 0, -5.1], [-4.08] * 3]))
    torch.testing.assert_close(read.sh_dc, torch.tensor([[1, -1, -0.6], [-0.6] * 3]))
    assert read.opacity_logits.tolist() == pytest.approx([4, -4], abs=1e-3)
    torch.testing.assert_close(read.sh_rest, torch.tensor([[[-1.0] * 3] * 3, [[1, -1, -0.6]] * 3]))


def test_each_value_is_off_by_half_a_step_at_most() -> None:
    """Decoded here as PlayCanvas' engine does it: bytes over 255 and 65535, no halves added."""
    generator = torch.Generator().manual_seed(0)
    normal = [torch.randn(500, width, generator=generator) for width in (3, 3, 4, 1, 3)]
    made = Gaussians(means=20 * normal[0], log_scales=normal[1], quats=normal[2], opacity_logits=2 * normal[3][:, 0],
                     sh_dc=normal[4], sh_rest=torch.zeros(500, 0, 3))  # fmt: skip
    arrays = arrays_of(made)
    with zipfile.ZipFile(io.BytesIO(encode_sog(arrays))) as archive:
        entry = json.loads(archive.read("meta.json"))["means"]
        names = ("means_l", "means_u", "quats", "sh0")
        pictures = [np.asarray(Image.open(io.BytesIO(archive.read(f"{name}.webp")))) for name in names]
    low, high, quats, colours = (picture.reshape(-1, picture.shape[-1])[:500].astype(float) for picture in pictures)
    least, most = np.array(entry["mins"]), np.array(entry["maxs"])
    steps = low[:, :3] + 256 * high[:, :3]
    exact = (np.sign(arrays.means) * np.log1p(np.abs(arrays.means)) - least) / (most - least) * 65535
    order = np.abs(exact[None, :, 0] - steps[:, :1]).argsort(1)[:, :5]  # the file is in another order
    rows = np.take_along_axis(order, np.abs(exact[order] - steps[:, None]).max(2).argmin(1)[:, None], 1)[:, 0]
    assert sorted(rows) == list(range(500))
    assert np.abs(exact[rows] - steps).max() <= 0.5001
    alphas = colours[:, 3] - 255 * arrays.opacities[rows]
    assert np.abs(alphas).max() <= 0.5001
    assert abs(alphas.mean()) < 0.05
    unit, largest = arrays.quats[rows], quats[:, 3].astype(int) - 252
    assert (largest == np.abs(unit).argmax(1)).all()
    signed = unit * np.sign(unit[np.arange(500), largest])[:, None]
    others = np.array([np.delete(row, index) for row, index in zip(signed, largest, strict=True)])
    assert np.abs(quats[:, :3] - 255 * (others / 2**0.5 + 0.5)).max() <= 0.5001


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        ({}, False),
        ({"model": "antialiased"}, True),
        ({"antialias": True}, True),
        ({"antialias": False}, False),
        ({"model": "default", "antialias": True}, False),
        ({"model": "antialiased", "antialias": False}, True),
    ],
)
@pytest.mark.parametrize("version", [version_1, version_2])
@pytest.mark.parametrize("place", ["a ZIP", "a ZIP of a folder", "a folder"])
def test_both_keys_say_that_opacities_are_compensated(
    tmp_path: Path, place: str, version: Callable[[], Sog], entries: dict[str, Any], expected: bool
) -> None:
    meta, pictures = version()
    assert compensated(PLACES[place](tmp_path, files_of((meta | entries, pictures)))) is expected


def test_a_model_that_is_not_drawn_is_refused_and_an_unknown_one_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    meta, pictures = version_2()
    with pytest.raises(InputError, match="model '2dgs': it holds flat splats"):
        read_gaussians(zipped(tmp_path / "a.sog", files_of((meta | {"model": "2dgs"}, pictures))))
    with caplog.at_level(logging.WARNING):
        read_gaussians(zipped(tmp_path / "b.sog", files_of((meta | {"model": "new"}, pictures))))
    assert "the unknown model 'new'" in caplog.text


def test_a_first_entry_of_a_code_book_that_is_null_goes_on_by_its_steps(tmp_path: Path) -> None:
    """Early writers left NaN there, which JSON has as null."""
    meta, pictures = version_2()
    meta["scales"]["codebook"] = [None, *(-4 + step / 255 for step in range(255))]
    read = read_gaussians(zipped(tmp_path / "a.sog", files_of((meta, pictures))))
    assert read.log_scales[0].tolist() == pytest.approx([-4 - 254 / 255 / 255, -4, -4], abs=1e-6)


def changed(part: str, **entries: Any) -> Callable[[Sog], dict[str, bytes]]:
    def change(sog: Sog) -> dict[str, bytes]:
        meta, pictures = sog
        return files_of((meta | {part: meta[part] | entries}, pictures))

    return change


def stated(**entries: Any) -> Callable[[Sog], dict[str, bytes]]:
    return lambda sog: files_of((sog[0] | entries, sog[1]))


def pictured(name: str, content: bytes) -> Callable[[Sog], dict[str, bytes]]:
    return lambda sog: files_of(sog) | {name: content}


def without(name: str) -> Callable[[Sog], dict[str, bytes]]:
    return lambda sog: {key: content for key, content in files_of(sog).items() if key != name}


ONE = [(1, 2, 3, 255)]
LOSSY = packed(ONE * 256, size=(16, 16), lossless=False, quality=80)
HUGE = struct.pack("<4sI4s4sIBI", b"RIFF", 30, b"WEBP", b"VP8L", 10, 0x2F, 16382 | 16382 << 14) + bytes(9)
UNFIT: dict[str, tuple[Callable[[Sog], dict[str, bytes]], str]] = {
    "a later version": (stated(version=3), "version 3; gsx reads SOG 1 and 2"),
    "no number of splats": (stated(count="2"), "states no one number of splats"),
    "no splats": (stated(count=0), "states 0 splats"),
    "splats beyond its pictures": (stated(count=3), r"'means_l.webp' is 2x1, too small for 3 splats"),
    "counts that contradict": (changed("quats", shape=[5, 4]), r"no one number of splats \(\[2, 2, 5, 2\]\)"),
    "no picture": (without("quats.webp"), r"'quats.webp'( is missing|: export)"),
    "a small picture": (pictured("sh0.webp", packed(ONE)), "'sh0.webp' is 1x1, too small for 2"),
    "a lossy picture": (pictured("means_u.webp", LOSSY), "'means_u.webp' is a lossy picture"),
    "a picture of far too many pixels": (
        pictured("scales.webp", HUGE),
        "'scales.webp' is 16383x16383, far more than 2",
    ),
    "a picture that is none": (pictured("quats.webp", b"GIF89a" + bytes(40)), "neither WebP nor PNG"),
    "half a picture": (pictured("quats.webp", packed(ONE * 2)[:-20]), "'quats.webp' is no whole picture|ends within"),
    "a file far too large": (pictured("quats.webp", bytes(1 << 26)), "67,108,864 bytes, more than its splats need"),
    "no ranges": (changed("means", mins=[1, 2]), "no whole SOG"),
    "ranges that are not finite": (changed("means", maxs=[math.nan] * 3), "'means' that are not finite"),
    "another palette": (changed("shN", bands=2), "palette of 2 bands is 192 pixels wide"),
    "a label beyond the palette": (changed("shN", count=5), "vector 5 of a palette of 5"),
    "a path out of the folder": (changed("quats", files=["../quats.webp"]), "outside of its folder|has no '../quats"),
    "ranges that overflow": (changed("means", maxs=[1e300] * 3), "'means' that are not finite"),
    "names that are none": (changed("quats", files=[7]), "no whole SOG"),
}


@pytest.mark.parametrize("case", UNFIT)
@pytest.mark.parametrize("place", ["a ZIP that is packed", "a folder"])
def test_what_does_not_fit_is_refused(tmp_path: Path, place: str, case: str) -> None:
    change, words = UNFIT[case]
    sog = version_1() if case == "counts that contradict" else version_2()
    with pytest.raises(InputError, match=words) as raised:
        read_gaussians(PLACES[place](tmp_path, change(sog)))
    assert "\n" not in str(raised.value)


def test_version_1_of_another_encoding_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="encoded as 'euler'; gsx reads quaternion_packed"):
        read_gaussians(zipped(tmp_path / "a.sog", changed("quats", encoding="euler")(version_1())))
    with pytest.raises(InputError, match="ranges are of 3 columns, its picture has 4"):
        read_gaussians(zipped(tmp_path / "b.sog", changed("sh0", mins=[0] * 3, maxs=[1] * 3)(version_1())))


def test_zips_without_one_description_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a ZIP without meta\.json"):
        read_gaussians(zipped(tmp_path / "a.sog", {"scales.webp": b""}))
    with pytest.raises(InputError, match=r"meta\.json in 2 folders"):
        read_gaussians(zipped(tmp_path / "b.sog", {"a/meta.json": b"{}", "b/meta.json": b"{}"}))
    (tmp_path / "c.sog").write_bytes(b"PK\x03\x04" + bytes(50))
    with pytest.raises(InputError, match="no whole ZIP"):
        read_gaussians(tmp_path / "c.sog")
    with pytest.raises(InputError, match="describes no SOG"):
        read_gaussians(zipped(tmp_path / "d.sog", {"meta.json": b'{"version": 2}'}))


def test_a_file_that_unpacks_to_far_more_is_refused_unread(tmp_path: Path) -> None:
    path = zipped(tmp_path / "a.sog", {"meta.json": bytes(1 << 25)}, how=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 1 << 16
    with pytest.raises(InputError, match="33,554,432 bytes, more than"):
        read_gaussians(path)


def test_a_folder_of_sog_stands_for_its_description(tmp_path: Path) -> None:
    folder = unpacked(tmp_path / "scene", files_of(version_2()))
    assert splat_file_at(folder) == folder / "meta.json"
    (folder / "config.yaml").write_text("")
    assert splat_file_at(folder) == folder  # a run
    other = unpacked(tmp_path / "other", {"meta.json": b'["means", "scales", "quats"]'})
    assert splat_file_at(other) == other
    assert splat_file_at(tmp_path / "absent") == tmp_path / "absent"
