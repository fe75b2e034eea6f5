"""gsx export FILE OTHER; and every verb that takes a splat file takes the same kinds."""

import base64
import json
from pathlib import Path

import pytest
import torch
from foreign_splats import files_of, section, splat, unpacked, version_2, zipped
from foreign_splats import header as header_of
from foreign_splats import row as row_of
from tiny import tiny_settings

import gsx.api
from gsx.cli.dispatch import main
from gsx.cli.runs import compact_folder
from gsx.experiments.run_folder.run_key import scene_stamp
from gsx.formats.splat_files import compensated, read_gaussians, write_gaussians
from gsx.formats.suffixes import META, READABLE, SUFFIXES, suffix_of


def as_gltf(glb: bytes) -> bytes:
    """The same asset as text, with its buffer inside."""
    size = int.from_bytes(glb[12:16], "little")
    document = json.loads(glb[20 : 20 + size])
    document["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(glb[28 + size :]).decode()
    return json.dumps(document).encode()


def kinds(folder: Path) -> dict[str, Path]:
    """A file of each kind that is read, of two splats at least one of which lies at (1, -2, 0.5)."""
    (folder / "a.splat").write_bytes(splat(1) + splat(2))
    (folder / "a.ksplat").write_bytes(header_of(1, 2, 0) + section(2) + row_of(0, (1, 2, 3)) + row_of(0, (2, 2, 3)))
    zipped(folder / "a.sog", files_of(version_2()))
    unpacked(folder / "sog", files_of(version_2()))
    made = read_gaussians(folder / "a.sog")
    for suffix in (".ply", ".compressed.ply", ".spz", ".glb"):
        write_gaussians(folder / f"a{suffix}", made)
    (folder / "a.gltf").write_bytes(as_gltf((folder / "a.glb").read_bytes()))
    return {suffix: folder / f"a{suffix}" for suffix in SUFFIXES} | {"folder": folder / "sog"}


def test_every_kind_is_converted_by_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind, path in kinds(tmp_path).items():
        to = tmp_path / "made.ply"
        assert main(["export", str(path), str(to)]) == 0, kind
        assert capsys.readouterr().out.strip() == str(to)
        written, read = (vars(read_gaussians(one)) for one in (to, path))
        assert all(torch.equal(written[name], value) for name, value in read.items()), kind
        to.unlink()


def test_the_mark_for_compensated_opacities_is_kept(tmp_path: Path) -> None:
    meta, pictures = version_2()
    source = zipped(tmp_path / "a.sog", files_of((meta | {"antialias": True}, pictures)))
    for name in ("b.ply", "b.spz", "b.sog", "b.glb", "b.compressed.ply"):
        assert main(["export", str(source), str(tmp_path / name)]) == 0
        assert compensated(tmp_path / name), name


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "name the file to write as well"),
        (["b.splat"], "gsx writes .compressed.ply, .ply, .spz, .sog, .glb"),
        (["meta.json"], "is not written"),
        (["a.ply", "--bake", "2"], "--view and --bake are for runs"),
        (["a.splat"], "is not written"),
    ],
)
def test_what_cannot_be_converted_is_refused(
    tmp_path: Path, words: list[str], told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.splat").write_bytes(splat())
    assert main(["export", "a.splat", *words]) == 2
    assert told in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.splat"]


def test_a_file_is_not_converted_onto_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = kinds(tmp_path)[".ply"]
    before = path.read_bytes()
    assert main(["export", str(path), str(tmp_path / "sog" / ".." / "a.ply")]) == 2
    assert "is the file to read: name another" in capsys.readouterr().err
    assert path.read_bytes() == before


@pytest.mark.parametrize("verb", ["eval", "view", "render", "export", "compact"])
def test_the_help_of_every_verb_names_the_same_kinds(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    assert READABLE in " ".join(capsys.readouterr().out.split())


def test_other_names_are_refused_with_the_same_kinds(tmp_path: Path) -> None:
    (tmp_path / "a.usdz").write_bytes(b"")
    with pytest.raises(Exception, match=r"init is .*a\.usdz") as raised:
        tiny_settings(tmp_path / "run", f"init={tmp_path / 'a.usdz'}")
    assert READABLE in str(raised.value)


def test_every_kind_is_opened_and_begins_runs(tmp_path: Path) -> None:
    for kind, path in kinds(tmp_path).items():
        assert len(gsx.load(path).gaussians.means) == 2, kind
        init = Path(str(tiny_settings(tmp_path / "run", f"init={path}").general.init))
        assert suffix_of(init), kind
        assert len(read_gaussians(init).means) == 2, kind


def test_the_pictures_of_an_unbundled_sog_count_for_what_is_trained(tmp_path: Path) -> None:
    folder = kinds(tmp_path)["folder"]

    def stamp() -> str:
        return scene_stamp(tiny_settings(tmp_path / "run", f"init={folder}").resolved)

    before = stamp()
    assert stamp() == before
    (folder / "scales.webp").write_bytes((folder / "sh0.webp").read_bytes() + b"\0")
    assert stamp() != before


def test_the_page_on_formats_names_all_kinds() -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "formats.md").read_text()
    reading = page[page.index("\n## In\n") :]
    assert all(f"`{kind}`" in reading for kind in (*SUFFIXES, META))


def test_a_smaller_run_lies_beside_what_it_is_made_of(tmp_path: Path) -> None:
    files = kinds(tmp_path)
    assert compact_folder(files[".splat"]) == compact_folder(files[".compressed.ply"]) == tmp_path / "a_compact"
    assert compact_folder(files["folder"] / "meta.json") == tmp_path / "sog_compact"


@pytest.mark.parametrize("verb", [["eval"], ["photographs"], ["export", "to.ply"]])
def test_a_file_whose_name_shows_no_format_is_a_file(
    verb: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, remedy in (("model.spz.bak", True), ("model", True), ("model.ply", False)):
        (tmp_path / name).write_bytes(b"")
        if remedy or verb == ["photographs"]:
            assert main([verb[0], name, *verb[1:]]) == 2
            message = capsys.readouterr().err
            assert f"{name} is a file, not a run folder" in message
            assert ("let its name end in one of .compressed.ply, .ply, .spz" in message) == remedy
