"""Direct calls compute what torch's calls compute, through code of several rows alone, and only where that is sure."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor
from torch._inductor.output_code import CompiledFxGraph

from gsx.engine import direct_calls
from gsx.engine.compile_cache import FOLDER
from gsx.engine.compiling import CompiledOnce, available, compiled_once, with_last
from gsx.engine.direct_calls import direct, without_layers

pytestmark = pytest.mark.skipif(not available(), reason="no working compiler on this machine")


def add(x: Tensor, others: list[Tensor], out: Tensor, factor: float) -> None:
    """Computes something that only writes into its arguments."""
    out.copy_(factor * x + others[0] - others[1])


def all_rows(arguments: tuple[Any, ...]) -> list[tuple[Tensor, int]]:
    """Lists the sizes that vary."""
    x, others, out = arguments
    return [(tensor, 0) for tensor in (x, *others, out)]


def arguments_of(count: int) -> tuple[Tensor, list[Tensor], Tensor]:
    """Draws arguments of so many rows."""
    generator = torch.Generator().manual_seed(count)
    x, y, z = torch.rand(3, count, 4, generator=generator)[:].unbind()
    return x, [y, z], torch.zeros_like(x)


def adds(call: Callable[..., None], count: int) -> bool:
    """Checks a call with so many rows against eager torch."""
    x, others, out = arguments_of(count)
    call(x, others, out)
    return torch.allclose(out, 2 * x + others[0] - others[1])


@pytest.fixture
def loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CompiledOnce:
    """Returns a compiled loop without conditions on its number of rows, as those over blocks."""
    monkeypatch.setattr("gsx.engine.compile_cache.functions_folder", lambda: tmp_path / FOLDER)
    return compiled_once(with_last(add, 2.0), all_rows, {}, {"SHAPE_ENV"}, fullgraph=True)


@contextmanager
def layers() -> Iterator[list[object]]:
    """Lists the calls meanwhile that go through torch's layers."""
    calls, through = list[object](), CompiledFxGraph.__call__
    with patch.object(CompiledFxGraph, "__call__", lambda self, inputs: calls.append(self) or through(self, inputs)):
        yield calls


def test_code_of_one_row_is_not_called_for_more(loop: CompiledOnce) -> None:
    call = direct(loop)
    assert all(adds(call, count) for count in (1, 5, 1, 3))


def test_later_calls_go_straight_to_the_code(loop: CompiledOnce) -> None:
    with layers() as calls:
        assert adds(loop, 4)
        assert len(calls) == 1
        call = direct(loop)
        assert adds(call, 5)
        assert len(calls) == 2  # the call with copies
        assert all(adds(call, count) for count in (9, 2, 40))
        assert adds(direct(loop), 7)
        assert len(calls) == 2


@pytest.mark.parametrize("problem", ["another interface", "called twice", torch.zeros(()), 17])
def test_other_code_is_called_through_torch(problem: object, loop: CompiledOnce, monkeypatch: Any) -> None:
    arguments, watch = arguments_of(6), direct_calls.watch
    code = loop.cached_code(arguments)
    assert code is not None
    assert without_layers(code.run, arguments) is not code.run

    def otherwise(run: Callable[..., None], arguments: list[Any]) -> object:
        calls, result = watch(run, arguments)
        if problem == "another interface":
            raise AttributeError(problem)
        if problem == "called twice":
            return 2 * calls, result
        calls[0][1].append(problem)  # another input
        return calls, result

    monkeypatch.setattr(direct_calls, "watch", otherwise)
    assert without_layers(code.run, arguments) is code.run


def test_functions_with_results_are_called_through_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsx.engine.compile_cache.functions_folder", lambda: tmp_path / FOLDER)
    compiled = compiled_once(with_last(double), lambda arguments: [(arguments[0], 0)])
    code = compiled.cached_code((torch.rand(6, 2),))
    assert code is not None
    assert without_layers(code.run, (torch.rand(6, 2),)) is code.run


def double(x: Tensor) -> Tensor:
    """Returns 2 x."""
    return 2 * x


def test_eager_functions_are_called_as_they_are() -> None:
    assert direct(print) is print
