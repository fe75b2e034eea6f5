"""SPZ of version 4, its extensions, and files that are none: against bytes worked out by hand from the format."""

import gzip
import struct
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import zstandard
from test_compact_files import many, the_splat

from gsx.backbones.long_axis import covariances
from gsx.core.errors import InputError
from gsx.core.gaussians.sh import harmonics
from gsx.formats import spz
from gsx.formats.splat_files import SpzForm, compensated, read_gaussians, read_splats, write_gaussians
from gsx.formats.turned import spread_directions

ARRAYS = [bytes.fromhex(text) for text in ("00100000200000f8ff", "b3", "a68059", "566170", "00c80ec0")]
"""Of the splat in axes rub: positions 1, 2, -0.5, opacity 0.7, colours, scales, rotation."""


def record(kind: int, payload: bytes) -> bytes:
    """An extension."""
    return struct.pack("<II", kind, len(payload)) + payload


def streamed(records: bytes = b"", arrays: list[bytes] = ARRAYS, count: int = 1, degree: int = 0) -> bytes:
    """A file of version 4 as the format's text has it."""
    streams = [zstandard.ZstdCompressor().compress(part) for part in arrays]
    head = struct.pack("<4sIIBBBBI", b"NGSP", 4, count, degree, 12, 2 * bool(records), len(arrays), 32 + len(records))
    table = b"".join(struct.pack("<QQ", len(a), len(b)) for a, b in zip(streams, arrays, strict=True))
    return head + bytes(12) + records + table + b"".join(streams)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.fixture
def a_file(tmp_path: Path) -> Path:
    return tmp_path / "a.spz"


@pytest.mark.parametrize(("axes", "number"), [("rub", 4), ("rdf", 6)])
def test_version_4_of_a_splat_by_hand(a_file: Path, axes: str, number: int) -> None:
    write_gaussians(a_file, the_splat(), spz=SpzForm(version=4, axes=axes))
    data = a_file.read_bytes()
    assert data[:40].hex() == "4e475350040000000100000000" + "0c02052c000000" + 24 * "0" + "0300bead04000000"
    assert struct.unpack_from("<I", data, 40) == (number,)
    sizes = [struct.unpack_from("<QQ", data, 44 + 16 * i) for i in range(5)]
    assert [size for _, size in sizes] == [9, 1, 3, 3, 4]
    begin, found = 44 + 16 * 5, []
    for size, _ in sizes:
        found.append(zstandard.ZstdDecompressor().decompress(data[begin : begin + size]))
        begin += size
    assert begin == len(data)
    assert found[1] in (b"\xb2", b"\xb3")  # 178.5
    assert found[2:4] == ARRAYS[2:4]
    if axes == "rub":
        assert (found[0], found[4]) == (ARRAYS[0], ARRAYS[4])


def test_version_4_of_another_writer_is_read(a_file: Path) -> None:
    content = read_splats(written(a_file, streamed()))
    assert (content.axes, content.by) == ("rub", "specified")
    one = content.gaussians
    assert one.means.tolist() == [[1.0, -2.0, 0.5]]
    assert one.opacity_logits.sigmoid().item() == pytest.approx(179 / 255, abs=1e-6)
    assert one.log_scales.exp()[0].tolist() == pytest.approx([0.0098, 0.0195, 0.04979], abs=1e-5)
    assert one.sh_dc[0].tolist() == pytest.approx([1.0065, 0.0131, -1.0065], abs=1e-4)
    assert one.quats[0].tolist() == pytest.approx([0.8, 0, 0.6, 0], abs=0.002)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_both_versions_hold_the_same(tmp_path: Path, degree: int) -> None:
    for version in (3, 4):
        write_gaussians(tmp_path / f"{version}.spz", many(50, degree), spz=SpzForm(version=version))
    third, fourth = (vars(read_gaussians(tmp_path / f"{version}.spz")) for version in (3, 4))
    assert all(torch.equal(value, fourth[name]) for name, value in third.items())


def test_band_4_is_left_out(a_file: Path) -> None:
    rest = np.random.default_rng(0).integers(0, 256, 72, dtype=np.uint8)
    read = read_gaussians(written(a_file, streamed(arrays=[*ARRAYS, rest.tobytes()], degree=4)), axes="rdf")
    assert read.sh_rest[0].tolist() == ((rest[:45].reshape(15, 3).astype(float) - 128) / 128).tolist()


def test_the_flag_of_compensated_opacities(a_file: Path) -> None:
    for told in (True, False):
        write_gaussians(a_file, the_splat(), compensated=told, spz=SpzForm(version=4))
        assert compensated(a_file) is told


# -- axes ------------------------------------------------------------------------------------------------------------

MATRICES = {
    "ldb": "-x y -z",
    "rdb": "x y -z",
    "lub": "-x -y -z",
    "rub": "x -y -z",
    "ldf": "-x y z",
    "rdf": "x y z",
    "luf": "-x -y z",
    "ruf": "x -y z",
    "lfu": "-x -z y",
    "rfu": "x -z y",
    "lbd": "-x z -y",
    "rbd": "x z -y",
    # of these Niantic's library (@adobe/spz 0.2.3) turns y and z over, against their letters
    "lfd": "-x -z -y",
    "rfd": "x -z -y",
    "lbu": "-x z y",
    "rbu": "x z y",
}
"""Coordinates of training worlds by those of the file, in the order of the codes of the extension's text."""
CODES = ["ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf", "lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu"]


def matrix_of(axes: str) -> torch.Tensor:
    """The same as rows of a matrix."""
    rows = [[(-1.0 if word[0] == "-" else 1.0) * (word[-1] == letter) for letter in "xyz"] for word in
            MATRICES[axes].split()]  # fmt: skip
    return torch.tensor(rows, dtype=torch.float64)


def shapes(gaussians) -> torch.Tensor:
    values = {"log_scales": gaussians.log_scales.double(), "quats": gaussians.quats.double()}
    return covariances(values)


@pytest.mark.parametrize("axes", CODES)
def test_stated_axes_turn_positions_shapes_and_colours(tmp_path: Path, axes: str) -> None:
    """What a file states becomes a matrix: ellipsoids are turned with it, colours seen from turned directions too."""
    write_gaussians(tmp_path / "raw.spz", many(20), spz=SpzForm(version=4, axes="rdf"))
    raw = bytearray((tmp_path / "raw.spz").read_bytes())
    raw[40] = 1 + CODES.index(axes)
    content = read_splats(written(tmp_path / "a.spz", bytes(raw)))
    assert (content.axes, content.by) == (axes, "stated")
    stored, read, matrix = read_gaussians(tmp_path / "raw.spz"), content.gaussians, matrix_of(axes)
    torch.testing.assert_close(read.means.double(), stored.means.double() @ matrix.T)
    torch.testing.assert_close(shapes(read), matrix @ shapes(stored) @ matrix.T, rtol=1e-5, atol=1e-7)
    directions = spread_directions(30)
    before = harmonics(directions, 3) @ stored.sh_rest.double()
    torch.testing.assert_close(harmonics(directions @ matrix.T, 3) @ read.sh_rest.double(), before, rtol=0, atol=1e-5)


def test_other_extensions_are_passed_over(a_file: Path) -> None:
    records = record(0xADBE0002, bytes(12)) + record(0x12340001, b"abc") + record(0xADBE0003, struct.pack("<I", 6))
    assert read_splats(written(a_file, streamed(records))).axes == "rdf"


def test_axes_number_0_states_none(a_file: Path) -> None:
    content = read_splats(written(a_file, streamed(record(0xADBE0003, struct.pack("<I", 0)))))
    assert (content.axes, content.by) == ("rub", "specified")


def test_axes_of_an_unknown_number_are_refused(a_file: Path) -> None:
    with pytest.raises(InputError, match="states axes number 17, gsx knows 1 to 16"):
        read_gaussians(written(a_file, streamed(record(0xADBE0003, struct.pack("<I", 17)))))


def test_version_3_may_state_axes_after_its_arrays(a_file: Path) -> None:
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 2, 0)
    content = gzip.compress(head + b"".join(ARRAYS) + record(0xADBE0003, struct.pack("<I", 6)))
    found = read_splats(written(a_file, content))
    assert (found.axes, found.by, found.gaussians.means.tolist()) == ("rdf", "stated", [[1.0, 2.0, -0.5]])


def test_given_axes_win_over_stated_ones_with_a_warning(a_file: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_gaussians(a_file, the_splat(), spz=SpzForm(version=4, axes="rdf"))
    assert read_gaussians(a_file, "rub").means.tolist() == [[1.0, 2.0, -0.5]]
    assert "states axes rdf, using rub from the settings" in caplog.text


def test_axes_can_be_given_for_any_format_that_does_not_fix_them(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", the_splat())
    assert read_gaussians(tmp_path / "a.ply", "rub").means.tolist() == [[1.0, 2.0, -0.5]]
    write_gaussians(tmp_path / "a.glb", the_splat())
    with pytest.raises(InputError, match="glTF fixes the axes"):
        read_gaussians(tmp_path / "a.glb", "rub")
    with pytest.raises(InputError, match="axes is 'up': choose auto, rub"):
        read_gaussians(tmp_path / "a.ply", "up")


@pytest.mark.parametrize(
    ("form", "told"), [({"version": 2}, "version of SPZ is 2: choose 3 or 4"), ({"axes": "luf"}, "choose rub or rdf")]
)
def test_what_is_not_written(form: dict[str, object], told: str) -> None:
    with pytest.raises(InputError, match=told):
        SpzForm(**form)  # type: ignore[arg-type]


# -- files that are none ---------------------------------------------------------------------------------------------


def header(version: int, count: int = 1, degree: int = 0, bits: int = 12) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, 0, 5)


WRONG = {
    "version 1": (gzip.compress(header(1) + bytes(17)), "SPZ version 1, which was never published"),
    "version 5": (header(5) + bytes(100), "SPZ version 5, gsx reads 2, 3 and 4: export it as version 4"),
    "version 5, zipped": (gzip.compress(header(5) + bytes(100)), "SPZ version 5, gsx reads 2, 3 and 4"),
    "version 0": (header(0) + bytes(100), "SPZ version 0, gsx reads"),
    "not zipped": (header(3) + b"".join(ARRAYS), "content of SPZ version 3 without its gzip stream: gzip it"),
    "version 4, zipped": (gzip.compress(streamed()), r"SPZ version 4 within a gzip stream: unzip it"),
    "degree 5": (header(4, degree=5) + bytes(16), "degree 5 and 12 fraction bits"),
    "many bits": (header(4, bits=31) + bytes(16), "degree 0 and 31 fraction bits"),
    "four thousand million": (header(4, 2**32 - 1) + bytes(16), "32 bytes cannot hold 4,294,967,295 splats"),
    "the same, zipped": (gzip.compress(header(3, 2**32 - 1)), "cannot hold 4,294,967,295 splats"),
    "no streams": (header(4) + bytes(16), "5 streams from byte 0 on do not fit 1 splats"),
    "two splats of one": (streamed(count=2), "has not the bytes of 2 splats"),
    "a stream more": (streamed(arrays=[*ARRAYS, b"x"]), "6 streams from byte 32 on do not fit"),
    "a byte more": (streamed() + b"x", "streams do not end where the file does"),
    "another file": (b"notes of mine\n", "no whole gzip stream"),
    "another zipped file": (gzip.compress(b"notes" * 10), "no SPZ"),
    "nothing": (b"", "no SPZ"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_named(a_file: Path, name: str) -> None:
    content, told = WRONG[name]
    with pytest.raises(InputError, match=f"a.spz' cannot be read: .*{told}"):
        read_gaussians(written(a_file, content))


def test_a_file_that_ends_anywhere_is_refused(a_file: Path) -> None:
    write_gaussians(a_file, many(3, 1), spz=SpzForm(version=4))
    content = a_file.read_bytes()
    for end in range(0, len(content), 5):
        with pytest.raises(InputError, match=r"cannot be read: .*anew"):
            read_gaussians(written(a_file, content[:end]))


def test_streams_that_hold_more_than_they_say_are_not_unpacked(a_file: Path) -> None:
    """The stream's own header claims 64 MB; as much is not even asked for."""
    content = bytearray(streamed(arrays=[bytes(1 << 26), *ARRAYS[1:]]))
    struct.pack_into("<Q", content, 40, 9)
    with pytest.raises(InputError, match="does not have 9 bytes"):
        read_gaussians(written(a_file, bytes(content)))


def test_a_damaged_stream_is_refused(a_file: Path) -> None:
    content = bytearray(streamed())
    content[32 + 5 * 16] ^= 0xFF
    with pytest.raises(InputError, match="a Zstandard stream is damaged"):
        read_gaussians(written(a_file, bytes(content)))


def test_a_file_of_no_splats_is_read_as_such(a_file: Path) -> None:
    assert len(read_gaussians(written(a_file, streamed(arrays=[], count=0))).means) == 0
    assert len(read_gaussians(written(a_file, gzip.compress(header(3, 0)))).means) == 0


# -- Zstandard -------------------------------------------------------------------------------------------------------


def test_without_zstandard_the_remedy_is_named(a_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(spz, "import_module", missing)
    with pytest.raises(InputError, match=r"pip install 'gsx\[spz\]'"):
        read_gaussians(written(a_file, streamed()))
    with pytest.raises(InputError, match=r"pip install 'gsx\[spz\]'"):
        write_gaussians(a_file.with_name("b.spz"), the_splat(), spz=SpzForm(version=4))
    assert not a_file.with_name("b.spz").exists()
    write_gaussians(a_file, the_splat())  # version 3 needs none


def test_python_s_own_module_is_used_where_there_is_one(a_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(file: BytesIO) -> BytesIO:
        return BytesIO(zstandard.ZstdDecompressor().decompress(file.read()))

    def compress(data: bytes, level: int) -> bytes:
        return zstandard.ZstdCompressor(level=level).compress(data)

    module = SimpleNamespace(ZstdFile=opened, compress=compress, ZstdError=zstandard.ZstdError)
    monkeypatch.setattr(spz, "import_module", {"compression.zstd": module}.__getitem__)
    write_gaussians(a_file, replace(the_splat(), means=torch.tensor([[1.0, -2.0, 3.0]])), spz=SpzForm(version=4))
    assert read_gaussians(a_file).means.tolist() == [[1.0, -2.0, 3.0]]
