"""Images against hand-worked values, a dense float64 filter, and OpenImageIO's own operations."""

import os
import struct
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from torch import Tensor

from gsx.core.data import images
from gsx.core.data.camera import Camera
from gsx.core.data.images import ImageCache, composite, image_size, read_image, write_image
from gsx.core.data.resize import ResizeRule, display_from_linear, linear_from_display, resize, to_uint8, training_size
from gsx.core.errors import ConfigError, InputError
from gsx.scenes.photo_source import PhotoSource

RULE = ResizeRule(filter="bicubic", light="display", background=(1.0, 1.0, 1.0))


def save(path: Path, pixels: np.ndarray, **attributes: Any) -> Path:
    """Writes [H, W, C] with OpenImageIO; `a__b=1` sets attribute a:b."""
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, str(pixels.dtype))
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(pixels)), output.geterror()
    output.close()
    return path


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def photo(shape: tuple[int, int, int] = (3, 40, 60), seed: int = 0) -> Tensor:
    return torch.from_numpy(noise(*shape, seed=seed))


def camera(width: int, height: int, **changes: float) -> Camera:
    values = {"fx": 50.0, "fy": 55.0, "cx": width * 0.45, "cy": height * 0.6} | changes
    return Camera(rotation=torch.eye(3), translation=torch.zeros(3), width=width, height=height, **values)


def cubic(x: np.ndarray) -> np.ndarray:
    """Keys (1981) with a = -0.5."""
    x = np.abs(x)
    return np.where(x < 1, 1.5 * x**3 - 2.5 * x**2 + 1, np.where(x < 2, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2, 0))


def lanczos(x: np.ndarray) -> np.ndarray:
    return np.where(np.abs(x) < 3, np.sinc(x) * np.sinc(x / 3), 0)


def dense(size: int, new_size: int, kernel: Any) -> np.ndarray:
    """The whole filter matrix [new, old], rows adding up to 1; the kernel widens with the reduction."""
    ratio = size / new_size
    old, new = np.arange(size) + 0.5, (np.arange(new_size) + 0.5) * ratio
    weights = kernel((old[None] - new[:, None]) / max(ratio, 1))
    return weights / weights.sum(1, keepdims=True)


def reference(image: Tensor, width: int, height: int, kernel: Any) -> np.ndarray:
    """Both passes in float64; between them the cubic keeps 8 bits, as Pillow does."""
    rows = np.einsum("chw,xw->chx", image.numpy().astype(np.float64), dense(image.shape[2], width, kernel))
    rows = np.floor(rows + 0.5).clip(0, 255) if kernel is cubic else rows
    return np.clip(np.einsum("yh,chx->cyx", dense(image.shape[1], height, kernel), rows), 0, 255)


# --- reading ---


def test_png_rgb_and_rgba_are_exact(tmp_path: Path) -> None:
    pixels = noise(5, 7, 4)
    image = read_image(save(tmp_path / "a.png", pixels, oiio__UnassociatedAlpha=1))
    assert torch.equal(image, torch.from_numpy(pixels).permute(2, 0, 1))
    image = read_image(save(tmp_path / "b.png", pixels[..., :3]))
    assert torch.equal(image, torch.from_numpy(pixels[..., :3].copy()).permute(2, 0, 1))
    assert image.is_contiguous()
    assert image_size(tmp_path / "b.png") == (7, 5)


def test_grey_becomes_rgb_and_keeps_its_alpha(tmp_path: Path) -> None:
    pixels = noise(5, 7, 2)
    grey, alpha = torch.from_numpy(pixels[..., 0].copy()), torch.from_numpy(pixels[..., 1].copy())
    image = read_image(save(tmp_path / "g.png", pixels[..., :1]))
    assert torch.equal(image, grey.expand(3, 5, 7))
    image = read_image(save(tmp_path / "ga.png", pixels, oiio__UnassociatedAlpha=1))
    assert torch.equal(image, torch.stack([grey, grey, grey, alpha]))


def test_sixteen_bits_are_rounded_not_truncated(tmp_path: Path) -> None:
    # 257 v is exactly v; 128 above is 0.498 levels, 129 above is 0.502
    pixels = np.array([257 * 7, 257 * 7 + 128, 257 * 7 + 129, 65535, 0], np.uint16).reshape(1, 5, 1)
    image = read_image(save(tmp_path / "a.png", pixels))
    assert image[0, 0].tolist() == [7, 7, 8, 255, 0]


def test_exr_is_light_and_gets_the_srgb_curve(tmp_path: Path) -> None:
    light = np.array([0, 0.0031308, 0.21404114, 0.5, 1, 7, -1], np.float32).reshape(1, 7, 1).repeat(3, axis=2)
    image = read_image(save(tmp_path / "a.exr", light))
    # 12.92 x 0.0031308 x 255 = 10.31; 0.21404 is display 0.5 = 127.5; 0.5 is display 0.73536 = 187.52
    assert image[1, 0].tolist() == [0, 10, 127, 188, 255, 255, 0] or image[1, 0, 2] == 128
    assert image[1, 0].tolist()[3:] == [188, 255, 255, 0]


def test_premultiplied_alpha_is_divided_out(tmp_path: Path) -> None:
    pixels = np.zeros((1, 2, 4), np.float32)
    pixels[0, 0] = (0.25, 0.125, 0.0, 0.25)
    image = read_image(save(tmp_path / "a.exr", pixels))
    assert image[:, 0, 0].tolist() == [255, 188, 0, 64]  # light 1, 0.5, 0; alpha 63.75
    assert image[:, 0, 1].tolist() == [0, 0, 0, 0]


def test_alpha_of_a_bmp_is_straight(tmp_path: Path) -> None:
    """Which OpenImageIO does not say."""
    pixels = np.array([[[200, 100, 50, 128], [9, 8, 7, 255]]], np.uint8)
    header = b"BM" + struct.pack("<IHHI", 14 + 108 + 8, 0, 0, 14 + 108)
    masks = struct.pack("<IIII", 0x00FF0000, 0x0000FF00, 0x000000FF, 0xFF000000)
    info = struct.pack("<IiiHHIIiiII", 108, 2, -1, 1, 32, 3, 8, 0, 0, 0, 0) + masks + b"BGRs" + bytes(48)
    (tmp_path / "a.bmp").write_bytes(header + info + pixels[..., [2, 1, 0, 3]].tobytes())
    assert read_image(tmp_path / "a.bmp").permute(1, 2, 0).tolist() == pixels.tolist()


def test_nan_is_refused(tmp_path: Path) -> None:
    pixels = np.full((2, 2, 3), np.nan, np.float32)
    with pytest.raises(InputError, match="not numbers"):
        read_image(save(tmp_path / "a.exr", pixels))


def test_stored_raster_is_what_pycolmap_reads(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    path = save(tmp_path / "a.jpg", noise(16, 32, 3), Orientation=6)
    assert np.array_equal(read_image(path).permute(1, 2, 0).numpy(), pycolmap.Bitmap.read(path, True).to_array())


def cmyk_jpeg() -> bytes:
    """One 8 x 8 block of each of four components, all coefficients zero: two bits per component."""

    def segment(marker: int, body: bytes) -> bytes:
        return bytes([0xFF, marker]) + (len(body) + 2).to_bytes(2, "big") + body

    one_code = bytes([1] + [0] * 15 + [0])  # the only code, `0`, means symbol 0
    components = b"".join(bytes([i, 0x11, 0]) for i in range(1, 5))
    scan = bytes([4]) + b"".join(bytes([i, 0]) for i in range(1, 5)) + bytes([0, 63, 0])
    adobe = b"Adobe" + bytes([0, 100, 0, 0, 0, 0, 0])
    return (
        b"\xff\xd8"
        + segment(0xEE, adobe)
        + segment(0xDB, bytes([0]) + bytes([1] * 64))
        + segment(0xC0, bytes([8, 0, 8, 0, 8, 4]) + components)
        + segment(0xC4, bytes([0x00]) + one_code + bytes([0x10]) + one_code)
        + segment(0xDA, scan)
        + b"\x00\xff\xd9"
    )


def test_cmyk_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(cmyk_jpeg())
    with pytest.raises(InputError, match="CMYK"):
        read_image(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="CMYK"):
        read_image(save(tmp_path / "a.tif", noise(4, 4, 4), tiff__ColorSpace="CMYK"))


def test_damaged_missing_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_image(tmp_path / "none.png")
    (tmp_path / "text.jpg").write_text("hello")
    with pytest.raises(InputError, match="cannot be read"):
        image_size(tmp_path / "text.jpg")
    whole = save(tmp_path / "a.jpg", noise(64, 64, 3)).read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.jpg' is damaged"):
        read_image(tmp_path / "cut.jpg")
    with pytest.raises(InputError, match="channels R, G, B, A, channel4"):
        read_image(save(tmp_path / "a.exr", np.zeros((2, 2, 5), np.float32)))


def test_a_cropped_exr_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.exr", np.zeros((2, 2, 3), np.float32))
    buffer = oiio.ImageBuf(str(path))
    buffer.set_full(0, 8, 0, 8, 0, 1)
    buffer.write(str(path))
    with pytest.raises(InputError, match="2 x 2 window of its 8 x 8"):
        read_image(path)


# --- writing ---


def test_written_png_reads_back_exactly(tmp_path: Path) -> None:
    rgb, rgba = photo(), photo((4, 5, 6))
    write_image(tmp_path / "a.png", rgb)
    write_image(tmp_path / "b.png", rgba)
    assert torch.equal(read_image(tmp_path / "a.png"), rgb)
    assert torch.equal(read_image(tmp_path / "b.png"), rgba)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_written_jpeg_is_of_high_quality(tmp_path: Path) -> None:
    y, x = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 64), indexing="ij")
    smooth = torch.stack([x, y, (x + y) / 2])
    write_image(tmp_path / "a.jpeg", smooth)
    assert (read_image(tmp_path / "a.jpeg").float() / 255 - smooth).abs().max() < 0.02
    write_image(tmp_path / "n.jpeg", photo((3, 64, 64)))
    default = save(tmp_path / "low.jpg", noise(3, 64, 64).transpose(1, 2, 0), Compression="jpeg:50")
    assert (tmp_path / "n.jpeg").stat().st_size > 1.5 * default.stat().st_size


def test_floats_are_rounded() -> None:
    values = torch.tensor([0, 0.499 / 255, 0.501 / 255, 254.6 / 255, 1.0, 1.5, -1])
    assert to_uint8(values).tolist() == [0, 0, 1, 255, 255, 255, 0]


def test_unwritable_images_leave_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.png or \.jpg"):
        write_image(tmp_path / "a.bmp", photo())
    with pytest.raises(InputError, match="4 channels"):
        write_image(tmp_path / "a.jpg", photo((4, 5, 6)))
    with pytest.raises(InputError, match="cannot be written"):
        write_image(tmp_path / "no_folder" / "a.png", photo())
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        write_image(tmp_path / "folder.png", photo())
    assert [path.name for path in tmp_path.iterdir()] == ["folder.png"]


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="only Linux has files in memory, and a disk that is full")
@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_a_disk_that_takes_nothing_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(images, "replacing", lambda path: nullcontext(Path("/dev/full")))
    with pytest.raises(InputError, match=f"{name}' cannot be written .No space left on device., free some space"):
        write_image(tmp_path / name, photo((3, 200, 200)))


# --- resizing ---


def test_bicubic_halving_of_one_bright_pixel_by_hand() -> None:
    image = torch.zeros(1, 1, 10, dtype=torch.uint8)
    image[..., 4] = 255
    # new pixels at 1, 3, 5, 7, 9 are 3.5, 1.5, 0.5, 2.5, 4.5 from it: weights cubic(d / 2) / 2 are
    # -3/256, 29/256, 111/256, -9/256, 0
    assert resize(image, 5, 1)[0, 0].tolist() == [0, 29, 111, 0, 0]


def test_area_by_hand() -> None:
    image = torch.tensor([[[30, 90, 240]]], dtype=torch.uint8)
    assert resize(image, 2, 1, "area")[0, 0].tolist() == [50, 190]  # (30 + 45) / 1.5, (45 + 240) / 1.5
    assert resize(image, 6, 2, "area")[0].tolist() == [[30, 30, 90, 90, 240, 240]] * 2
    block = torch.tensor([[[10, 20, 1], [30, 40, 2]]], dtype=torch.uint8)
    assert resize(block, 3, 1, "area")[0, 0].tolist() == [20, 30, 2]  # 1.5 is rounded up


@pytest.mark.parametrize(("filter", "kernel"), [("bicubic", cubic), ("lanczos", lanczos)])
@pytest.mark.parametrize(("width", "height"), [(30, 20), (23, 17), (61, 39), (97, 53), (1, 39), (60, 1), (1, 1)])
def test_filters_against_dense_float64(filter: str, kernel: Any, width: int, height: int) -> None:
    image = photo()
    error = resize(image, width, height, filter).numpy() - reference(image, width, height, kernel)
    assert np.abs(error).max() <= 1.2  # a tie between the passes may fall the other way in float32
    assert np.mean(np.abs(error) > 0.501) < 0.001


def test_linear_light_averages_light() -> None:
    image = torch.tensor([0, 255] * 8, dtype=torch.uint8).expand(3, 2, 16)
    assert resize(image, 8, 1, "area", "linear").unique().tolist() == [188]  # light 0.5 is display 187.5
    assert resize(image, 8, 1, "area", "display").unique().tolist() == [128]


def test_bicubic_against_torch() -> None:
    smooth = torch.nn.functional.avg_pool2d(photo().float(), 5, 1).to(torch.uint8)
    by_torch = torch.nn.functional.interpolate(smooth[None], size=(13, 25), mode="bicubic", antialias=True)[0]
    assert (resize(smooth, 25, 13).int() - by_torch.int()).abs().max() <= 1


def test_linear_bicubic_against_dense_float64() -> None:
    image = photo()
    values = image.numpy() / 255
    light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    filtered = np.einsum("yh,chw,xw->cyx", dense(40, 13, cubic), light, dense(60, 25, cubic)).clip(0, 1)
    display = np.where(filtered <= 0.0031308, 12.92 * filtered, 1.055 * filtered ** (1 / 2.4) - 0.055) * 255
    assert np.abs(resize(image, 25, 13, "bicubic", "linear").numpy() - display).max() < 0.51


def test_srgb_curve_inverts() -> None:
    display = torch.linspace(0, 1, 4097, dtype=torch.float64)
    torch.testing.assert_close(display_from_linear(linear_from_display(display)), display, atol=1e-6, rtol=0)
    assert float(linear_from_display(torch.tensor(0.5))) == pytest.approx(0.2140411, abs=1e-6)


@pytest.mark.parametrize("filter", ["bicubic", "area", "lanczos"])
@pytest.mark.parametrize("light", ["display", "linear"])
def test_constants_and_mirrors_are_kept(filter: str, light: str) -> None:
    flat = torch.full((3, 11, 13), 77, dtype=torch.uint8)
    assert resize(flat, 5, 29, filter, light).unique().tolist() == [77]
    image = photo()
    mirrored = resize(image.flip(-1), 23, 17, filter, light).flip(-1)
    assert (mirrored.int() - resize(image, 23, 17, filter, light).int()).abs().max() <= 1


def test_unknown_filter_gets_a_suggestion() -> None:
    with pytest.raises(ConfigError, match=r"'bicubik'.*Did you mean 'bicubic'\?"):
        ResizeRule(filter="bicubik", light="display", background=(0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match=r"scene\.resize_light is 'gamma'"):
        ResizeRule(filter="area", light="gamma", background=(0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match=r"scene\.background is"):
        ResizeRule(filter="area", light="linear", background=(0.0, 0.0, 255.0))


@pytest.mark.parametrize(
    ("size", "downscale", "max_width", "expected"),
    [
        ((1061, 1894), 4, 1600, (265, 474)),  # 265.25, 473.5: ties go to the even number
        ((4946, 3286), 4, 1600, (1236, 822)),  # 1236.5, 821.5
        ((1063, 799), 4, 1600, (266, 200)),  # 265.75, 199.75
        ((4946, 3286), 1, 1600, (1600, 1063)),  # 1063.01
        ((4000, 2999), 1, 1600, (1600, 1199)),  # 1199.6 truncated
        ((1600, 3000), 1, 1600, (1600, 3000)),
        ((5000, 3333), 2, 1600, (2500, 1666)),  # an explicit factor is not limited; 1666.5
        ((5000, 3333), 1, 0, (5000, 3333)),
        ((3, 2), 8, 1600, (1, 1)),
    ],
)
def test_training_size(size: tuple[int, int], downscale: int, max_width: int, expected: tuple[int, int]) -> None:
    assert training_size(*size, downscale, max_width) == expected


# --- compositing ---


def test_compositing_truncates() -> None:
    image = torch.tensor([[10, 200], [0, 200], [255, 200], [100, 0]], dtype=torch.uint8)[:, None]
    # alpha 100/255: 10 a + 255 (1 - a) = 158.92; 155; 255. A rounding would give 159
    assert composite(image, (1.0, 1.0, 1.0))[:, 0, 0].tolist() == [158, 155, 255]
    assert composite(image, (1.0, 0.5, 0.0))[:, 0, 1].tolist() == [255, 127, 0]


def test_opaque_pixels_survive_compositing() -> None:
    image = torch.arange(256, dtype=torch.uint8).expand(4, 1, 256).clone()
    image[3] = 255
    assert torch.equal(composite(image, (0.3, 0.6, 1.0)), image[:3])


# --- photographs as truth ---


def source(path: Path, whole: Camera, **changes: Any) -> PhotoSource:
    values = {"rule": RULE, "cache": ImageCache(10**6)} | changes
    return PhotoSource(path=path, whole=whole, **values)


def test_photo_at_its_own_and_at_half_size(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", photo())
    whole = camera(60, 40)
    truth = source(tmp_path / "a.png", whole)
    assert torch.equal(truth.image(whole), photo())
    assert torch.equal(truth.image(whole.zoom(0.5)), resize(photo(), 30, 20))
    assert torch.equal(truth.image(whole.resize(30, 10)), resize(photo(), 30, 10))


@pytest.mark.parametrize("principal", [(30.0, 20.0), None])
def test_crop_is_the_window_of_the_whole(tmp_path: Path, principal: tuple[float, float] | None) -> None:
    write_image(tmp_path / "a.png", photo())
    whole = camera(60, 40)
    whole = replace(whole, cx=principal[0], cy=principal[1]) if principal else whole
    truth = source(tmp_path / "a.png", whole)
    assert torch.equal(truth.image(whole.crop(7, 11, 20, 13)), photo()[:, 11:24, 7:27])
    half = whole.zoom(0.5)
    assert torch.equal(truth.image(half.crop(3, 4, 5, 6)), resize(photo(), 30, 20)[:, 4:10, 3:8])
    with pytest.raises(ValueError, match="reaches past"):
        truth.image(whole.crop(50, 0, 20, 13))
    with pytest.raises(ValueError, match="reaches past"):
        truth.image(whole.crop(0, -1, 20, 13))


def test_max_zoom_is_that_of_the_original(tmp_path: Path) -> None:
    whole = camera(1062, 1894)
    truth = source(tmp_path / "absent.png", whole)
    training = whole.resize(*training_size(1062, 1894, 4, 1600))  # 266 wide: a little more than a quarter
    assert 4.0 <= truth.max_zoom(training) < 4.1
    assert truth.max_zoom(training.crop(10, 10, 20, 20)) == truth.max_zoom(training)
    assert 1.0 <= truth.max_zoom(whole) < 1.02


def test_rgba_photo_is_composited_before_it_is_reduced(tmp_path: Path) -> None:
    rgba = photo((4, 40, 60))
    write_image(tmp_path / "a.png", rgba)
    whole = camera(60, 40)
    image = source(tmp_path / "a.png", whole).image(whole.zoom(0.5))
    assert torch.equal(image, resize(composite(rgba, (1.0, 1.0, 1.0)), 30, 20))


def test_remap_is_applied_to_the_original(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", photo())
    whole = camera(50, 40)
    truth = source(tmp_path / "a.png", whole, remap=lambda image: image[:, :, 10:], expected_size=(60, 40))
    assert torch.equal(truth.image(whole), photo()[:, :, 10:])


@pytest.mark.parametrize("expected", [(60, 40), (240, 160), (239, 161), (61, 40), (241, 158)])
def test_uniform_reductions_of_the_model_are_accepted(tmp_path: Path, expected: tuple[int, int]) -> None:
    write_image(tmp_path / "a.png", photo())
    whole = camera(60, 40)
    assert source(tmp_path / "a.png", whole, expected_size=expected).image(whole).shape == (3, 40, 60)


@pytest.mark.parametrize("expected", [(40, 60), (30, 20), (60, 60), (120, 40), (240, 180)])
def test_other_sizes_are_refused_by_name(tmp_path: Path, expected: tuple[int, int]) -> None:
    write_image(tmp_path / "a.png", photo())
    message = rf"a\.png' is 60 x 40 and the camera model says {expected[0]} x {expected[1]}"
    with pytest.raises(InputError, match=message):
        source(tmp_path / "a.png", camera(60, 40), expected_size=expected).image(camera(60, 40))


# --- cache ---


def test_cache_makes_once_and_drops_the_least_recently_used() -> None:
    made: list[str] = []

    def make(name: str) -> Tensor:
        made.append(name)
        return torch.zeros(3, 10, 10, dtype=torch.uint8)

    cache = ImageCache(700)  # two images of 300 bytes
    for name in ["a", "b", "a", "c", "a", "b"]:
        cache.get(name, lambda name=name: make(name))
    assert made == ["a", "b", "c", "b"]


def test_an_image_beyond_the_budget_is_made_anew_and_evicts_nothing() -> None:
    made: list[str] = []

    def make(name: str, pixels: int) -> Tensor:
        made.append(name)
        return torch.zeros(1, 1, pixels, dtype=torch.uint8)

    cache = ImageCache(100)
    for name, pixels in [("small", 50), ("huge", 101), ("huge", 101), ("small", 50)]:
        cache.get(name, lambda name=name, pixels=pixels: make(name, pixels))
    assert made == ["small", "huge", "huge"]


def test_source_decodes_once_per_size(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", photo())
    whole = camera(60, 40)
    truth = source(tmp_path / "a.png", whole)
    first = truth.image(whole)
    (tmp_path / "a.png").unlink()
    assert torch.equal(truth.image(whole.crop(1, 2, 3, 4)), first[:, 2:6, 1:4])
    with pytest.raises(InputError, match="does not exist"):
        truth.image(whole.zoom(0.5))


@pytest.mark.parametrize(
    "other",
    [
        {"rule": ResizeRule(filter="area", light="display", background=(1.0, 1.0, 1.0))},
        {"rule": ResizeRule(filter="bicubic", light="display", background=(0.0, 0.0, 0.0))},
        {"remap": lambda image: 255 - image},
    ],
)
def test_pictures_made_otherwise_are_kept_apart(tmp_path: Path, other: dict[str, Any]) -> None:
    """Two sources of one file and one cache: each gives what it gives alone."""
    write_image(tmp_path / "a.png", photo((4, 40, 60)))
    whole, cache = camera(60, 40), ImageCache(10**6)
    half = whole.zoom(0.5)
    alone = [source(tmp_path / "a.png", whole, **changes).image(half) for changes in ({}, other)]
    shared = [source(tmp_path / "a.png", whole, cache=cache, **changes).image(half) for changes in ({}, other)]
    assert not torch.equal(*alone)
    assert all(torch.equal(a, b) for a, b in zip(alone, shared, strict=True))
