"""Every promised format of photos through both libraries: what COLMAP gets is what gsx trains on."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest
import torch
from photo_files import lossless_webp, write_pixels, write_webp_with_exif
from refusals import refused

from gsx.core.data.images import image_size, read_image, write_image
from gsx.scenes import sfm_copies
from gsx.scenes.exif import lens_of
from gsx.scenes.orientation import oriented
from gsx.scenes.photos import PHOTO_SUFFIXES, find_photos, readable_sizes
from gsx.scenes.readable import readable_size

HEIGHT, WIDTH = 48, 64
ROWS, COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]
PICTURE = np.stack([COLUMNS * 4, ROWS * 5, (ROWS + COLUMNS) * 2], -1).astype(np.uint8)
ALPHA = np.dstack([PICTURE, np.where(COLUMNS > 40, 60, 255).astype(np.uint8)])
LENS = {"Make": "Maker", "Model": "Phone", "Exif:FocalLengthIn35mmFilm": 28}


def by_openimageio(pixels: np.ndarray, **attributes: int | str) -> Callable[[Path], None]:
    """Return what writes pixels to a file; `a__b=1` sets attribute a:b."""

    named = {name.replace("__", ":"): value for name, value in attributes.items()}
    return lambda path: write_pixels(path, pixels, named | LENS)


def palette_png(path: Path) -> None:
    """PNG of 16 colours."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    rows = b"".join(b"\0" + bytes(row) for row in (COLUMNS // 4).tolist())
    colours = bytes(value for i in range(16) for value in (i * 16, 255 - i * 8, 40))
    head = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 8, 3, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"PLTE", colours), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*one) for one in chunks))


def tiff_of(compression: int, strip: Callable[[Path], bytes]) -> Callable[[Path], None]:
    """Return what writes an RGB TIFF of one strip, compressed as the number says."""

    def write(path: Path) -> None:
        body = strip(path)
        tags = {256: WIDTH, 257: HEIGHT, 259: compression, 262: 2, 273: 8, 277: 3, 278: HEIGHT, 279: len(body)}
        start = 8 + len(body) + len(body) % 2
        after = start + 2 + 12 * (len(tags) + 1) + 4
        entries = [(number, 4, 1, value) for number, value in tags.items()] + [(258, 3, 3, after)]
        directory = b"".join(struct.pack("<HHII", *entry) for entry in sorted(entries))
        head = b"II*\0" + struct.pack("<I", start) + body + b"\0" * (len(body) % 2)
        path.write_bytes(head + struct.pack("<H", len(entries)) + directory + bytes(4) + struct.pack("<3H", 8, 8, 8))

    return write


def renamed(path: Path, suffix: str, write: Callable[[Path], None]) -> None:
    """Write a file of another format under this name."""
    write(path.with_name(f"other{suffix}"))
    path.with_name(f"other{suffix}").rename(path)


WIDE = PICTURE.astype(np.uint16) * 257
ALIKE = {
    "baseline.jpg": by_openimageio(PICTURE, Compression="jpeg:95"),
    "progressive.jpeg": by_openimageio(PICTURE, jpeg__progressive=1),
    "grey.jpg": by_openimageio(PICTURE[..., :1]),
    "rgb.png": by_openimageio(PICTURE),
    "wide.png": by_openimageio(WIDE),
    "grey.png": by_openimageio(PICTURE[..., :1]),
    "greywide.png": by_openimageio(WIDE[..., :1]),
    "alpha.png": by_openimageio(ALPHA),
    "palette.png": palette_png,
    "plain.tif": by_openimageio(PICTURE, Compression="none"),
    "lzw.tiff": by_openimageio(PICTURE, Compression="lzw"),
    "deflate.tif": by_openimageio(PICTURE, Compression="zip"),
    "wide.tif": by_openimageio(WIDE, Compression="lzw"),
    "grey.tif": by_openimageio(PICTURE[..., :1]),
    "alpha.tif": by_openimageio(ALPHA),
    "rgb.bmp": by_openimageio(PICTURE),
    "upper.JPG": by_openimageio(PICTURE),
    "jpeg_inside.png": lambda path: renamed(path, ".jpg", by_openimageio(PICTURE)),
}
"""Files that both libraries decode alike, by name."""
CONVERTED = {
    "lossy.webp": by_openimageio(PICTURE, Compression="webp:90"),
    "lossless.webp": by_openimageio(PICTURE, Compression="lossless"),
    "alpha.webp": by_openimageio(ALPHA, Compression="lossless"),
    "webp_inside.jpg": lambda path: renamed(path, ".webp", by_openimageio(PICTURE)),
    "light.tif": by_openimageio((PICTURE / 255).astype(np.float32)),
    "webp_strip.tif": tiff_of(50001, lambda path: lossless_webp(PICTURE, path.parent)),
}
"""Files that COLMAP's wheel does not decode, or decodes to other values."""


@pytest.fixture(scope="module")
def every_format(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("formats")
    for name, write in (ALIKE | CONVERTED).items():
        write(folder / name)
    return folder


def folder_for_colmap(folder: Path, work: Path, first: dict[str, int] | None = None) -> tuple[Path, list[str]]:
    """The folder that COLMAP gets, and all names."""
    sizes, _ = readable_sizes(folder, find_photos(folder)[1])
    doubtful = sfm_copies.candidates(folder, dict.fromkeys(sizes, 1) | (first or {}))
    return sfm_copies.folder_for_colmap(folder, list(sizes), doubtful, work), list(sizes)


def test_every_promised_format_comes_to_colmap_as_gsx_sees_it(every_format: Path, tmp_path: Path) -> None:
    folder, names = folder_for_colmap(every_format, tmp_path)
    assert sorted(names) == sorted([*ALIKE, *CONVERTED])
    assert {Path(name).suffix.lower() for name in names} == {*PHOTO_SUFFIXES}
    assert sorted(name for name in names if not (folder / name).is_symlink()) == sorted(CONVERTED)
    for name in names:
        bitmap = pycolmap.Bitmap.read(folder / name, True)
        assert bitmap is not None, name
        here, there = read_image(every_format / name)[:3].permute(1, 2, 0).numpy(), bitmap.to_array()
        assert np.abs(here.astype(int) - there).mean() <= (0.5 if name in ALIKE else 0), name
        assert there.std() > 40, name  # a picture, not a black one
    assert sorted(file.name for file in folder.iterdir()) == sorted(names)


def test_photos_that_both_read_are_used_in_place(every_format: Path, tmp_path: Path) -> None:
    for name in ("rgb.png", "plain.tif"):  # nothing is decoded twice, nothing written
        (tmp_path / name).write_bytes((every_format / name).read_bytes())
    assert folder_for_colmap(tmp_path, tmp_path / "work")[0] == tmp_path
    assert not (tmp_path / "work").exists()


def test_copies_keep_what_the_lens_is_known_by(tmp_path: Path) -> None:
    """COLMAP begins at the focal length that a WebP photo states as at that of a JPEG photo."""
    write_webp_with_exif(tmp_path / "a.webp", PICTURE, LENS | {"Orientation": 6})
    by_openimageio(PICTURE, Orientation=6)(tmp_path / "b.jpg")
    folder, _ = folder_for_colmap(tmp_path, tmp_path / "work")
    assert lens_of(tmp_path / "a.webp") == lens_of(folder / "a.webp") == lens_of(tmp_path / "b.jpg")
    assert lens_of(tmp_path / "a.webp")[3] == 28.0
    cameras = [pycolmap.infer_camera_from_image(folder / name) for name in ("a.webp", "b.jpg")]
    assert all(camera.has_prior_focal_length for camera in cameras)
    assert cameras[0].params.tolist() == cameras[1].params.tolist()


def test_mirrored_photos_come_to_colmap_without_the_mirror(tmp_path: Path) -> None:
    by_openimageio(PICTURE, Orientation=5)(tmp_path / "a.png")
    by_openimageio(PICTURE, Orientation=6)(tmp_path / "b.png")
    folder, _ = folder_for_colmap(tmp_path, tmp_path / "work", {"a.png": 2})
    assert (folder / "b.png").is_symlink()
    copied = torch.from_numpy(pycolmap.Bitmap.read(folder / "a.png", True).to_array()).permute(2, 0, 1)
    assert torch.equal(copied, torch.from_numpy(PICTURE).permute(2, 0, 1).flip(-1))
    assert torch.equal(copied, oriented(read_image(tmp_path / "a.png"), 2))
    assert pycolmap.Bitmap.read(folder / "a.png", True).exif_orientation() in (None, 1)


def test_copies_take_no_other_photos_place(tmp_path: Path) -> None:
    for name in ("a.webp", "a.webp.png", "a.png"):
        by_openimageio(PICTURE)(tmp_path / name)
    folder, names = folder_for_colmap(tmp_path, tmp_path / "work")
    assert sorted(file.name for file in folder.iterdir()) == sorted(names) == ["a.png", "a.webp", "a.webp.png"]
    assert [name for name in names if not (folder / name).is_symlink()] == ["a.webp"]


# what is not read


def zstandard_tiff(path: Path) -> None:
    tiff_of(50000, lambda _: b"\x28\xb5\x2f\xfd" + bytes(40))(path)


def cmyk_tiff(path: Path) -> None:
    by_openimageio(ALPHA, Compression="none")(path)
    content = path.read_bytes()
    tag = struct.pack("<HHI", 262, 3, 1) + b"\2\0"  # PhotometricInterpretation: RGB, then separated
    assert tag in content
    path.write_bytes(content.replace(tag, tag[:-2] + b"\5\0"))


def cut(suffix: str, **attributes: int | str) -> Callable[[Path], None]:
    """Return what writes two thirds of a photo of noise."""

    def write(path: Path) -> None:
        noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        whole = path.with_name(f"whole{suffix}")
        by_openimageio(noise, **attributes)(whole)
        path.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
        whole.unlink()

    return write


@pytest.mark.parametrize(
    ("name", "write", "said"),
    [
        ("a.tif", zstandard_tiff, r"a\.tif' cannot be decoded here \(.*ZSTD.*save it as PNG or JPEG"),
        ("a.tif", cmyk_tiff, r"is CMYK.*convert it to sRGB"),
        ("a.jpg", lambda path: path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(64)), "is HEIC under another name"),
        ("a.png", lambda path: path.write_bytes(b"\0\0\0\x18ftypavif" + bytes(64)), "is AVIF under another name"),
        ("a.png", cut(".png"), "is damaged"),
        ("a.webp", cut(".webp"), "cannot be read|is damaged"),
        ("a.tif", cut(".tif", Compression="lzw"), "cannot be read|is damaged"),
        ("a.tif", cut(".tif", Compression="none"), "cannot be read|is damaged"),
        ("a.bmp", cut(".bmp"), "cannot be read|is damaged"),
        ("a.tif", by_openimageio(np.zeros((8, 9, 5), np.uint8)), "has channels"),
        ("a.jpg", lambda path: path.write_bytes(b""), "cannot be read"),
        ("a.jpg", lambda path: path.mkdir(), "does not exist"),
        ("a.jpg", lambda path: path.symlink_to("elsewhere.jpg"), "does not exist"),
    ],
)
def test_photos_that_cannot_be_read_are_named_with_reason_and_remedy(
    tmp_path: Path, name: str, write: Callable[[Path], None], said: str
) -> None:
    write(tmp_path / name)
    refused(said, readable_size, tmp_path / name)
    refused(f"Only 0 of the 1 photos.*: export them again .*({said})", readable_sizes, tmp_path, [name])


def test_tiled_photos_are_read(tmp_path: Path) -> None:
    by_openimageio(PICTURE, Compression="lzw")(tmp_path / "rows.tif")
    tiled = oiio.ImageBuf(str(tmp_path / "rows.tif"))
    tiled.set_write_tiles(16, 16)
    assert tiled.write(str(tmp_path / "tiles.tif"))
    assert oiio.ImageBuf(str(tmp_path / "tiles.tif")).spec().tile_width == 16
    assert readable_size(tmp_path / "tiles.tif") == image_size(tmp_path / "tiles.tif") == (WIDTH, HEIGHT)


def test_kinds_that_nothing_reads_are_counted_with_their_remedies(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_image(tmp_path / name, torch.zeros(3, 8, 9))
    for name in ("c.HEIC", "d.avif", "a.dng", "e.CR2", "._f.heic"):  # the raw file a is the photo a
        (tmp_path / name).touch()
    _, notes = readable_sizes(tmp_path, ["a.png", "b.png"])
    assert [note.split(",")[0] for note in notes] == [
        "Passed over 1 AVIF photos", "Passed over 1 HEIC photos", "Passed over 1 raw photos",
    ]  # fmt: skip
    for name in ("a.png", "b.png"):
        (tmp_path / name).unlink()
    refused(r"0 photos in other formats, and 1 AVIF photos, .* 2 raw photos, .*export", find_photos, tmp_path)
