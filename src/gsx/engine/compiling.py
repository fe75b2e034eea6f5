"""Whether anything can be compiled on this machine, and compiling for sizes that vary."""

import functools
import os
import types
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias, TypeVar

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.core.errors import CompilerError, first_line
from gsx.engine.compile_cache import KeptFunction, flat, record, recording

Result = TypeVar("Result")
Varying: TypeAlias = Callable[[tuple[Any, ...]], list[tuple[Tensor, int]]]
"""Sizes (tensor, axis) of arguments that may differ at the next call."""

OWN_INDICES: dict[str, Any] = {"assert_indirect_indexing": False}
"""Option of the compiler: indices are not checked, since all are computed here."""
CONTRACT = "cpp.enable_floating_point_contract_flag"
CONTRACTED: dict[str, Any] = {CONTRACT: "fast"}
"""Option of the compiler on a CPU: products and sums contract."""
ROWS_ALIKE: dict[str, Any] = {CONTRACT: "off"}
"""The same for functions of rows, which do not contract: the last rows, too few for a vector, have code of their own,
in which the C++ compiler contracts others, and no splat may depend on how many there are."""
IN_VECTORS: dict[str, Any] = {"cpp.enable_tiling_heuristics": False}
"""Option of the compiler: vectors also take rows whose numbers lie side by side; found by trying."""
WHOLE_LOOPS: dict[str, Any] = OWN_INDICES | {
    "max_fusion_size": 4096,
    "cpp.max_horizontal_fusion_size": 4096,
    "cpp.dynamic_threads": True,
}
"""Options of the compiler: an unrolled loop stays in one piece; indices are not checked."""


@functools.lru_cache
def complaint(device: str) -> str:
    """Says why nothing can be compiled for a device, by compiling a few operations; empty where it can be."""
    try:
        compile_rows(test_of_the_compiler)(torch.ones(32, device=device))
    except Exception as error:  # a missing compiler, a broken one, a read-only cache: all mean eager
        return reason_of(error.__cause__ or error)
    return ""


def reason_of(error: BaseException) -> str:
    """Says in one line why torch could not compile: the C++ compiler's words, or those of torch's backend."""
    parts = (str(error).partition(mark)[2].strip() for mark in ("Output:\n", "raised:\n"))
    return next(filter(None, parts), first_line(error)).splitlines()[0]


def test_of_the_compiler(x: Tensor) -> Tensor:
    """Computes something that needs a vector library, to try the compiler."""
    return 2 * x.exp() + x.log()


def available(device: str = "cpu") -> bool:
    """Checks whether torch.compile works on this machine; assumes so where calls are only recorded."""
    return recording() or not complaint(device)


def with_last(function: Callable[..., Any], *values: Any) -> Callable[..., Any]:
    """Copies `function` with values of its last arguments; torch counts compilations by code, so that is copied too."""
    code = function.__code__.replace()
    return types.FunctionType(code, function.__globals__, function.__name__, values or function.__defaults__)


def compile_rows(function: Callable[..., Any], *last: Any, options: dict[str, Any] | None = None) -> Callable[..., Any]:
    """Compiles `function` once for any number of rows, with these values of its last arguments.

    Tensors with as many rows, or columns, as the first argument has rows vary in number. Every other size is a constant
    of the code, which is faster and compiles sooner. There must be more than one row. `options`: of the compiler.
    """

    def varying(arguments: tuple[Any, ...]) -> list[tuple[Tensor, int]]:
        rows, tensors = len(arguments[0]), [a for a in arguments if isinstance(a, Tensor)]
        return [(a, axis) for a in tensors for axis in range(min(2, a.dim())) if a.shape[axis] == rows]

    return compiled_once(with_last(function, *last), varying, ROWS_ALIKE | (options or {}))


def compiled_once(
    function: Callable[..., Any],
    varying: Varying,
    options: dict[str, Any] | None = None,
    unchecked: Iterable[str] = (),
    fullgraph: bool = False,
) -> Callable[..., Any]:
    """Compiles `function` of tensors once, whatever the sizes are that vary.

    On a CPU its code is kept on disk (compile_cache.py); elsewhere torch traces it in each process.

    Args:
        options: of the compiler.
        unchecked: types of torch's conditions that need no check.
        fullgraph: whether torch raises what it would else leave to Python.
    """
    left_out, chosen = set(unchecked), CONTRACTED | (options or {})
    kept = KeptFunction(function, varying, chosen, left_out)
    if left_out:
        keep = {"guard_filter_fn": lambda guards: [guard.guard_type not in left_out for guard in guards]}
        chosen = chosen | keep

    @functools.cache
    def traced() -> Callable[..., Any]:  # torch's compiler takes a second to import
        return sizes_free(torch.compile(function, fullgraph=fullgraph, options=chosen), varying)

    def call(*arguments: Any) -> Any:
        if Parameter in map(type, arguments):  # torch always takes their sizes for constants
            arguments = tuple(a.view_as(a) if type(a) is Parameter else a for a in arguments)
        if flat(arguments[:1])[0].is_cpu:
            if record(kept, arguments):
                return function(*arguments)
            code = kept.code_for(arguments)
            if code is not None:
                return code.run(*arguments)
        return by_torch(traced, function.__name__, arguments)

    return call


def by_torch(traced: Callable[[], Callable[..., Any]], name: str, arguments: tuple[Any, ...]) -> Any:
    """Calls a function through torch.compile.

    Raises:
        CompilerError: it cannot be compiled, though others could.
    """
    try:
        return traced()(*arguments)
    except Exception as error:
        if not type(error).__module__.startswith(("torch._inductor", "torch._dynamo")):
            raise
        folder = os.environ.get("TORCHINDUCTOR_CACHE_DIR", "the folder for temporary files")
        raise CompilerError(
            f"{name} cannot be compiled ({reason_of(error)}): see to space and memory, also in {folder}, and go on, or "
            "give rasterizer=eager"
        ) from error


def sizes_free(compiled: Callable[..., Any], varying: Varying) -> Callable[..., Any]:
    """Marks the sizes that vary, at the first call with gradients of given arguments and at that without: torch
    compiles these apart."""
    marked: set[tuple[bool, ...]] = set()

    def call(*arguments: Any) -> Any:
        kind = (torch.is_grad_enabled(), *(a.requires_grad for a in arguments if isinstance(a, Tensor)))
        if kind not in marked:
            marked.add(kind)
            for tensor, axis in varying(arguments):
                torch._dynamo.maybe_mark_dynamic(tensor, axis)
        return compiled(*arguments)

    return call


@functools.lru_cache
def with_any_sizes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles `function` once for tensors of all sizes."""
    return torch.compile(function, dynamic=True)


def fused(function: Callable[..., Result]) -> Callable[..., Result]:
    """Compiles `function` of tensors into few kernels on a GPU, where launches cost; a CPU runs it as it stands."""

    @functools.wraps(function)
    def call(*arguments: Any) -> Result:
        device = arguments[0].device.type
        return (with_any_sizes(function) if device != "cpu" and available(device) else function)(*arguments)

    return call
