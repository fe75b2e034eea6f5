"""Compiled functions on disk: what another process finds there, and what it must not take for code of its own."""

import importlib
import importlib.util
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
from typing import Any

import pytest
import torch
from compilations import new_code
from torch import Tensor

from gsx.core.errors import CompilerError
from gsx.core.quality.similarity import correlate
from gsx.engine.backend import COMPILED, compiled_kernel
from gsx.engine.cache import creation_lock
from gsx.engine.compile_cache import (
    FOLDER,
    CachedFunction,
    flat,
    make_ahead,
    recorded,
    sources_of,
    training_clock,
    uncached,
)
from gsx.engine.compiling import available, compile_rows, with_last

pytestmark = pytest.mark.skipif(not available(), reason="no working compiler on this machine")


def weighted(x: Tensor, y: Tensor, power: int) -> Tensor:
    """Computes what is compiled here."""
    return ((3.0 * x) ** power + y[:, :1]).sum(1)


def rows(count: int) -> tuple[Tensor, Tensor]:
    """Draws arguments of so many rows."""
    generator = torch.Generator().manual_seed(count)
    return tuple(torch.rand(count, 2, generator=generator, dtype=torch.float64) for _ in range(2))


def imported(folder: Path, source: str, changed: float = 0.0) -> types.ModuleType:
    """Imports a module of this source, whose file was changed so many seconds after 1970."""
    name = f"of_a_test_{secrets.token_hex(4)}"
    file = folder / f"{name}.py"
    file.write_text(source)
    os.utime(file, (changed, changed))
    spec = importlib.util.spec_from_file_location(name, file)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns where code is kept, empty at first; torch's own folder stays."""
    monkeypatch.setattr("gsx.engine.compile_cache.functions_folder", lambda: tmp_path / FOLDER)
    return tmp_path / FOLDER


@contextmanager
def made(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Lists the functions that are compiled meanwhile, not loaded."""
    names, make = list[str](), CachedFunction.make

    def noted(self: CachedFunction, *arguments: Any) -> Any:
        names.append(self.function.__name__)
        return make(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(CachedFunction, "make", noted)
        yield names


def agrees(function: Callable[..., Tensor], x: Tensor, y: Tensor) -> bool:
    """Compares compiled code with the function."""
    torch.testing.assert_close(function(x, y), weighted(x, y, 2))
    return True


def test_code_is_made_once_and_then_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lag = time.perf_counter() - training_clock()
    with made(monkeypatch) as names:
        first = compile_rows(weighted, 2)
        agrees(first, *rows(5))
        once = time.perf_counter() - training_clock()
        assert all(agrees(first, *rows(count)) for count in (9, 2, 400))
        assert names == ["weighted"]
        assert time.perf_counter() - training_clock() == pytest.approx(once, abs=1e-4), "known code is not waited for"
        assert once > lag + 1e-3
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
            assert agrees(function, *given)
            assert len(names) == number
        torch.set_default_dtype(torch.float64)  # of numbers that name none
        try:
            assert agrees(function, x, y)
        finally:
            torch.set_default_dtype(torch.float32)
        assert len(names) == number + 1
    torch.testing.assert_close(compile_rows(weighted, 3)(x, y), weighted(x, y, 3))


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
    with made(monkeypatch) as names:
        with torch.no_grad():
            assert agrees(compile_rows(weighted, 2), *rows(6))
        assert agrees(function := compile_rows(weighted, 2), *rows(7))
    assert names == ["weighted"]
    x, y = (values.requires_grad_() for values in rows(5))
    assert function(x, y).requires_grad


def test_code_of_other_source_options_or_machine_lies_elsewhere(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def file(function: Callable[..., Any] = weighted, power: int = 2, **options: Any) -> Path | None:
        return CachedFunction(with_last(function, power), all_rows, options, set()).file(rows(6))

    monkeypatch.setattr("gsx.engine.compile_cache.sources_of", lambda module: module)
    files = [file(), file(power=3), file(option=1), file(imported(folder.parent, SOURCE).weighted)]
    monkeypatch.setattr("gsx.engine.compile_cache.sources_of", lambda module: "edited")
    files.append(file())
    monkeypatch.setattr("gsx.engine.compile_cache.machine", lambda: "another compiler")
    files.append(file())
    monkeypatch.setattr("torch.get_num_threads", lambda: 17)
    files.append(file())
    assert None not in files
    assert len(set(files)) == len(files)


SOURCE = "def weighted(x, y, power):\n    return (x ** power + y).sum(1)\n"


def test_sources_are_those_of_core_engine_and_the_modules_own_package(tmp_path: Path) -> None:
    modules = ["gsx.core.rasterizer.boxes", "gsx.engine.kernels", "gsx.formats.suffixes"]
    core, engine, formats = (sources_of(importlib.import_module(name).__name__) for name in modules)
    assert core == engine is not None
    assert formats not in (None, core)
    names = [imported(tmp_path, source).__name__ for source in (SOURCE, SOURCE, SOURCE.replace("+", "-"))]
    digests = [sources_of(name) for name in names]
    assert digests[0] == digests[1] != digests[2]


def test_code_whose_source_may_be_other_than_its_file_is_not_kept(folder: Path) -> None:
    edited = imported(folder.parent, SOURCE, changed=time.time() + 60)
    assert sources_of(edited.__name__) is None
    assert sources_of("of_no_file") is None
    offset = 2.0
    closing = CachedFunction(lambda x, y: x + offset * y, all_rows, {}, set())
    assert closing.code_for(rows(6)) is None
    compile_rows(edited.weighted, 2)(*rows(6))
    assert not folder.exists()


def all_rows(arguments: tuple[Any, ...]) -> list[tuple[Tensor, int]]:
    """Lets the rows of all tensors vary."""
    return [(tensor, 0) for tensor in flat(arguments)]


def compiler(file: Path, fails: str) -> dict[str, Any]:
    """Returns torch's options for a compiler that runs these words for each library first."""
    file.write_text(f'#!/bin/sh\ncase "$*" in *.main.cpp*) {fails};; esac\nexec {shutil.which("g++")} "$@"\n')
    file.chmod(0o755)
    return {"cpp.cxx": (str(file),)}


def fresh(folder: Path) -> Callable[..., Tensor]:
    """Imports a function that nobody has compiled yet."""
    return imported(folder, f"def weighted(x, y):\n    return x * 3.25 + {secrets.randbits(30)}.5 + y").weighted


def test_what_cannot_be_compiled_any_more_is_told(folder: Path, tmp_path: Path) -> None:
    """A disk that is full by now, say: the compiler worked when it was tried."""
    full = compiler(tmp_path / "g++", "echo 'cannot write x.so: No space left on device' >&2; exit 1")
    with (
        torch._inductor.config.patch(full),
        pytest.raises(CompilerError, match=r"weighted cannot be compiled \(.*No space left.*\): .*rasterizer=eager"),
    ):
        compile_rows(fresh(tmp_path))(*rows(6))


def test_a_compiler_that_was_killed_is_asked_once_more(folder: Path, tmp_path: Path) -> None:
    """By a Ctrl-C, which all of a terminal's programs hear, or for want of memory. Torch would not ask again."""
    broken, function = tmp_path / "broken", fresh(tmp_path)
    broken.touch()
    with torch._inductor.config.patch(compiler(tmp_path / "g++", f"[ -e {broken} ] && rm {broken} && kill -9 $$")):
        torch.testing.assert_close(compile_rows(function)(*rows(6)), function(*rows(6)))
    assert not broken.exists(), "it was not asked at all"
    assert list(folder.glob("*.bin"))


def test_code_of_sizes_that_torch_takes_for_others_lies_beside(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A window of 11 leaves one row of 11: torch makes code for such."""
    sizes = [(3, 40, 50), (3, 11, 50), (3, 30, 20), (3, 11, 11)]
    with made(monkeypatch) as names:
        for _ in range(2):
            compiled_kernel.cache_clear()
            for size in sizes:
                maps = torch.rand(size)
                torch.testing.assert_close(COMPILED.kernel(correlate, 1)(maps), correlate(maps, 1))
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
    def broken(self: CachedFunction, arguments: object) -> None:
        raise RuntimeError("another torch")

    monkeypatch.setattr(CachedFunction, "compile", broken)
    function = compile_rows(weighted, 2)
    assert all(agrees(function, *rows(count)) for count in (6, 11))
    assert not list(folder.glob("*.bin"))


def test_where_nothing_can_be_written_code_lasts_as_long_as_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr("gsx.engine.compile_cache.functions_folder", lambda: tmp_path / "file" / FOLDER)
    function = compile_rows(weighted, 2)
    with made(monkeypatch) as names:
        assert all(agrees(function, *rows(count)) for count in (6, 7))
    assert names == ["weighted"]


def test_calls_are_known_before_they_are_compiled(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    function = compile_rows(weighted, 2)
    x, y = (values.requires_grad_() for values in rows(6))
    with recorded() as calls, new_code() as names:
        function(x, y).sum().backward()
    assert (len(calls), names) == (1, [])
    (file,) = [kept.file(arguments) for kept, arguments, _ in calls]
    with creation_lock(file):  # another process compiles it
        make_ahead(calls)
    make_ahead(calls, stopping=lambda: True)
    assert uncached(calls) == calls
    make_ahead(calls)
    assert not uncached(calls)
    with made(monkeypatch) as compiled:
        function(x, y).sum().backward()
    assert compiled == []


def test_a_compiler_is_not_asked_for_where_calls_are_only_to_be_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsx.engine.compiling.complaint", lambda device: f"none for {device}")
    with recorded():
        assert available("nothing")
    assert not available("nothing")


def test_nobody_asks_where_views_begin_whose_symbols_are_not_checked(folder: Path) -> None:
    views = [tuple(tensor[1:] for tensor in rows(count)) for count in (7, 9)]
    for unchecked, asked in ((set(), True), ({"SHAPE_ENV"}, False)):
        kept = CachedFunction(with_last(weighted, 2), all_rows, {}, unchecked)
        code = kept.make(folder / f"{asked}.bin", views[0])
        assert ("call_storage_offset" in code.run.__code__.co_names) == asked
        for x, y in views:
            torch.testing.assert_close(code.run(x, y), weighted(x, y, 2))


OTHER = """
import sys
import torch
sys.path += [{tests!r}, {here!r}]
from compilations import new_code
from gsx.engine import compiling
compiling.available = lambda: True  # or this file, when it is imported, has something compiled to see whether it is
from test_compile_cache import rows, weighted
from gsx.engine.compiling import WHOLE_LOOPS, compile_rows
with new_code() as names:
    print(float(compile_rows(weighted, 2, options=WHOLE_LOOPS)(*rows(6)).sum()))
print(names)
"""


def test_another_process_traces_nothing_and_compiles_nothing(tmp_path: Path) -> None:
    """Even where a killed linker left only half of a library, which torch takes for whole."""
    here = Path(__file__).parent
    code = OTHER.format(tests=str(here.parent), here=str(here))
    environment = os.environ | {"TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}

    def run() -> list[str]:
        ended = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        )
        return ended.stdout.strip().splitlines()[-2:]

    first, libraries = run(), sorted(tmp_path.rglob("*.so"))
    assert "of torch" in first[1]
    assert run() == [first[0], "['weighted']"]
    assert sorted(tmp_path.rglob("*.so")) == libraries != []
    for library in libraries:
        library.write_bytes(library.read_bytes()[:1000])
    for file in (tmp_path / FOLDER).glob("*.bin"):
        file.unlink()
    assert run()[0] == first[0]
    assert list((tmp_path / FOLDER).glob("*.bin")), "it is kept again"
