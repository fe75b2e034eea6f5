"""Whether anything can be compiled on this machine, and compiling for sizes that vary."""

import functools
import os
import types
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.core.errors import CompilerError, first_line
from gsx.engine.compile_cache import KeptFunction, flat, record, recording

Result = TypeVar("Result")
OWN_INDICES: dict[str, Any] = {"assert_indirect_indexing": False}
"""Of the compiler: what is looked up by number is looked up by numbers of ours, in lists that have them all."""
CONTRACT = "cpp.enable_floating_point_contract_flag"
CONTRACTED: dict[str, Any] = {CONTRACT: "fast"}
"""Of the compiler, on a CPU: products and sums contract."""
ROWS_ALIKE: dict[str, Any] = {CONTRACT: "off"}
"""The same of functions of rows, where they do not: the last rows, too few for a vector, have code of their own, in
which the C++ compiler contracts others, and what is computed of a splat may not depend on how many there are."""
IN_VECTORS: dict[str, Any] = {"cpp.enable_tiling_heuristics": False}
"""Of the compiler: rows whose numbers lie side by side are taken by vectors as well, which it else leaves to scalars
where many are read; found by trying."""
WHOLE_LOOPS: dict[str, Any] = OWN_INDICES | {
    "max_fusion_size": 4096,
    "cpp.max_horizontal_fusion_size": 4096,
    "cpp.dynamic_threads": True,
}
"""Of the compiler: an unrolled loop stays in one piece; indices are not checked."""


@functools.lru_cache
def complaint(device: str) -> str:
    """Why nothing can be compiled for this device; empty where it can. Asked by compiling a few operations,
    those of a vector library among them."""
    try:
        compile_rows(test_of_the_compiler)(torch.ones(32, device=device))
    except Exception as error:  # a missing compiler, a broken one, a read-only cache: all mean eager
        return reason_of(error.__cause__ or error)
    return ""


def reason_of(error: BaseException) -> str:
    """In one line why torch could not compile: what the C++ compiler says, or what torch's backend raised."""
    told = (str(error).partition(mark)[2].strip() for mark in ("Output:\n", "raised:\n"))
    return next(filter(None, told), first_line(error)).splitlines()[0]


def test_of_the_compiler(x: Tensor) -> Tensor:
    """What is compiled to see whether anything can be."""
    return 2 * x.exp() + x.log()


def available(device: str = "cpu") -> bool:
    """Whether torch.compile works on this machine; taken for granted where calls are only to be known."""
    return recording() or not complaint(device)


def with_last(function: Callable[..., Any], *values: Any) -> Callable[..., Any]:
    """`function` with these values of its last arguments, as code of its own: torch counts compilations by code."""
    code = function.__code__.replace()
    return types.FunctionType(code, function.__globals__, function.__name__, values or function.__defaults__)


def compile_rows(function: Callable[..., Any], *last: Any, options: dict[str, Any] | None = None) -> Callable[..., Any]:
    """`function` through torch.compile, once for any number of rows, with these values of its last arguments.

    Tensors with as many rows, or columns, as the first argument has rows are taken to vary in number; every other size
    is a constant of the compiled code, which is faster and compiles sooner than leaving all sizes open. There must be
    more than one row. `options`: of the compiler.
    """

    def varying(arguments: tuple[Any, ...]) -> list[tuple[Tensor, int]]:
        rows, tensors = len(arguments[0]), [a for a in arguments if isinstance(a, Tensor)]
        return [(a, axis) for a in tensors for axis in range(min(2, a.dim())) if a.shape[axis] == rows]

    return compiled_once(with_last(function, *last), varying, ROWS_ALIKE | (options or {}))


@functools.lru_cache
def with_any_sizes(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` through torch.compile, once for tensors of all sizes."""
    return torch.compile(function, dynamic=True)


def fused(function: Callable[..., Result]) -> Callable[..., Result]:
    """`function` of tensors; on a GPU, where launches cost, compiled into few kernels, on a CPU as it stands."""

    @functools.wraps(function)
    def call(*arguments: Any) -> Result:
        device = arguments[0].device.type
        return (with_any_sizes(function) if device != "cpu" and available(device) else function)(*arguments)

    return call


Varying: TypeAlias = Callable[[tuple[Any, ...]], list[tuple[Tensor, int]]]
"""Which sizes (tensor, axis) of given arguments may be others the next time."""


def compiled_once(
    function: Callable[..., Any],
    varying: Varying,
    options: dict[str, Any] | None = None,
    unchecked: Iterable[str] = (),
    fullgraph: bool = False,
) -> Callable[..., Any]:
    """`function` of tensors through torch.compile, once whatever the sizes are that vary.

    On a CPU its code is kept on disk (compile_cache.py), elsewhere torch traces it anew in each process. Parameters are
    handed on as tensors: whatever it is told, torch takes their own sizes for constants. `options`: of the compiler;
    `unchecked`: conditions of torch's, by type, that need not be checked; `fullgraph`: torch raises what it would else
    leave to Python.
    """
    left_out, given_options = set(unchecked), CONTRACTED | (options or {})
    kept = KeptFunction(function, varying, given_options, left_out)
    if left_out:
        keep = {"guard_filter_fn": lambda guards: [guard.guard_type not in left_out for guard in guards]}
        given_options = given_options | keep

    @functools.cache
    def traced() -> Callable[..., Any]:
        """What is not kept; torch's compiler takes a second to import."""
        return sizes_free(torch.compile(function, fullgraph=fullgraph, options=given_options), varying)

    return CompiledOnce(kept, traced)


@dataclass(frozen=True, eq=False)
class CompiledOnce:
    """A function whose code is looked up by what it is called with."""

    kept: KeptFunction
    traced: Callable[[], Callable[..., Any]]
    """The function through torch.compile, where its code cannot be kept."""

    def __call__(self, *given: Any) -> Any:
        arguments = given
        if Parameter in map(type, given):
            arguments = tuple(a.view_as(a) if type(a) is Parameter else a for a in given)
        return self.found(arguments)(*arguments)

    def found(self, arguments: tuple[Any, ...], directly: bool = False) -> Callable[..., Any]:
        """The code that holds for these arguments; `directly`: by `Code.direct_for`."""
        if not flat(arguments[:1])[0].is_cpu:
            return self.by_torch
        if record(self.kept, arguments):
            return self.kept.function
        code = self.kept.code_for(arguments)
        if code is None:
            return self.by_torch
        return code.direct_for(arguments) if directly else code.run

    def by_torch(self, *arguments: Any) -> Any:
        """The function through torch.compile.

        Raises:
            CompilerError: it cannot be compiled, though others could.
        """
        try:
            return self.traced()(*arguments)
        except Exception as error:
            if not type(error).__module__.startswith(("torch._inductor", "torch._dynamo")):
                raise
            folder = os.environ.get("TORCHINDUCTOR_CACHE_DIR", "the folder for temporary files")
            raise CompilerError(
                f"{self.kept.function.__name__} cannot be compiled ({reason_of(error)}): see to space and "
                f"memory, also in {folder}, and go on, or give rasterizer=eager"
            ) from error


def settled(function: Callable[..., None]) -> Callable[..., None]:
    """`function`, which must return nothing, for calls that differ in how many rows their arguments have and in nothing
    else: of a compiled one whose code is kept, that is looked up at the first call with more than one row, and called
    directly from then on. Parameters are none of its arguments."""
    if not isinstance(function, CompiledOnce):
        return function
    found = list[Callable[..., None]]()

    def call(*arguments: Any) -> None:
        if not found and len(flat(arguments)[0]) > 1:  # of one row torch makes code of its own, wrong for more
            found.append(function.found(arguments, directly=True))
        (found[0] if found else function)(*arguments)

    return call


def sizes_free(compiled: Callable[..., Any], varying: Varying) -> Callable[..., Any]:
    """Tells torch which sizes vary, so that one compilation serves all: at the first call with gradients of these
    arguments, and at that without, which torch compiles apart."""
    marked: set[tuple[bool, ...]] = set()

    def call(*arguments: Any) -> Any:
        kind = (torch.is_grad_enabled(), *(a.requires_grad for a in arguments if isinstance(a, Tensor)))
        if kind not in marked:
            marked.add(kind)
            for tensor, axis in varying(arguments):
                torch._dynamo.maybe_mark_dynamic(tensor, axis)
        return compiled(*arguments)

    return call
