"""Compiled functions that are kept on disk: what another process finds there, and what it must not take for its own."""

import os
import secrets
import shutil
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any
from unittest.mock import patch

import pytest
import torch
from compilations import new_code
from torch import Tensor
from torch._inductor.output_code import CompiledFxGraph

from gsx.core.errors import CompilerError
from gsx.core.quality.similarity import compiled_correlate, correlate
from gsx.engine import compile_cache
from gsx.engine.cache import made_by_one
from gsx.engine.compile_cache import (
    FOLDER,
    KeptFunction,
    digest_of,
    flat,
    lacking,
    make_ahead,
    nothing_kept,
    recorded,
    waiting_counted,
    without_layers,
)
from gsx.engine.compiling import available, compile_rows, compiled_once, settled, with_last

pytestmark = pytest.mark.skipif(not available(), reason="no working compiler on this machine")

SOURCE = """
FACTOR = 3.0

def inner(x):
    return x * FACTOR

def weighted(x, y, power):
    return (inner(x) ** power + y[:, :1]).sum(1)
"""


def module_of(source: str) -> types.ModuleType:
    """A module of gsx, as far as its functions know, of this source."""
    module = types.ModuleType("gsx.of_a_test")
    exec(compile(source, "of_a_test.py", "exec"), module.__dict__)
    return module


def weighted(x: Tensor, y: Tensor, power: int) -> Tensor:
    """What is compiled here."""
    return ((3.0 * x) ** power + y[:, :1]).sum(1)


def rows(count: int, **options: object) -> tuple[Tensor, Tensor]:
    """Arguments of so many rows."""
    generator = torch.Generator().manual_seed(count)
    return tuple(torch.rand(count, 2, generator=generator, dtype=torch.float64).to(**options) for _ in range(2))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where code is kept, empty at first; torch's own stays where it is, and is found."""
    monkeypatch.setattr("gsx.engine.compile_cache.place", lambda: tmp_path / FOLDER)
    return tmp_path / FOLDER


@contextmanager
def made(monkeypatch: pytest.MonkeyPatch):
    """Names of the functions that are compiled meanwhile, not loaded."""
    names, make = list[str](), KeptFunction.make

    def noted(self: KeptFunction, *given: object) -> object:
        names.append(self.function.__name__)
        return make(self, *given)

    with monkeypatch.context() as patch:
        patch.setattr(KeptFunction, "make", noted)
        yield names


def agrees(function: Callable[..., Tensor], x: Tensor, y: Tensor) -> bool:
    """Whether compiled code gives what the function gives, as a whole and in its gradient."""
    wanted, found = weighted(x, y, 2), function(x, y)
    torch.testing.assert_close(found, wanted)
    return True


def test_code_is_made_once_and_then_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with made(monkeypatch) as names:
        first = compile_rows(weighted, 2)
        with waiting_counted() as waited:
            agrees(first, *rows(5))
            once = waited.seconds
            assert all(agrees(first, *rows(count)) for count in (9, 2, 400))
        assert names == ["weighted"]
        assert 0 < once == waited.seconds, "code that is known is not waited for"
        assert [file.suffix for file in sorted(folder.iterdir())] == [".bin", ".lock"]
        assert all(agrees(compile_rows(weighted, 2), *rows(count)) for count in (7, 5))
        assert names == ["weighted"]


def test_other_arguments_get_other_code(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    function = compile_rows(weighted, 2)
    x, y = rows(6)
    with made(monkeypatch) as names:
        for number, given in enumerate(
            [(x, y), (x.float(), y.float()), (x, torch.cat([y, y], 1)), (x.mT.contiguous().mT, y), (x, x)], start=1
        ):
            assert agrees(function, *given)
            assert len(names) == number
            assert agrees(function, *given)
            assert len(names) == number
        torch.set_default_dtype(torch.float64)  # of numbers that name none
        try:
            assert agrees(function, x, y)
        finally:
            torch.set_default_dtype(torch.float32)
        assert len(names) == number + 1


def test_gradients_are_those_of_the_function_when_code_is_found(folder: Path) -> None:
    slopes = []
    for function in (lambda x, y: weighted(x, y, 2), compile_rows(weighted, 2), compile_rows(weighted, 2)):
        x, y = (values.requires_grad_() for values in rows(8))
        function(x, y).square().sum().backward()
        slopes.append((x.grad, y.grad))
    for found in slopes[1:]:
        torch.testing.assert_close(found, slopes[0])
    assert len(list(folder.glob("*.bin"))) == 1


def test_where_no_gradient_is_followed_it_is_one_code(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that are measured have none, whether or not torch would follow some."""
    with made(monkeypatch) as names:
        with torch.no_grad():
            assert agrees(compile_rows(weighted, 2), *rows(6))
        assert agrees(function := compile_rows(weighted, 2), *rows(7))
    assert names == ["weighted"]
    x, y = (values.requires_grad_() for values in rows(5))
    assert function(x, y).requires_grad


def test_another_last_argument_is_another_function(folder: Path) -> None:
    x, y = rows(6)
    compile_rows(weighted, 2)(x, y)
    torch.testing.assert_close(compile_rows(weighted, 3)(x, y), weighted(x, y, 3))
    assert len(list(folder.glob("*.bin"))) == 2


CLASSES = """
from functools import cached_property
from typing import NamedTuple

class Rules(NamedTuple):
    least: float
    most: float

class Base:
    WEIGHT = 2.0

    @staticmethod
    def shifted(x):
        return x + 0.25

class Part(Base):
    inner: Rules

    @property
    def scaled(self):
        return self.x * 3.0

    @cached_property
    def kept(self):
        return self.x * 5.0

    @classmethod
    def made(cls, x):
        return x - 7.0

def closing(offset):
    def closed(x):
        return x + offset
    return closed

moved = closing(11.0)

def weighted(part: Part, *, power=2):
    return moved(part.scaled) ** power if power in {1, 2, 3} else part.kept
"""


@pytest.mark.parametrize(
    ("source", "old", "new", "same"),
    [
        (SOURCE, "FACTOR = 3.0", "FACTOR = 4.0", False),
        (SOURCE, "x * FACTOR", "x / FACTOR", False),
        (SOURCE, "** power", "** (power + 1)", False),
        (SOURCE, "def inner", "# a remark\n\ndef inner", True),
        (CLASSES, "self.x * 3.0", "self.x * 4.0", False),
        (CLASSES, "self.x * 5.0", "self.x * 6.0", False),
        (CLASSES, "x - 7.0", "x - 8.0", False),
        (CLASSES, "x + 0.25", "x + 0.5", False),
        (CLASSES, "WEIGHT = 2.0", "WEIGHT = 3.0", False),
        (CLASSES, "least: float\n    most: float", "most: float\n    least: float", False),
        (CLASSES, "closing(11.0)", "closing(12.0)", False),
        (CLASSES, "power=2", "power=3", False),
        (CLASSES, "class Part", "# a remark\nclass Part", True),
    ],
)
def test_code_is_that_of_all_that_a_function_computes_by(source: str, old: str, new: str, same: bool) -> None:
    """What it calls, properties, what is closed over, fields in their order."""
    assert old in source
    digests = [digest_of(module_of(text).weighted) for text in (source, source.replace(old, new))]
    assert (digests[0] == digests[1]) is same


def test_what_a_killed_linker_left_is_made_again(tmp_path: Path) -> None:
    """Whole libraries stay, and those that somebody is making."""
    from filelock import FileLock
    from torch._C import __file__ as whole

    libraries = {name: tmp_path / "ab" / f"{name}.main.so" for name in ("whole", "empty", "short", "header", "made")}
    content = Path(whole).read_bytes()
    (tmp_path / "ab").mkdir()
    ends = {"whole": len(content), "empty": 0, "short": len(content) // 2, "header": 40, "made": 1000}
    for name, library in libraries.items():
        library.write_bytes(content[: ends[name]])
    (tmp_path / "locks").mkdir()
    with FileLock(tmp_path / "locks" / "made.lock"):
        compile_cache.without_torn_libraries(tmp_path)
    assert {name for name, library in libraries.items() if library.exists()} == {"whole", "made"}


def test_what_cannot_be_compiled_any_more_is_told(folder: Path, tmp_path: Path) -> None:
    """A disk that is full by now, say: the compiler worked when it was tried."""
    full = tmp_path / "g++"
    says = "echo 'cannot write x.so: No space left on device' >&2; exit 1"
    full.write_text(f'#!/bin/sh\ncase "$*" in *.main.cpp*) {says};; esac\nexec {shutil.which("g++")} "$@"\n')
    full.chmod(0o755)
    never = module_of("def weighted(x, y):\n    return ((7.25 * x).exp() + y[:, :1]).sum(1)").weighted
    with (
        torch._inductor.config.patch({"cpp.cxx": (str(full),)}),
        pytest.raises(CompilerError, match=r"weighted cannot be compiled \(.*No space left.*\): .*rasterizer=eager"),
    ):
        compile_rows(never)(*rows(6))


def test_a_compiler_that_was_killed_is_asked_once_more(folder: Path, tmp_path: Path) -> None:
    """By a Ctrl-C, which all of a terminal's programs hear, or for want of memory. Torch would not ask again."""
    compiler, broken = tmp_path / "g++", tmp_path / "broken"
    compiler.write_text(
        f'#!/bin/sh\ncase "$*" in *.main.cpp*) [ -e {broken} ] && rm {broken} && kill -9 $$;; esac\n'
        f'exec {shutil.which("g++")} "$@"\n'
    )
    compiler.chmod(0o755)
    broken.touch()
    source = f"def weighted(x, y):\n    return x * 3.25 + {secrets.randbits(30)}.5 + y"  # nobody has compiled that
    fresh, (x, y) = module_of(source).weighted, rows(6)
    with torch._inductor.config.patch({"cpp.cxx": (str(compiler),)}):
        torch.testing.assert_close(compile_rows(fresh)(x, y), fresh(x, y))
    assert not broken.exists(), "it was not asked at all"


def test_code_of_sizes_that_torch_takes_for_others_lies_beside(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A window of 11 leaves one row of 11: torch makes code for such."""
    sizes = [(3, 40, 50), (3, 11, 50), (3, 30, 20), (3, 11, 11)]
    with made(monkeypatch) as names:
        for _ in range(2):
            compiled_correlate.cache_clear()
            for size in sizes:
                maps = torch.rand(size)
                torch.testing.assert_close(compiled_correlate(1)(maps), correlate(maps, 1))
    assert names == ["correlate", "correlate"]
    assert len(list(folder.glob("*.bin"))) == 2


@pytest.mark.parametrize("damage", [lambda content: content[:-10], lambda content: b"", lambda content: b"x" + content])
def test_damaged_code_is_made_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[bytes], bytes]
) -> None:
    compile_rows(weighted, 2)(*rows(6))
    (file,) = folder.glob("*.bin")
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    with made(monkeypatch) as names:
        assert agrees(compile_rows(weighted, 2), *rows(6))
    assert names == ["weighted"]
    assert len(file.read_bytes()) > len(whole) / 2


def test_what_cannot_be_kept_is_left_to_torch(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: KeptFunction, arguments: object) -> None:
        raise RuntimeError("another torch")

    monkeypatch.setattr(KeptFunction, "compile", broken)
    function = compile_rows(weighted, 2)
    assert agrees(function, *rows(6))
    assert agrees(function, *rows(11))
    assert not list(folder.glob("*.bin"))


def test_where_nothing_can_be_written_code_lasts_as_long_as_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr("gsx.engine.compile_cache.place", lambda: tmp_path / "file" / FOLDER)
    function = compile_rows(weighted, 2)
    with made(monkeypatch) as names:
        assert agrees(function, *rows(6))
        assert agrees(function, *rows(7))
    assert names == ["weighted"]


def test_calls_are_known_before_they_are_compiled(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    function = compile_rows(weighted, 2)
    x, y = (values.requires_grad_() for values in rows(6))
    with recorded() as calls, new_code() as names:
        function(x, y).sum().backward()
    assert (len(calls), names) == (1, [])
    assert lacking(calls)
    (file,) = [kept.file(arguments) for kept, arguments, _ in calls]
    with made_by_one(file), file.with_suffix(".lock").open():  # whoever else makes it
        make_ahead(calls)
    make_ahead(calls, stopping=lambda: True)
    assert lacking(calls)
    make_ahead(calls)
    assert not lacking(calls)
    with made(monkeypatch) as compiled:
        function(x, y).sum().backward()
    assert compiled == []


def test_waiting_for_another_process_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, got = tmp_path / "blend-0123.bin", list[bool]()

    def wait() -> None:
        with made_by_one(file, wait=True) as alone:
            got.append(alone)

    caplog.set_level("INFO", "gsx")
    thread = Thread(target=wait)
    with made_by_one(file) as alone:
        thread.start()
        deadline = time.monotonic() + 60
        while not caplog.messages and time.monotonic() < deadline:
            time.sleep(0.01)
        assert (alone, got) == (True, [])
    thread.join(60)
    assert (got, caplog.messages) == ([True], ["waiting for another process, which is making blend ..."])


def test_a_compiler_is_not_asked_for_where_calls_are_only_to_be_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsx.engine.compiling.complaint", lambda device: f"none for {device}")
    with recorded():
        assert available("nothing")
    assert not available("nothing")


def test_a_place_is_new_until_something_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    assert nothing_kept()
    (tmp_path / FOLDER).mkdir()
    (tmp_path / FOLDER / "blend-0.lock").touch()  # of a process that was stopped
    assert nothing_kept()
    (tmp_path / FOLDER / "blend-0.bin").touch()
    assert not nothing_kept()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")
    assert not nothing_kept()


def test_nobody_asks_where_views_begin_whose_symbols_are_not_checked(folder: Path) -> None:
    views = [tuple(tensor[1:] for tensor in rows(count)) for count in (7, 9)]
    for unchecked, asked in ((set(), True), ({"SHAPE_ENV"}, False)):
        kept = KeptFunction(with_last(weighted, 2), all_rows, {}, unchecked)
        code = kept.make(folder / f"{asked}.bin", views[0])
        assert ("call_storage_offset" in code.run.__code__.co_names) == asked
        for x, y in views:
            torch.testing.assert_close(code.run(x, y), weighted(x, y, 2))


def added(x: Tensor, parts: list[Tensor], out: Tensor, weight: float) -> None:
    """What is compiled here of functions that return nothing: arguments in another order than their code's."""
    out.copy_(parts[1] - weight * parts[0] + x[:, :1])


def all_rows(arguments: tuple[Any, ...]) -> list[tuple[Tensor, int]]:
    """The rows of all tensors vary."""
    return [(tensor, 0) for tensor in flat(arguments)]


def added_by(call: Callable[..., None], count: int) -> bool:
    """Whether `call` does what `added` does, with as many rows."""
    (x, first), (second, out) = rows(count), rows(count + 1)
    out = out[1:].clone()
    call(x, [first, second[1:]], out)
    torch.testing.assert_close(out, second[1:] - 2 * first + x[:, :1])
    return True


@contextmanager
def layers() -> Iterator[list[object]]:
    """An entry for each call meanwhile that goes through torch's layers around compiled code."""
    calls, through = list[object](), CompiledFxGraph.__call__
    with patch.object(CompiledFxGraph, "__call__", lambda self, inputs: calls.append(self) or through(self, inputs)):
        yield calls


def test_code_of_one_row_is_not_called_for_more(folder: Path) -> None:
    call = settled(compiled_once(with_last(added, 2.0), all_rows, {}, {"SHAPE_ENV"}, fullgraph=True))
    assert all(added_by(call, count) for count in (1, 5, 1, 3))


def test_settled_calls_go_to_the_code_itself(folder: Path) -> None:
    compiled = compiled_once(with_last(added, 2.0), all_rows, {}, {"SHAPE_ENV"}, fullgraph=True)
    assert added_by(compiled, 6)
    with layers() as calls:
        assert added_by(compiled, 4)
        assert len(calls) == 1
        call = settled(compiled)
        assert added_by(call, 5)
        assert len(calls) == 2  # to see where the code is, with copies
        assert all(added_by(call, count) for count in (9, 2, 40))
        assert added_by(settled(compiled), 7)
        assert len(calls) == 2


def test_where_the_code_is_not_found_calls_go_through_torch(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (x, y), watched = rows(6), compile_cache.watched
    arguments = (x, [y, y.clone()], torch.zeros_like(x))
    run = KeptFunction(with_last(added, 2.0), all_rows, {}, {"SHAPE_ENV"}).code_for(arguments).run
    assert without_layers(run, arguments) is not run
    for problem in ("another interface", "called twice", torch.zeros(()), 17):

        def otherwise(run: Callable[..., None], arguments: list[Any], problem: object = problem) -> object:
            calls, result = watched(run, arguments)
            if problem == "another interface":
                raise AttributeError(problem)
            if problem == "called twice":
                return 2 * calls, result
            calls[0][1].append(problem)  # something else is given
            return calls, result

        monkeypatch.setattr(compile_cache, "watched", otherwise)
        assert without_layers(run, arguments) is run


def test_what_returns_something_is_not_called_directly(folder: Path) -> None:
    kept = KeptFunction(with_last(weighted, 2), all_rows, {}, set())
    code = kept.code_for(rows(6))
    assert code.direct_for(rows(6)) is code.run


OTHER = """
import os, sys
from pathlib import Path
from threading import Thread
import torch
sys.path += [{tests!r}, {here!r}]
from compilations import new_code
from gsx.engine import compiling
compiling.available = lambda: True  # or this file, when it is imported, has something compiled to see whether it is
from test_compile_cache import rows, weighted
from gsx.engine.compiling import WHOLE_LOOPS, compile_rows
with new_code() as names:
    compile_rows(weighted, 2, options=WHOLE_LOOPS)(*rows(6))
print(names)
"""


def test_another_process_traces_nothing_and_compiles_nothing(tmp_path: Path) -> None:
    here = Path(__file__).parent
    code = OTHER.format(tests=str(here.parent), here=str(here))
    own = os.environ | {"TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}
    told, programs = [], []
    for _ in range(2):
        ended = subprocess.run([sys.executable, "-c", code], env=own, capture_output=True, text=True, check=True)
        told.append(ended.stdout.strip().splitlines()[-1])
        programs.append(sorted(tmp_path.rglob("*.so")))
    assert "of torch" in told[0]
    assert told[1] == "['weighted']"
    assert programs[0] == programs[1] != []
