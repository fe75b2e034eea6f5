"""What is compiled before the first step, and beside what is drawn: there the settings are handed over when that is
done, and only then."""

import platform
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import pytest
import torch
from processes import Begin
from tiny import tiny_settings

from gsx.builtin import plugins
from gsx.core.data.scene import Scene
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.trainer import train_step
from gsx.engine.compile_cache import FOLDER, Call, KeptFunction, file_of, recorded, recording
from gsx.engine.compiling import available
from gsx.experiments.runs import rasterizer_path
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import start
from gsx.experiments.runs.rasterizer_path import (
    HELPED,
    Learnt,
    compile_beside,
    compile_now,
    help_at_once,
    help_compiling,
    helper,
    learn_little,
    needed,
    warm,
)
from gsx.experiments.runs.settings import Settings

CPU = torch.device("cpu")


@pytest.fixture
def compiler(monkeypatch):
    """A compiler that there is, and what it makes of the picture that has everything compiled."""
    monkeypatch.setattr(rasterizer_path, "available", lambda _: True)

    def set_to(draw):
        monkeypatch.setattr(rasterizer_path, "rasterize_tiled", draw)

    return set_to


def test_compiled_settings_come_when_the_picture_is_drawn(compiler):
    let, taken, drawn = Event(), [], []
    compiler(
        lambda splats, camera, settings, background: (drawn.append((len(splats.means), settings.path)), let.wait(30))
    )
    thread = compile_beside(RasterSettings(dilation=0.1, path="auto"), CPU, taken.append)
    assert taken == []
    let.set()
    thread.join(30)
    assert taken == [RasterSettings(dilation=0.1, path="compiled")]
    assert drawn == [(rasterizer_path.WARM_SPLATS, "compiled")]


def test_a_compiler_that_fails_changes_nothing(compiler, caplog):
    def fail(*_, **__):
        raise RuntimeError("no such instruction")

    compiler(fail)
    taken = []
    with caplog.at_level("INFO"):
        compile_beside(RasterSettings(path="auto"), CPU, taken.append).join(30)
    assert taken == []
    assert "eager path (no such instruction)" in caplog.text


def test_who_asks_for_the_eager_path_keeps_it(compiler):
    compiler(lambda *_, **__: pytest.fail("compiled"))
    assert not compile_beside(RasterSettings(path="eager"), CPU, pytest.fail).is_alive()


def files_of(calls: list[Call]) -> dict[str, Path]:
    """Where code for these calls is kept, by what it is called."""
    found = {}
    for call in calls:
        file = file_of(call)
        assert file is not None
        found[f"{call[0].function.__name__} {file.stem}"] = file
    return found


@pytest.mark.skipif(not available(), reason="no working compiler")
@pytest.mark.parametrize(
    "given",
    [
        "backbone=gs3d",
        "backbone=gs3d backbone.sh_degree=1",
        "backbone=gs3d backbone.capacity=adaptive",
        "backbone=gs3d_zoom",
        "backbone=mip_splatting",
        "backbone=octree_gs3d",
        "backbone=scaffold",
    ],
)
def test_no_step_needs_what_is_not_compiled_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str) -> None:
    monkeypatch.setattr("gsx.engine.path.available", lambda _: True)
    monkeypatch.setattr("gsx.engine.compiled.available", lambda _: True)
    monkeypatch.setattr("gsx.engine.compile_cache.place", lambda: tmp_path / "functions")
    ahead = list[Call]()
    monkeypatch.setattr(rasterizer_path, "make_ahead", lambda calls, stopping: ahead.extend(calls))
    monkeypatch.setattr(rasterizer_path, "helper", lambda *_: nullcontext())
    settings = tiny_settings(tmp_path / "run", *given.split(), "rasterizer=compiled")
    run = start(settings, plugins())
    with recorded():
        warm(run, settings)
    with recorded() as taken:
        train_step(run, plugins())
        run.step = run.iterations - 1  # with all bands of colours
        train_step(run, plugins())
    names = {call[0].function.__name__ for call in ahead}
    assert "transmit" in names  # later steps may need it
    assert ("harmonics_along" in names) == (given != "backbone=scaffold")
    assert {call[0].function.__name__ for call in taken} >= {"blend", "gradients", "make_rows", "geometry"}
    assert set(files_of(taken)) <= set(files_of(ahead))


class Begun:
    """A process that was begun, and what becomes of it."""

    pid = 1 << 30
    """Nobody's."""

    def __init__(self, words: list[str], ended: list[str]) -> None:
        self.words, self.ended = words, ended

    def kill(self) -> None:
        self.ended.append("killed")

    def communicate(self) -> None:
        self.ended.append("waited for")


@pytest.mark.skipif(not available(), reason="no working compiler")
@pytest.mark.parametrize("zoomed", ["plain", "magnified"])
def test_the_helper_makes_from_the_other_end_what_no_backbone_changes_and_the_others_come_first(
    zoomed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, begun = [], list[Begun]()
    platform.processor()  # starts a process of its own the first time
    monkeypatch.setattr("gsx.engine.path.available", lambda _: True)
    monkeypatch.setattr("gsx.engine.compiled.available", lambda _: True)
    monkeypatch.setattr("gsx.engine.compile_cache.place", lambda: tmp_path / "functions")
    monkeypatch.setattr(KeptFunction, "make", lambda self, file, arguments: (made.append(file), file.touch()))
    monkeypatch.setattr("subprocess.Popen", lambda words, **_: begun.append(Begun(words, [])) or begun[-1])
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    monkeypatch.setattr("torch.set_num_threads", lambda _: None)
    monkeypatch.setattr(rasterizer_path, "end_with", lambda _: None)
    rules = RasterSettings(path="compiled", dilation=0.2, zoomed=zoomed)
    learnt = Learnt(sh_degree=2)
    calls = needed(rules, learnt, CPU)
    with helper(rules, 2):
        (process,) = begun
        assert process.ended == []
        help_compiling(process.words[-1])
    assert process.ended == ["killed", "waited for"]
    own = ("geometry", "gradients")
    expected = {file: name for name, file in files_of(calls[::-1]).items() if not name.startswith(own)}
    assert made == list(expected)
    assert len(made) == len(files_of(calls)) - 2 >= 8
    for file in made[:3]:
        file.unlink()
    monkeypatch.setattr(rasterizer_path, "learn_little", partial(recording_only, learn_little))
    compile_now(rules, learnt, CPU)
    assert [file.stem.split("-")[0] for file in made[len(expected) :][:2]] == [*own]
    assert set(made[len(expected) + 2 :]) == set(made[:3])


def recording_only(function: Callable[..., None], *given: Any) -> None:
    """A function that would compile, where calls are only to be known."""
    if recording():
        function(*given)


def test_a_process_that_cannot_be_begun_is_done_without(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no memory for another")

    monkeypatch.setattr("subprocess.Popen", refuse)
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    with caplog.at_level("INFO"), helper(RasterSettings(), 3):
        assert not HELPED.get()
    assert "compiles alone (no memory for another)" in caplog.text


HELPER = """
import subprocess, sys
from gsx.experiments.runs.rasterizer_path import end_with
subprocess.Popen(["sleep", "60"])
print(1, flush=True)
end_with(sys.stdin.buffer)
"""


@pytest.mark.parametrize(("words", "end"), [
    (["sh", "-c", "sleep 60 & echo 1; wait"], rasterizer_path.kill),
    ([sys.executable, "-c", HELPER], subprocess.Popen.communicate),  # nobody is there any more
])  # fmt: skip
def test_compilers_of_a_helper_end_with_it(begin: Begin, words: list[str], end: Callable[[Any], object]) -> None:
    process = begin(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.read(2) == b"1\n"
    end(process)  # comes back when nobody holds the end of the pipe any more
    assert process.returncode == -signal.SIGKILL


def test_a_helper_ends_with_who_began_it(begin: Begin) -> None:
    code = "import sys; from gsx.experiments.runs.rasterizer_path import end_with; end_with(sys.stdin.buffer); print(1)"
    process = begin(
        [sys.executable, "-c", code], start_new_session=False, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.5)
    assert process.communicate()[0] == b""  # closes its input
    assert process.returncode == 0


@pytest.fixture
def helped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """What becomes of helpers; this process has two threads, and an empty place for what is compiled."""
    told: list[str] = []

    def noted(settings: RasterSettings, sh_degree: int) -> Begun:
        assert sh_degree == 3
        told.append(f"begins {settings.path}")
        return Begun([], told)

    monkeypatch.setattr(rasterizer_path, "begun", noted)
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "code"))
    return told


@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({"path": "compiled"}, 1),
        ({"path": "auto", "auto_steps": 300}, 300),
    ],
)
def test_help_begins_at_once_where_nothing_was_ever_compiled(
    settings: dict[str, Any], steps: int, helped: list[str], tmp_path: Path
) -> None:
    path, asked = settings["path"], with_rules(steps, **settings)
    with help_at_once(asked, CPU):
        assert helped == [f"begins {path}"]
    assert helped == [f"begins {path}", "killed", "waited for"]
    (tmp_path / "code" / FOLDER).mkdir(parents=True)
    (tmp_path / "code" / FOLDER / "blend-0.bin").touch()
    with help_at_once(asked, CPU):
        assert len(helped) == 3


def with_rules(steps: int, **rules: Any) -> Settings:
    """The tiny experiment of so many steps, drawn by these rules."""
    settings = tiny_settings(Path("later"))
    return replace(settings, raster=RasterSettings(**rules), general=replace(settings.general, iterations=steps))


def test_a_process_of_one_thread_is_not_helped(helped: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.get_num_threads", lambda: 1)
    with help_at_once(with_rules(300, path="compiled"), CPU):
        assert helped == []


@pytest.mark.parametrize(
    ("settings", "steps", "device"),
    [
        ({"path": "compiled"}, 300, "cuda"),
        ({"path": "auto", "auto_steps": 300}, 299, "cpu"),
        ({"path": "eager"}, 300, "cpu"),
    ],
)
def test_no_help_begins_for_what_is_not_compiled_here(
    settings: dict[str, Any], steps: int, device: str, helped: list[str]
) -> None:
    with help_at_once(with_rules(steps, **settings), torch.device(device)):
        assert helped == []


def test_a_run_is_helped_from_before_its_scene_is_read_until_it_ends(
    helped: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = load_scene

    def noted(settings: Settings) -> Scene:
        helped.append("scene")
        return read(settings)

    monkeypatch.setattr("gsx.experiments.runs.open.load_scene", noted)
    monkeypatch.setattr("gsx.engine.compiled.available", lambda _: False)  # nor is anything compiled here
    settings = tiny_settings(tmp_path / "run", "rasterizer=compiled")
    with ExitStack() as claims:
        start(settings, plugins(), claims)
        helped.append("training")
    assert helped == ["begins compiled", "scene", "training", "killed", "waited for"]


def test_a_second_helper_does_not_join_the_first(helped: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rasterizer_path, "learn_little", lambda *_: None)
    monkeypatch.setattr(rasterizer_path, "lacking", lambda _: True)
    settings, learnt = with_rules(300, path="compiled"), Learnt(sh_degree=3)
    with help_at_once(settings, CPU):
        compile_now(settings.raster, learnt, CPU, helped=True)
        assert helped == ["begins compiled"]
    compile_now(settings.raster, learnt, CPU, helped=True)
    assert helped == ["begins compiled", "killed", "waited for"] * 2
