"""torch.compile for sizes that vary, and a test of the compiler on this machine."""

import functools
import os
import types
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias, TypeVar

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.core.errors import CompilerError, first_line
from gsx.engine.compile_cache import CachedFunction, Code, flat, record, recording

Result = TypeVar("Result")
Varying: TypeAlias = Callable[[tuple[Any, ...]], list[tuple[Tensor, int]]]
"""Lists sizes (tensor, axis) of arguments that may differ at the next call."""

OWN_INDICES: dict[str, Any] = {"assert_indirect_indexing": False}
"""Compiler option: no checks of indices, since all are computed here."""
CONTRACT = "cpp.enable_floating_point_contract_flag"
CONTRACTED: dict[str, Any] = {CONTRACT: "fast"}
"""Compiler option on a CPU: products and sums contract."""
ROWS_ALIKE: dict[str, Any] = {CONTRACT: "off"}
"""The same for functions of rows, which do not contract: the last rows, too few for a vector, have separate code, in
which the C++ compiler contracts others, and no splat may depend on the number of splats."""
IN_VECTORS: dict[str, Any] = {"cpp.enable_tiling_heuristics": False}
"""Compiler option: vectors also of rows whose numbers are contiguous; measured to be faster."""
WHOLE_LOOPS: dict[str, Any] = OWN_INDICES | {
    "max_fusion_size": 4096,
    "cpp.max_horizontal_fusion_size": 4096,
    "cpp.dynamic_threads": True,
}
"""Compiler options: an unrolled loop stays in one piece; no checks of indices."""


@functools.lru_cache
def complaint(device: str) -> str:
    """Compiles a few operations for a device; returns why that fails, or an empty text."""
    try:
        compile_rows(test_kernel)(torch.ones(32, device=device))
    except Exception as error:  # a missing compiler, a broken one, a read-only cache: all mean eager
        return reason_of(error.__cause__ or error)
    return ""


def reason_of(error: BaseException) -> str:
    """Extracts one line of why torch could not compile: the C++ compiler's message, or that of torch's backend."""
    parts = (str(error).partition(mark)[2].strip() for mark in ("Output:\n", "raised:\n"))
    return next(filter(None, parts), first_line(error)).splitlines()[0]


def test_kernel(x: Tensor) -> Tensor:
    """Computes something that needs a vector library, to try the compiler."""
    return 2 * x.exp() + x.log()


def available(device: str = "cpu") -> bool:
    """Checks that torch.compile works on this machine; True where calls are only recorded."""
    return recording() or not complaint(device)


def with_last(function: Callable[..., Any], *values: Any) -> Callable[..., Any]:
    """Copies `function` with values of its last arguments; torch counts compilations by code, so that is copied too."""
    code = function.__code__.replace()
    return types.FunctionType(code, function.__globals__, function.__name__, values or function.__defaults__)


def compile_rows(function: Callable[..., Any], *last: Any, options: dict[str, Any] | None = None) -> Callable[..., Any]:
    """Compiles `function` once for any number of rows, with these values of its last arguments.

    Rows, or columns, vary where they are as many as the first argument's rows, more than one. All other sizes are
    constants of the code, which is faster and compiles sooner. `options`: of the compiler.
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
) -> "CompiledOnce":
    """Compiles `function` of tensors once, for all values of the sizes that vary.

    On a CPU its code is cached on disk (compile_cache.py); elsewhere torch traces it in each process.

    Args:
        options: of the compiler.
        unchecked: types of torch's conditions to skip.
        fullgraph: raise where torch would fall back to Python.
    """
    skipped, chosen = set(unchecked), CONTRACTED | (options or {})
    cached = CachedFunction(function, varying, chosen, skipped)
    if skipped:
        chosen = chosen | {"guard_filter_fn": lambda guards: [guard.guard_type not in skipped for guard in guards]}

    @functools.cache
    def traced() -> Callable[..., Any]:  # torch's compiler takes a second to import
        return sizes_free(torch.compile(function, fullgraph=fullgraph, options=chosen), varying)

    return CompiledOnce(cached, traced)


class CompiledOnce:
    """A function of tensors whose code is looked up at each call."""

    def __init__(self, cached: CachedFunction, traced: Callable[[], Callable[..., Any]]) -> None:
        self.cached, self.traced = cached, traced
        self.direct: dict[Code, Callable[..., None]] = {}
        """Calls without torch's layers (direct_calls.py)."""

    def __call__(self, *arguments: Any) -> Any:
        if Parameter in map(type, arguments):  # torch always takes their sizes for constants
            arguments = tuple(a.view_as(a) if type(a) is Parameter else a for a in arguments)
        if on_cpu(arguments) and record(self.cached, arguments):
            return self.cached.function(*arguments)
        code = self.cached_code(arguments)
        if code is not None:
            return code.run(*arguments)
        return by_torch(self.traced, self.cached.function.__name__, arguments)

    def cached_code(self, arguments: tuple[Any, ...]) -> Code | None:
        """Returns code that holds for arguments; None: calls are recorded, or torch compiles in each process."""
        return self.cached.code_for(arguments) if on_cpu(arguments) and not recording() else None


def on_cpu(arguments: tuple[Any, ...]) -> bool:
    """Checks whether the first argument is on the CPU."""
    return flat(arguments[:1])[0].is_cpu


def by_torch(traced: Callable[[], Callable[..., Any]], name: str, arguments: tuple[Any, ...]) -> Any:
    """Calls a function through torch.compile.

    Raises:
        CompilerError: it cannot be compiled.
    """
    try:
        return traced()(*arguments)
    except Exception as error:
        if not type(error).__module__.startswith(("torch._inductor", "torch._dynamo")):
            raise
        folder = os.environ.get("TORCHINDUCTOR_CACHE_DIR", "the folder for temporary files")
        raise CompilerError(
            f"{name} cannot be compiled ({reason_of(error)}): free memory, and space in {folder}, or set "
            "rasterizer=eager"
        ) from error


def sizes_free(compiled: Callable[..., Any], varying: Varying) -> Callable[..., Any]:
    """Marks the sizes that vary at the first call of each set of arguments with gradients: torch compiles each set."""
    marked: set[tuple[bool, ...]] = set()

    def call(*arguments: Any) -> Any:
        kind = (torch.is_grad_enabled(), *(a.requires_grad for a in arguments if isinstance(a, Tensor)))
        if kind not in marked:
            marked.add(kind)
            for tensor, axis in varying(arguments):
                torch._dynamo.maybe_mark_dynamic(tensor, axis)
        return compiled(*arguments)

    return call


def fused(function: Callable[..., Result]) -> Callable[..., Result]:
    """Compiles `function` of tensors of any size into few kernels on a GPU; a CPU runs it uncompiled."""
    compiled = functools.cache(lambda: torch.compile(function, dynamic=True))  # importing the compiler takes a second

    @functools.wraps(function)
    def call(*arguments: Any) -> Result:
        device = arguments[0].device.type
        return (compiled() if device != "cpu" and available(device) else function)(*arguments)

    return call
