"""Public datasets from a server on this machine: cut connections, wrong checksums, full disks, hostile archives."""

import errno
import hashlib
import io
import re
import stat
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import ConfigError, InputError
from gsx.experiments.download import receive
from gsx.experiments.download.get import fetch, get
from gsx.experiments.download.unpack import unpack_scene
from gsx.experiments.runs.compose import Compositions, listed
from gsx.experiments.runs.settings import Archive, Dataset
from gsx.experiments.runs.typed import typed

FILES = {
    "set/berlin/sparse/0/cameras.bin": b"cameras",
    "set/berlin/images/a.jpg": np.random.default_rng(0).bytes(700_000),
    "set/london/sparse/0/cameras.bin": b"others",
    "set/london/images/a.jpg": b"photo",
    "__MACOSX/berlin/x": b"",
}


def zipped(files: dict[str, bytes]) -> bytes:
    """A ZIP archive of these files."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


@dataclass
class Server:
    """What a server has and does."""

    content: bytes = zipped(FILES)
    tag: str = '"one"'
    ranges: bool = True
    cuts: list[int] = field(default_factory=list)
    """Bytes sent before each of the next connections is cut."""
    status: list[int] = field(default_factory=list)
    """Errors that it answers first."""
    requests: list[str] = field(default_factory=list)
    """Ranges of the requests; empty: the whole file."""
    sent: int = 0
    url: str = ""

    def start_of(self, request: BaseHTTPRequestHandler) -> int:
        """First byte of the answer."""
        wanted = re.fullmatch(r"bytes=(\d+)-", request.headers["Range"] or "")
        fresh = request.headers["If-Range"] in (None, self.tag)
        return int(wanted[1]) if wanted and self.ranges and fresh else 0

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        """Send the file, or its rest, or a part of that."""
        self.requests.append(request.headers["Range"] or "")
        if self.status:
            request.send_error(self.status.pop(0))
            return
        start, size = self.start_of(request), len(self.content)
        request.send_response(206 if start else 200)
        request.send_header("Content-Length", str(size - start))
        request.send_header("ETag", self.tag)
        if start:
            request.send_header("Content-Range", f"bytes {start}-{size - 1}/{size}")
        request.end_headers()
        body = self.content[start:][: self.cuts.pop(0) if self.cuts else None]
        request.wfile.write(body)
        self.sent += len(body)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A server of one file on this machine; attempts follow each other at once."""
    monkeypatch.setattr(receive, "PAUSES", (0.0, 0.0, 0.0))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    state = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.answer(self)

        def log_message(self, *_: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        threading.Thread(target=http.serve_forever, args=(0.01,), daemon=True).start()
        state.url = f"http://127.0.0.1:{http.server_port}/set.zip"
        yield state
        http.shutdown()


def archive_of(server: Server, **others: Any) -> Archive:
    """The archive that the server has."""
    return Archive(**{"file": "set.zip", "url": server.url, "scenes": ["berlin", "london"]} | others)


def dataset_of(*archives: Archive) -> Dataset:
    """A dataset of two scenes."""
    return Dataset(
        name="set", title="Set", obtained="https://example.org", folder="set", needs=["sparse/0", "images"],
        scenes={"berlin": "Berlin", "london": "London"}, scene="berlin", archives=list(archives),
    )  # fmt: skip


def content_below(folder: Path) -> dict[str, bytes]:
    """All files below a folder, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


UNPACKED = {name: content for name, content in FILES.items() if name.startswith("set/")}


def test_licence_and_size_come_before_the_first_request(server: Server, tmp_path: Path) -> None:
    lines = get(dataset_of(archive_of(server, megabytes=700)), tmp_path, ["berlin", "london"])
    first = [next(lines) for _ in range(3)]
    assert first[0] == "Set, licence: none found that its authors state; ask them before you publish with it"
    assert first[1] == f"  set.zip: about 700 MB, from {server.url}"
    assert not server.requests
    assert not list(tmp_path.iterdir())
    assert list(lines)[-1] == f"gsx dataset=set dataset.scene=berlin data_root={tmp_path} minutes=10"
    digest = hashlib.sha256(server.content).hexdigest()
    expected = {"archives/set.zip": server.content, "archives/set.zip.sha256": f"{digest}  set.zip\n".encode()}
    assert content_below(tmp_path) == UNPACKED | expected
    assert next(get(dataset_of(archive_of(server)), tmp_path, ["berlin"])) == f"Set: already here, {tmp_path / 'set'}"
    assert server.requests == [""]


def test_a_cut_connection_continues(server: Server, tmp_path: Path) -> None:
    server.cuts = [100_000, 0, 300_000]
    fetch(archive_of(server), tmp_path)
    assert (tmp_path / "set.zip").read_bytes() == server.content
    assert server.requests == ["", "bytes=100000-", "bytes=100000-", "bytes=400000-"]
    assert server.sent == len(server.content)


def test_a_later_call_continues(server: Server, tmp_path: Path) -> None:
    server.cuts, archive = [100_000, 0, 0, 0, 0], archive_of(server)
    with pytest.raises(InputError, match=r"no progress in 4 attempts, 0\.1 MB are here: repeat the command later"):
        fetch(archive, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set.zip.part", "set.zip.part.json"]
    server.status = [503]
    with pytest.raises(InputError, match="the server answers 503"):
        fetch(archive, tmp_path)
    fetch(archive, tmp_path)
    assert (tmp_path / "set.zip").read_bytes() == server.content
    assert server.sent == len(server.content)


def test_a_server_without_ranges_starts_again(server: Server, tmp_path: Path) -> None:
    server.ranges, server.cuts = False, [500_000, 600_000]
    fetch(archive_of(server), tmp_path / "one")
    assert (tmp_path / "one" / "set.zip").read_bytes() == server.content
    server.cuts = [100_000, 200_000, 300_000, 400_000, 500_000]
    with pytest.raises(InputError, match="no progress in 4 attempts"):
        fetch(archive_of(server), tmp_path / "two")
    assert not (tmp_path / "two" / "set.zip").exists()


@pytest.mark.parametrize("honest", [True, False])
def test_a_file_that_changed_between_calls_is_fetched_anew(server: Server, tmp_path: Path, honest: bool) -> None:
    """A server may ignore If-Range and send the rest of the new file."""
    server.cuts, archive = [100_000, 0, 0, 0, 0], archive_of(server)
    with pytest.raises(InputError):
        fetch(archive, tmp_path)
    server.content, server.tag = zipped({"first": b"new"} | FILES), '"two"' if honest else '"one"'
    fetch(archive, tmp_path)
    assert (tmp_path / "set.zip").read_bytes() == server.content
    assert server.requests[5:] == (["bytes=100000-"] if honest else ["bytes=100000-", ""])


def test_a_call_that_ended_before_the_check_is_not_repeated(server: Server, tmp_path: Path) -> None:
    receive.Download(server.url, tmp_path / "set.zip").run()
    fetch(archive_of(server), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set.zip", "set.zip.sha256"]
    assert server.requests == [""]


def test_checksums_are_compared(server: Server, tmp_path: Path) -> None:
    right = hashlib.sha256(server.content).hexdigest()
    with pytest.raises(
        InputError, match=f"set.zip has SHA-256 {right}, the one published is {'0' * 64}: fetch it again$"
    ):
        fetch(archive_of(server, sha256="0" * 64), tmp_path)
    assert not list(tmp_path.iterdir())
    fetch(archive_of(server, sha256=right), tmp_path)
    (tmp_path / "set.zip").unlink()
    server.content = zipped(FILES | {"more": b""})
    with pytest.raises(InputError, match=f"the one of the first download is {right}: fetch it again. If its authors"):
        fetch(archive_of(server), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["set.zip.sha256"]


def test_a_page_in_place_of_the_archive_is_refused(server: Server, tmp_path: Path) -> None:
    server.content = b"<html>log in</html>"
    with pytest.raises(InputError, match=r"set\.zip is no ZIP archive: its address may have changed"):
        fetch(archive_of(server), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_refusal_and_no_network_are_one_sentence(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.status = [404]
    for url, words in ((server.url, "the server answers 404"), ("http://127.0.0.1:9/x", "127.0.0.1 cannot be reached")):
        archives = f"dataset.archives=[{{file:berlin.zip,url:'{url}',scenes:[berlin]}}]"
        assert main(["datasets", "--get", "zipnerf", "dataset.scene=berlin", archives, "--to", str(tmp_path)]) == 2
        captured = capsys.readouterr()
        assert "licence: none found" in captured.out
        assert words in captured.err
        assert captured.err.count("\n") == 1
    assert not content_below(tmp_path)


class FullDisk:
    """A file on a disk that is full after some bytes."""

    def __init__(self, stream: IO[bytes], room: int) -> None:
        self.stream, self.room = stream, room

    def __enter__(self) -> "FullDisk":
        return self

    def __exit__(self, *_: object) -> None:
        self.stream.close()

    def write(self, content: bytes) -> int:
        self.room -= len(content)
        if self.room < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.stream.write(content)


def fill(monkeypatch: pytest.MonkeyPatch, name: str, room: int) -> None:
    """Let files of one name meet a full disk."""
    opened = Path.open

    def limited(path: Path, mode: str = "r", *others: Any, **named: Any) -> Any:
        stream = opened(path, mode, *others, **named)
        return FullDisk(stream, room) if path.name == name and mode in ("wb", "ab") else stream

    monkeypatch.setattr(Path, "open", limited)


def test_a_full_disk_keeps_what_was_received(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        fill(patch, "set.zip.part", 300_000)
        with pytest.raises(OSError, match="No space left"):
            fetch(archive_of(server), tmp_path)
    assert (tmp_path / "set.zip.part").stat().st_size == receive.PIECE
    fetch(archive_of(server), tmp_path)
    assert (tmp_path / "set.zip").read_bytes() == server.content
    assert server.requests == ["", f"bytes={receive.PIECE}-"]


def test_a_full_disk_leaves_no_half_scene(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = dataset_of(archive_of(server))
    with monkeypatch.context() as patch:
        fill(patch, "a.jpg", 100_000)
        with pytest.raises(OSError, match="No space left"):
            list(get(dataset, tmp_path, ["berlin", "london"]))
    assert not list((tmp_path / "set").iterdir())
    list(get(dataset, tmp_path, ["berlin", "london"]))
    assert UNPACKED.items() <= content_below(tmp_path).items()
    assert server.requests == [""]


def test_too_little_space_is_noticed_first(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receive.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 600_000}))
    with pytest.raises(InputError, match=r"set\.zip needs 0\.7 MB, .* has 0\.6 MB free"):
        fetch(archive_of(server), tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "set.zip").write_bytes(server.content)
    with pytest.raises(InputError, match=r"berlin needs 0\.7 MB"):
        unpack_scene(tmp_path / "set.zip", "berlin", ["images"], tmp_path / "berlin")


def linked() -> zipfile.ZipInfo:
    """A member that is a symbolic link."""
    member = zipfile.ZipInfo("set/berlin/images/link.jpg")
    member.external_attr = (stat.S_IFLNK | 0o777) << 16
    return member


@pytest.mark.parametrize("name", ["../x", "/x", "set/berlin/../../x", "C:/x", "set\\x", "set/berlin/..\\x", linked()])
def test_archives_that_leave_their_folder_are_refused(tmp_path: Path, name: str | zipfile.ZipInfo) -> None:
    archive = tmp_path / "set.zip"
    with zipfile.ZipFile(archive, "w") as stream:
        for each, content in FILES.items():
            stream.writestr(each, content)
        stream.writestr(name, "harmless")
    with pytest.raises(InputError, match=r"(leaves its folder|is a link or a device): nothing is unpacked"):
        unpack_scene(archive, "berlin", ["images"], tmp_path / "to" / "berlin")
    assert [path.name for path in tmp_path.iterdir()] == ["set.zip"]


def test_damaged_and_foreign_archives_are_refused(tmp_path: Path) -> None:
    archive = tmp_path / "set.zip"
    content = zipped(FILES)
    place = content.index(FILES["set/berlin/images/a.jpg"][:16])
    archive.write_bytes(content[: place + 5] + b"\0\0\0" + content[place + 8 :])
    with pytest.raises(InputError, match="is damaged or encrypted"):
        unpack_scene(archive, "berlin", ["images"], tmp_path / "berlin")
    with pytest.raises(InputError, match="holds no folder 'nyc' with images"):
        unpack_scene(archive, "nyc", ["images"], tmp_path / "nyc")
    assert [path.name for path in tmp_path.iterdir()] == ["set.zip"]


def test_archives_by_hand_are_checked_and_unpacked(server: Server, tmp_path: Path) -> None:
    dataset = dataset_of(archive_of(server, url="", sha256=hashlib.sha256(server.content).hexdigest()))
    sentence = "gsx cannot fetch berlin of Set. Source: https://example.org. Put it at"
    with pytest.raises(InputError, match=f"{sentence} {tmp_path}/archives/set.zip, and repeat the command"):
        list(get(dataset, tmp_path, ["berlin"]))
    (tmp_path / "archives").mkdir()
    (tmp_path / "archives" / "set.zip").write_bytes(server.content)
    list(get(dataset, tmp_path, ["berlin"]))
    assert (tmp_path / "set" / "berlin" / "sparse").is_dir()
    assert not server.requests


def test_an_incomplete_scene_is_left_alone(server: Server, tmp_path: Path) -> None:
    (tmp_path / "set" / "berlin" / "notes").mkdir(parents=True)
    with pytest.raises(InputError, match="berlin lacks sparse/0, images: delete or rename"):
        list(get(dataset_of(archive_of(server)), tmp_path, ["berlin"]))
    assert not server.requests


def test_addresses_and_names_are_checked() -> None:
    with pytest.raises(ConfigError, match="has to start with https:// or http://"):
        typed(Archive, {"file": "a.zip", "url": "file:///etc/x", "scenes": []}, "archive")
    with pytest.raises(ConfigError, match="has to be a name without folders"):
        typed(Archive, {"file": "../a.zip", "scenes": []}, "archive")


def test_built_in_archives_hold_scenes_of_their_datasets() -> None:
    urls: dict[str, str] = {}
    with Compositions(plugins()) as compositions:
        nodes = [
            compositions.node([f"dataset={name}"], "dataset")
            for name in listed("dataset")
            if name not in ("none", "own")
        ]
    for dataset in (typed(Dataset, node, "dataset") for node in nodes):
        for archive in dataset.archives:
            assert set(archive.scenes) <= set(dataset.scenes)
            assert urls.setdefault(archive.file, archive.url) == archive.url
            assert re.fullmatch("([0-9a-f]{64})?", archive.sha256)
    assert len(urls) == 10


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--get", "zipnrf"], "Unknown dataset 'zipnrf'. Choose from bungeenerf"),
        (["--get", "zipnerf", "dataset.scene=x"], "Unknown scene 'x'. Choose from alameda, berlin"),
        (["--get", "zipnerf", "demo"], "--get fetches one dataset: leave demo for another call"),
        (["--to", "x"], "--to FOLDER goes with --get NAME"),
        (["--get", "bungeenerf"], "gsx cannot fetch amsterdam, barcelona"),
    ],
)
def test_mistakes_are_one_sentence(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", *words]) == 2
    captured = capsys.readouterr()
    assert sentence in captured.err
    assert captured.err.count("\n") == 1
    assert not captured.out
