"""Direct calls of compiled loops, without torch's layers: those take longer than a loop over few blocks."""

import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, cast

from torch import Tensor

from gsx.engine.compile_cache import flat
from gsx.engine.compiling import CompiledOnce

WATCHING = threading.Lock()
"""Held by the thread that watches a call; others keep calling compiled code."""
Watched: TypeAlias = tuple[Callable[[list[Any]], Any], list[Any]]
"""Generated code and its inputs."""


def direct(loop: Callable[..., None]) -> Callable[..., None]:
    """Returns `loop`, which returns nothing, for calls that differ only in the number of rows of their arguments.

    The first call of more than one row looks its code up; later ones go straight to the code. Functions that are not
    compiled, or whose code is not cached, are called as they are.
    """
    if not isinstance(loop, CompiledOnce):
        return loop
    known = list[Callable[..., None]]()

    def call(*arguments: Any) -> None:
        if not known and len(flat(arguments[:1])[0]) > 1:  # torch specialises code on one row
            known.append(direct_code(loop, arguments))
        (known[0] if known else loop)(*arguments)

    return call


def direct_code(loop: CompiledOnce, arguments: tuple[Any, ...]) -> Callable[..., None]:
    """Returns the code that holds for arguments, without torch's layers; `loop` itself if none is cached."""
    code = loop.cached_code(arguments)
    if code is None:
        return loop
    if code not in loop.direct:
        loop.direct[code] = without_layers(code.run, arguments)
    return loop.direct[code]


def without_layers(run: Callable[..., Any], arguments: tuple[Any, ...]) -> Callable[..., None]:
    """Returns the generated code behind `run`; `run` itself if torch does more than to call it once.

    A call with copies shows the code, and the order of its inputs: tensors, and the number of rows.
    """
    copies = [[one.clone() for one in value] if isinstance(value, list) else value.clone() for value in arguments]
    tensors = flat(copies)
    try:
        calls, result = watch(run, copies)
    except Exception:  # of an interface that may change; the next call reports any other cause
        return run
    if result is not None or len(calls) != 1:
        return run
    code, inputs = calls[0]
    number = {id(tensor): n for n, tensor in enumerate(tensors)}
    order = [number.get(id(value)) for value in inputs]
    others = [value for n, value in zip(order, inputs, strict=True) if n is None]
    if any(isinstance(value, Tensor) or value != len(tensors[0]) for value in others):
        return run

    def call(*arguments: Any) -> None:
        values = flat(arguments)
        code([len(values[0]) if n is None else values[n] for n in order])

    return call


def watch(run: Callable[..., Any], arguments: Sequence[Any]) -> tuple[list[Watched], Any]:
    """Calls `run`; returns the generated code that this thread reaches, with its inputs, and the result."""
    from torch._inductor import output_code  # takes seconds to import

    calls, graphs, thread = list[Watched](), cast(Any, output_code.CompiledFxGraph), threading.get_ident()
    with WATCHING:
        through = graphs.__call__

        def noted(graph: Any, inputs: list[Any]) -> Any:
            if threading.get_ident() == thread:
                calls.append((graph.current_callable, list(inputs)))
            return through(graph, inputs)

        try:
            graphs.__call__ = noted
            return calls, run(*arguments)
        finally:
            graphs.__call__ = through
