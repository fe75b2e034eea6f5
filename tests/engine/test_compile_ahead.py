"""Everything that a step needs is compiled before the first step, half of it by a second process."""

import json
import platform
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from processes import Begin
from raster_scenes import any_path
from tiny import tiny_settings

from gsx.builtin import plugins
from gsx.core.training.trainer import train_step
from gsx.engine import compile_ahead
from gsx.engine.compile_ahead import Step, compiling_early, end, help_compiling, helper, needed
from gsx.engine.compile_cache import CachedFunction, Call, file_of, recorded
from gsx.engine.compiling import available
from gsx.experiments.runs.open import start
from gsx.experiments.runs.rasterizer_path import warm

CPU = torch.device("cpu")


@pytest.fixture
def compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets a compiler work where calls are only recorded; its code would lie in a folder of the test."""
    monkeypatch.setattr("gsx.engine.backend.available", lambda _: True)
    monkeypatch.setattr("gsx.engine.compiled.available", lambda _: True)
    monkeypatch.setattr("gsx.engine.compile_cache.functions_folder", lambda: tmp_path / "functions")


def files_of(calls: list[Call]) -> dict[Path, str]:
    """Returns where code for calls is kept, and the names of their functions."""
    return {file_of(*call): call[0].function.__name__ for call in calls}


@pytest.mark.skipif(not available(), reason="no working compiler")
@pytest.mark.usefixtures("compiler")
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
    ahead = list[Call]()
    monkeypatch.setattr(compile_ahead, "make_ahead", lambda calls, stopping: ahead.extend(calls))
    settings = tiny_settings(tmp_path / "run", *given.split(), "rasterizer=compiled")
    run = start(settings, plugins())
    with recorded():
        warm(run, helped=False)
    with recorded() as taken:
        train_step(run, plugins())
        run.step = run.iterations - 1  # with all bands of colours
        train_step(run, plugins())
    names = set(files_of(ahead).values())
    assert "transmit" in names  # later steps may need it
    assert ("harmonics_along" in names) == (given != "backbone=scaffold")
    assert set(files_of(taken).values()) >= {"blend", "gradients", "make_rows", "geometry"}
    assert set(files_of(taken)) <= set(files_of(ahead))


class Begun:
    """A process that was begun, and what becomes of it."""

    pid = 1 << 30
    """Nobody's."""

    def __init__(self, words: list[str]) -> None:
        self.args, self.ended, self.code = words, list[str](), None

    def poll(self) -> int | None:
        return self.code

    def terminate(self) -> None:
        self.ended.append("terminated")

    def communicate(self) -> None:
        self.ended.append("waited for")


@pytest.mark.skipif(not available(), reason="no working compiler")
@pytest.mark.usefixtures("compiler")
def test_the_helper_compiles_the_same_calls_from_the_other_end(monkeypatch: pytest.MonkeyPatch) -> None:
    made, begun = list[Path](), list[Begun]()
    platform.processor()  # starts a process of its own the first time
    monkeypatch.setattr(CachedFunction, "make", lambda self, file, arguments: (made.append(file), file.touch()))
    monkeypatch.setattr("subprocess.Popen", lambda words, **_: begun.append(Begun(words)) or begun[-1])
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    monkeypatch.setattr("torch.set_num_threads", lambda _: None)
    monkeypatch.setattr(compile_ahead, "end_with_input", lambda: None)
    step = Step(settings=any_path(path="compiled", dilation=0.2, zoomed="magnified"), sh_degree=2)
    with helper(step):
        (process,) = begun
        assert process.ended == []
        help_compiling(process.args[-1])
    assert process.ended == ["terminated", "waited for"]
    assert made == list(files_of(needed(step, CPU)[::-1]))
    assert len(made) >= 8


@pytest.mark.parametrize(("missing", "helped", "threads", "begins"), [
    (2, True, 2, True), (2, True, 1, False), (2, False, 2, False), (1, True, 2, False), (0, True, 2, False),
])  # fmt: skip
def test_help_is_for_several_functions_and_threads(
    missing: int, helped: bool, threads: int, begins: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    begun = list[dict[str, Any]]()
    monkeypatch.setattr("subprocess.Popen", lambda words, **_: begun.append(json.loads(words[-1])) or Begun(words))
    monkeypatch.setattr("torch.get_num_threads", lambda: threads)
    monkeypatch.setattr(compile_ahead, "needed", lambda *_: [])
    monkeypatch.setattr(compile_ahead, "uncached", lambda _: range(missing))
    monkeypatch.setattr(compile_ahead, "functions_folder", lambda: tmp_path)
    monkeypatch.setattr(compile_ahead, "draw_one", lambda *_: None)
    compile_ahead.compile_ahead(Step(settings=any_path(), sh_degree=3), CPU, helped)
    assert [words["sh_degree"] for words in begun] == ([3] if begins else [])


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[Begun]:
    """Lists second processes, which do nothing."""
    processes = list[Begun]()
    monkeypatch.setattr("subprocess.Popen", lambda words, **_: processes.append(Begun(words)) or processes[-1])
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    return processes


def test_a_step_that_is_compiled_early_needs_no_other_process(begun: list[Begun]) -> None:
    step, same = Step(settings=any_path()), Step(settings=any_path(training_focal=500.0))
    with helper(step):
        with helper(same):
            pass
        assert len(begun) == 1
        assert begun[0].ended == []
        begun[0].code = -9  # killed
        with helper(step):
            assert len(begun) == 2
        assert begun[1].ended == ["terminated", "waited for"]
    assert begun[0].ended == ["terminated", "waited for"]


def test_a_process_for_another_step_ends(begun: list[Begun]) -> None:
    with helper(Step(settings=any_path())), helper(Step(settings=any_path(), sh_degree=3)):
        assert len(begun) == 2
        assert begun[0].ended == ["terminated", "waited for"]
        assert begun[1].ended == []


def test_nothing_begins_early_where_a_step_is_cached(
    begun: list[Begun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compile_ahead, "functions_folder", lambda: tmp_path)
    monkeypatch.setattr(compile_ahead, "needed", lambda *_: [object()])
    step = Step(settings=any_path(), sh_degree=3)
    with compiling_early(step):
        assert len(begun) == 1
    for missing, stamps in ([object()], 0), ([], 1):
        monkeypatch.setattr(compile_ahead, "uncached", lambda _, missing=missing: missing)
        monkeypatch.setattr(compile_ahead, "make_ahead", lambda *_: None)
        monkeypatch.setattr(compile_ahead, "draw_one", lambda *_: None)
        compile_ahead.compile_ahead(step, CPU)
        assert len(list(tmp_path.glob("*.done"))) == stamps
    with compiling_early(step):
        assert len(begun) == 1
    with compiling_early(Step(settings=any_path(tile_size=16), sh_degree=3)):
        assert len(begun) == 2


def test_a_helper_ends_with_a_compiler_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    tries = list[int]()
    monkeypatch.setattr(compile_ahead, "end_with_input", lambda: None)
    monkeypatch.setattr(compile_ahead, "needed", lambda *_: [1, 2, 3])
    monkeypatch.setattr(compile_ahead, "uncached", list)
    monkeypatch.setattr(compile_ahead, "make_ahead", tries.extend)
    help_compiling(Step(settings=any_path()).words)
    assert tries == [3]


def test_a_process_that_cannot_be_begun_is_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no memory for another")

    monkeypatch.setattr("subprocess.Popen", refuse)
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    with helper(Step(settings=any_path())):
        pass


ENDING = """
import subprocess, sys
from gsx.engine.compile_ahead import end_with_input
subprocess.Popen(["sleep", "60"])
print(1, flush=True)
end_with_input()
"""


@pytest.mark.parametrize("who", ["who began it", "nobody"])
def test_compilers_of_a_helper_end_with_it(begin: Begin, who: str) -> None:
    words = [sys.executable, "-c", ENDING] if who == "nobody" else ["sh", "-c", "sleep 60 & echo 1; wait"]
    process = begin(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.read(2) == b"1\n"
    end(process) if who != "nobody" else process.communicate()  # comes back when nobody holds the pipe any more
    assert process.returncode == -signal.SIGTERM


def test_a_helper_in_a_group_of_others_ends_alone(begin: Begin) -> None:
    code = "from gsx.engine.compile_ahead import end_with_input; end_with_input(); print(1)"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    process = begin([sys.executable, "-c", code], start_new_session=False, **pipes)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.5)
    assert process.communicate()[0] == b""  # closes its input
    assert process.returncode == 0
