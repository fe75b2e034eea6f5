"""Whether anything can be compiled on this machine, and compiling for sizes that vary."""

import functools
import types
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.nn import Parameter

Result = TypeVar("Result")
WHOLE_LOOPS: dict[str, str | int | bool] = {
    "max_fusion_size": 4096,
    "cpp.max_horizontal_fusion_size": 4096,
    "cpp.enable_floating_point_contract_flag": "fast",
    "cpp.dynamic_threads": True,
}
"""Of the compiler: an unrolled loop stays in one piece, and products and sums contract."""


@functools.lru_cache
def complaint(device: str) -> str:
    """Why nothing can be compiled for this device; empty where it can. Asked by compiling a few operations,
    those of a vector library among them."""
    try:
        torch.compile(lambda x: 2 * x.exp() + x.log(), fullgraph=True)(torch.ones(32, device=device))
    except Exception as error:  # a missing compiler, a broken one, a read-only cache: all mean eager
        return (str(error).strip().splitlines() or [type(error).__name__])[0]
    return ""


def available(device: str = "cpu") -> bool:
    """Whether torch.compile works on this machine."""
    return not complaint(device)


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

    return sizes_free(torch.compile(with_last(function, *last), options=options), varying)


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


def sizes_free(
    compiled: Callable[..., Any], varying: Callable[[tuple[Any, ...]], Iterable[tuple[Tensor, int]]]
) -> Callable[..., Any]:
    """Tells torch which sizes (tensor, axis) vary, so that one compilation serves all: at the first call with gradients
    of these arguments, and at that without, which torch compiles apart. Parameters are handed on as tensors: whatever
    it is told, torch takes their own sizes for constants."""
    marked: set[tuple[bool, ...]] = set()

    def call(*given: Any) -> Any:
        arguments = tuple(a.view_as(a) if type(a) is Parameter else a for a in given)
        kind = (torch.is_grad_enabled(), *(a.requires_grad for a in arguments if isinstance(a, Tensor)))
        if kind not in marked:
            marked.add(kind)
            for tensor, axis in varying(arguments):
                torch._dynamo.maybe_mark_dynamic(tensor, axis)
        return compiled(*arguments)

    return call
