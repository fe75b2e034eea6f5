"""Whether a run folder is whole: what may be missing or damaged of it, what is said, and what going on makes again."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from synthetic_colmap import synthesize, write_scene
from tiny import words

from gsx.cli.dispatch import main
from gsx.core.files import process_tag
from gsx.experiments.run_folder.files import has_figures, read_run, state_of
from gsx.experiments.run_folder.shapes import LINE, fits, is_number

OLD = Path(__file__).parents[2] / "old_run"
QUICK = ("iterations=2", "training.log_every=1", "training.checkpoint_every=1", "rasterizer=eager")
CHECKPOINT = "checkpoints/step_0000002"
DONE = "2 of 2 steps, evaluated at step 2, without"

Change = Callable[[Path], object]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of two steps, as the command line leaves it."""
    folder = tmp_path_factory.mktemp("files") / "run"
    assert main(words(folder, *QUICK, "eval.flight=true")) == 0
    return folder


@pytest.fixture
def run(whole: Path, tmp_path: Path) -> Path:
    shutil.copytree(whole, tmp_path / "run")
    return tmp_path / "run"


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# -- what is said --------------------------------------------------------------------------------------------------


def test_a_finished_run_is_ok_and_lacks_nothing(whole: Path) -> None:
    files = read_run(whole)
    assert state_of(files) == ("ok", "")
    assert files.lacking == []


@pytest.mark.parametrize(
    "name",
    [
        *("environment.json", "metrics.jsonl", "log.txt", "status.json", "report.html", "point_cloud.ply"),
        *("renders/index.json", "renders/test_000.truth.png", "renders/_flight.render.jpg"),
        *(f"{CHECKPOINT}.safetensors", f"{CHECKPOINT}.json"),
    ],
)
def test_a_run_without_one_of_its_files_is_not_ok(run: Path, name: str) -> None:
    (run / name).unlink()
    assert state_of(read_run(run)) == ("interrupted", f"{DONE} {name}")


def test_a_run_without_any_checkpoint_says_which_is_missing_and_that_nothing_brings_it_back(run: Path) -> None:
    shutil.rmtree(run / "checkpoints")  # with the one before the last
    files = read_run(run)
    assert state_of(files) == ("interrupted", f"{DONE} {CHECKPOINT}.safetensors, {CHECKPOINT}.json")
    assert files.unfinished == []
    assert files.lost == [f"{CHECKPOINT}.safetensors", f"{CHECKPOINT}.json"]
    assert main(["report", str(run)]) == 0
    assert f"which may not bring back {CHECKPOINT}.safetensors" in (run / "report.html").read_text()


@pytest.mark.parametrize(
    ("name", "length", "problem"),
    [
        ("point_cloud.ply", 0, "no complete PLY header"),
        ("point_cloud.ply", 1000, "no complete PLY header"),
        ("point_cloud.ply", -1, "bytes, its header says"),
        ("renders/index.json", 1, "renders/index.json cannot be read"),
        ("environment.json", 1, "environment.json cannot be read"),
        ("status.json", 1, "status.json cannot be read"),
        ("metrics.jsonl", 0, "metrics.jsonl holds no line of the run"),
        (f"{CHECKPOINT}.safetensors", 0, "step_0000002.safetensors cannot be read"),
        (f"{CHECKPOINT}.safetensors", 4, "step_0000002.safetensors cannot be read"),
        (f"{CHECKPOINT}.safetensors", -1, "file not fully covered"),
        (f"{CHECKPOINT}.json", 1, "step_0000002.safetensors cannot be read"),
    ],
)
def test_a_run_with_a_file_cut_short_is_corrupted(run: Path, name: str, length: int, problem: str) -> None:
    content = (run / name).read_bytes()
    (run / name).write_bytes(content[:length])
    state, reason = state_of(read_run(run))
    assert state == "corrupted"
    assert problem in reason


def test_a_run_of_an_older_gsx_says_in_a_sentence_what_it_lacks() -> None:
    state, reason = state_of(read_run(OLD))
    assert state == "interrupted"
    assert "without log.txt" in reason
    assert "checkpoints" not in reason


# -- what going on makes again -------------------------------------------------------------------------------------


def without(name: str) -> Change:
    return lambda run: (run / name).unlink()


def cut(name: str) -> Change:
    return lambda run: (run / name).write_bytes((run / name).read_bytes()[:1])


@pytest.mark.parametrize(
    "change",
    [
        *(without("environment.json"), without("log.txt"), without("renders/test_000.truth.png")),
        *(cut("point_cloud.ply"), cut(f"{CHECKPOINT}.safetensors")),
    ],
)
def test_the_remedy_makes_again_what_a_finished_run_lacks(run: Path, change: Change) -> None:
    model = (run / f"{CHECKPOINT}.safetensors").read_bytes()
    change(run)
    assert main(read_run(run).remedy.split()[1:]) == 0
    assert state_of(read_run(run)) == ("ok", "")
    assert (run / f"{CHECKPOINT}.safetensors").read_bytes() == model


def test_a_composition_that_was_trained_is_completed_and_never_trained_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a scene with a folder, whose stamp counts, too."""
    write_scene(synthesize(), tmp_path / "yard")
    scene = ["scene=colmap", f"scene.path={tmp_path / 'yard'}", "backbone=gs3d", "training.test_points=2"]
    command = [*scene, *QUICK, "reuse=true", f"output={tmp_path / 'out'}"]
    assert main(command) == 0
    (run,) = tmp_path.glob("out/yard/gs3d/*/")
    model = (run / f"{CHECKPOINT}.safetensors").read_bytes()

    def given_again() -> str:
        capsys.readouterr()
        assert main(command) == 0
        assert list(tmp_path.glob("out/yard/gs3d/.*_set_aside_*")) == []
        return capsys.readouterr().err

    picture = next((run / "renders").glob("*.truth.png"))
    for change in (without(f"renders/{picture.name}"), cut("point_cloud.ply"), without("environment.json")):
        change(run)
        assert "continuing" in given_again()
        assert state_of(read_run(run)) == ("ok", "")
        assert (run / f"{CHECKPOINT}.safetensors").read_bytes() == model
    for change in (without("metrics.jsonl"), cut(f"{CHECKPOINT}.safetensors"), without("log.txt")):
        change(run)
        before = contents(run)
        assert "finished earlier" in given_again(), "its figures are whole, and nothing makes this again"
        assert contents(run) == before
    assert state_of(read_run(run))[0] == "corrupted"
    shutil.rmtree(run / "checkpoints")
    picture.unlink()
    assert "finished earlier" in given_again(), "no checkpoint could draw it"
    assert has_figures(read_run(run))


# -- what is read --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "sound"),
    [(0, True), (-1.5, True), (10**30, True), (10**400, False), (1e308, False), (float("nan"), False), (True, False)],
)
def test_numbers_are_those_that_can_be_reckoned_with(value: float, sound: bool) -> None:
    assert is_number(value) is sound


ACCOUNT = {"event": 1, "asked": {"2": 4}, "dropped": {}, "warned": {"agreement": {"2": 1}}}


@pytest.mark.parametrize(
    ("line", "sound"),
    [
        ({"step": 5, "pseudo": {"up": ACCOUNT}}, True),
        ({"step": 5, "loss": float("nan"), "memory_mb": None}, True),
        ({"step": 5, "pseudo": 5}, False),
        ({"step": 5, "pseudo": {"up": 5}}, False),
        ({"step": 5, "pseudo": {"up": ACCOUNT | {"warned": 5}}}, False),
        ({"step": 5, "pseudo": {"up": ACCOUNT | {"asked": {"2": "four"}}}}, False),
        ({"step": 5, "pseudo": {"up": ACCOUNT | {"dropped": {"two": 1}}}}, False),
        ({"step": 5, "withheld": "many"}, False),
        ({"step": 5, "memory_mb": "much"}, False),
        ({"step": 10**400}, False),
        ([5], False),
    ],
)
def test_lines_that_a_run_cannot_reckon_with_are_damaged(line: object, sound: bool) -> None:
    assert fits(line, LINE) is sound


def test_a_run_with_odd_lines_goes_on(run: Path) -> None:
    odd = [{"step": 1, "psnr": 3}, {"step": 2, "pseudo": 5}, {"step": 2, "pseudo": {"upscale": 5}}]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in odd))
    assert main(["resume", str(run), "iterations=3"]) == 0
    assert [line["step"] for line in read_run(run).lines] == [1, 3]
    assert state_of(read_run(run)) == ("ok", "")


@pytest.mark.parametrize("verb", ["report", "render"])
def test_what_killed_processes_left_half_written_among_the_pictures_is_removed(run: Path, verb: str) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    machine = process_tag().rpartition("-")[0]
    left = run / "renders" / f".test_000.truth.{machine}-{dead.pid}-01234567.partial.png"
    mine = run / "renders" / f".test_000.render.{process_tag()}-01234567.partial.png"
    for path in (left, mine):
        path.write_bytes(b"half")
    assert main([verb, str(run)]) == 0
    assert not left.exists()
    assert mine.exists(), "its process is at work"


@pytest.mark.parametrize(
    ("shape", "sound", "unsound"),
    [
        (str, ["", "a"], [1, None, ["a"]]),
        ([str], [[], ["a", "b"]], ["a", [1], {}]),
        ((is_number, is_number), [[1, 2.5]], [[1], [1, 2, 3], [1, "2"], None]),
        ({"a": is_number, "b?": [str]}, [{"a": 1}, {"a": 1, "b": [], "c": None}], [{}, {"a": None}, {"a": 1, "b": 2}]),
        ({str: {"a?": dict}}, [{}, {"x": {}, "y": {"a": {}}}], [[], {"x": {"a": 1}}, {"x": 1}]),
    ],
)
def test_shapes_are_types_predicates_lists_tuples_and_mappings(shape: object, sound: list, unsound: list) -> None:
    assert [fits(value, shape) for value in (*sound, *unsound)] == [True] * len(sound) + [False] * len(unsound)
