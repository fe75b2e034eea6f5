"""`.splat` and `.ksplat`, as viewers of the web have them: bytes worked out by hand, and a small writer of sections."""

import logging
import math
import struct
from pathlib import Path

import pytest
import torch
from foreign_splats import LEVELS, header, row, section, splat, whole

from gsx.core.errors import InputError
from gsx.formats.splat_files import compensated, read_gaussians

C0 = 0.28209479177387814
THE_SPLAT = "0000803f 000000c0 0000003f 0ad7233c 0ad7a33c cdcc4c3d c77f37b2 e680cc80"
"""Mean (1, -2, 0.5), scale (0.01, 0.02, 0.05), colour (199, 127, 55), opacity 178, quaternion bytes (w, x, y, z)."""


def test_splat_by_hand(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(bytes.fromhex(THE_SPLAT))
    read = read_gaussians(tmp_path / "a.splat")
    assert read.means.tolist() == [[1, -2, 0.5]]
    torch.testing.assert_close(read.log_scales.exp(), torch.tensor([[0.01, 0.02, 0.05]]))
    assert float(read.opacity_logits.sigmoid()) == pytest.approx(178 / 255)
    assert (255 * (0.5 + C0 * read.sh_dc[0])).tolist() == pytest.approx([199, 127, 55])
    length = math.hypot(102, 76)  # bytes 230 and 204, less 128
    assert read.quats[0].tolist() == pytest.approx([102 / length, 0, 76 / length, 0])
    assert read.sh_rest.shape == (1, 0, 3)
    assert not compensated(tmp_path / "a.splat")


def test_rows_of_splat_that_cannot_be_drawn_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = [splat(1), splat(math.nan), splat(3, scale=math.inf), splat(4, scale=-0.1), splat(5, scale=0)]
    (tmp_path / "a.splat").write_bytes(b"".join(rows))
    with caplog.at_level(logging.WARNING):
        read = read_gaussians(tmp_path / "a.splat")
    assert "3 of 5 splats" in caplog.text
    assert read.means[:, 0].tolist() == [1, 5]
    assert bool(torch.isfinite(read.log_scales).all())
    assert float(read.log_scales[1, 0].exp()) < 1e-20  # flat: its width is 0


def test_a_quaternion_of_length_0_is_the_identity(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(splat(quat=(128, 128, 128, 128)))
    assert read_gaussians(tmp_path / "a.splat").quats.tolist() == [[1, 0, 0, 0]]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "it is empty"),
        (splat() + b"\0", "33 bytes, no multiple of the 32"),
        (splat()[:-1], "31 bytes, no multiple of the 32"),
    ],
)
def test_what_is_no_splat_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "a.splat").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_gaussians(tmp_path / "a.splat")


# -- .ksplat -------------------------------------------------------------------------------------------------------


def check_shape(read) -> None:  # type: ignore[no-untyped-def]
    """Of `row`."""
    torch.testing.assert_close(read.log_scales[0].exp(), torch.tensor([0.25, 0.5, 1]))
    torch.testing.assert_close(read.quats[0], torch.tensor([0.6, 0, -0.8, 0]), atol=2e-4, rtol=0)
    assert (0.5 + C0 * read.sh_dc[0]).tolist() == pytest.approx([1, 0, 0.2], abs=1e-6)
    assert float(read.opacity_logits[0].sigmoid()) == pytest.approx(0.8)


@pytest.mark.parametrize("level", LEVELS)
def test_sections_and_buckets_of_ksplat_by_hand(tmp_path: Path, level: int) -> None:
    """Two full buckets of two splats, a partly filled one of one; and a section of a single bucket."""
    if level == 0:
        means, heads = [(10 + i, 0, 0) for i in range(6)], [section(5), section(1)]
        bodies = [b"".join(row(0, mean) for mean in means[:5]), row(0, means[5])]
    else:  # a step is block / 2 / 32767: of 5 and of 10
        heads = [section(5, size=2, full=2, partial=1, block=5), section(1, size=2, partial=1, block=10)]
        centres = struct.pack("<9f", 10, 20, 30, 11, 21, 31, 12, 22, 32), struct.pack("<3f", -1, -2, -3)
        steps = [(32767, 32767, 32767), (65534, 0, 32767)] * 3
        rows = [row(level, step) for step in steps]
        bodies = [struct.pack("<I", 1) + centres[0] + b"".join(rows[:5]), struct.pack("<I", 1) + centres[1] + rows[5]]
        means = [(10, 20, 30), (12.5, 17.5, 30), (11, 21, 31), (13.5, 18.5, 31), (12, 22, 32), (4, -7, -3)]
    (tmp_path / "a.ksplat").write_bytes(b"".join([header(2, 6, level), *heads, *bodies]))
    read = read_gaussians(tmp_path / "a.ksplat")
    torch.testing.assert_close(read.means, torch.tensor(means, dtype=torch.float32))
    check_shape(read)
    assert read.sh_rest.shape == (6, 0, 3)
    assert not compensated(tmp_path / "a.ksplat")


@pytest.mark.parametrize("level", LEVELS)
def test_bands_of_ksplat_by_hand(tmp_path: Path, level: int) -> None:
    """Each band has all of red, then green, then blue; bytes lie between the header's -2 and 3."""
    stored = [float(i) for i in range(24)]
    values = [-2 + 5 * i / 255 for i in range(24)] if level == 2 else stored
    head, mean = (section(1, 2), (1, 2, 3)) if level == 0 else (section(1, 2, 2, 0, 1, 5), (32767,) * 3)
    bucket = struct.pack("<I3f", 1, 1, 2, 3) if level else b""
    first = header(2, 2, level) + head + section(1, 0, *((2, 0, 1, 5) if level else ()))
    (tmp_path / "a.ksplat").write_bytes(first + bucket + row(level, mean, stored) + bucket + row(level, mean))
    read = read_gaussians(tmp_path / "a.ksplat")
    assert read.means.tolist() == [[1, 2, 3]] * 2
    red, green, blue = [0, 1, 2, 9, 10, 11, 12, 13], [3, 4, 5, 14, 15, 16, 17, 18], [6, 7, 8, 19, 20, 21, 22, 23]
    expected = torch.tensor([[values[i] for i in one] for one in (red, green, blue)]).T
    torch.testing.assert_close(read.sh_rest[0], expected, atol=1e-5, rtol=0)
    assert not read.sh_rest[1].any()  # a section of a lower degree


UNFIT: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "ends within its header"),
    "another version": (header(1, 2, 1, version=(1, 7)), "version 1.7; gsx reads 0.1"),
    "another level": (header(1, 2, 3), "compression level 3"),
    "half loaded": (header(1, 2, 1, most=9), "holds 2 of 9 splats"),
    "no sections": (header(3, 2, 1), "within the headers of its 3 sections"),
    "a degree of 9": (header(1, 1, 0) + section(1, 9), "section 0 has degree 9"),
    "cut short": (bytes(whole()[:-1]), r"ends after 5,1\d\d of 5,1\d\d bytes"),
    "more buckets than splats": (header(1, 2, 1) + section(2, size=2, full=2, block=5), "buckets of section 0"),
    "more splats than buckets": (
        header(1, 2, 1) + section(2, size=2, partial=1) + struct.pack("<I3f", 1, 0, 0, 0) + 2 * row(1, (0, 0, 0)),
        "buckets hold 1 splats, their section 2",
    ),
    "another number of splats": (header(1, 3, 0) + section(1) + row(0, (0, 0, 0)), "says 3 splats, its sections 1"),
    "none": (header(1, 0, 0) + section(0), "holds no splats"),
}  # fmt: skip


@pytest.mark.parametrize("case", UNFIT)
def test_what_is_no_whole_ksplat_is_refused(tmp_path: Path, case: str) -> None:
    content, words = UNFIT[case]
    (tmp_path / "a.ksplat").write_bytes(content)
    with pytest.raises(InputError, match=words) as raised:
        read_gaussians(tmp_path / "a.ksplat")
    assert "\n" not in str(raised.value)


def test_counts_of_ksplat_that_a_writer_left_at_0(tmp_path: Path) -> None:
    """gaussforge states no most number of splats."""
    body = section(1) + row(0, (1, 2, 3))
    for name, start in (("most", header(1, 1, 0, most=0)), ("loaded", header(1, 0, 0, most=1))):
        (tmp_path / f"{name}.ksplat").write_bytes(start + body)
        assert read_gaussians(tmp_path / f"{name}.ksplat").means.tolist() == [[1, 2, 3]]


def test_rows_of_ksplat_that_are_not_finite_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = header(1, 2, 0) + section(2) + row(0, (1, 2, 3)) + row(0, (math.inf, 2, 3))
    (tmp_path / "a.ksplat").write_bytes(content)
    with caplog.at_level(logging.WARNING):
        assert read_gaussians(tmp_path / "a.ksplat").means.tolist() == [[1, 2, 3]]
    assert "1 of 2 splats" in caplog.text


def test_the_first_bytes_of_a_position_are_not_taken_for_another_kind(tmp_path: Path) -> None:
    """1f 8b, with which every gzip file begins, and so SPZ, are one float of 65,536."""
    row = bytes.fromhex("1f8b803f") + splat()[4:]
    (tmp_path / "a.splat").write_bytes(row)
    assert read_gaussians(tmp_path / "a.splat").means[0, 0] == struct.unpack("<f", row[:4])[0]
