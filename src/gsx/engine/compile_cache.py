"""Compiled functions that are kept on disk between processes, on a CPU.

torch keeps what it has written and compiled, but traces a function anew in every process before it looks for that:
seconds for each loop that is unrolled. Here the whole is kept, with the conditions under which it holds, by
`aot_compile` (torch >= 2.10, experimental): to load it takes milliseconds. Whatever fails is left to torch.compile.
"""

import functools
import hashlib
import inspect
import io
import logging
import os
import platform
import shutil
import struct
import sys
import threading
import time
import types
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast

import torch
from torch import Tensor

from gsx.core.errors import first_line
from gsx.core.files import replacing
from gsx.engine.cache import content_key, file_stamp, made_by_one
from gsx.engine.machine import processor_kind

logger = logging.getLogger(__name__)

FOLDER = "functions"
"""Below the folder in which torch keeps its code."""
MOST = 8
"""Codes of one function for one kind of arguments: as many as torch makes before it gives up."""
CHECKED = ("TENSOR_MATCH", "DUPLICATE_INPUT", "SHAPE_ENV")
"""Types of torch's conditions that are checked at a call: dtypes, formats, constant sizes, arguments that are one, what
holds of sizes that vary. Other values are looked up, and what the function calls is in the name of the file."""


TRACING: dict[str, Any] = {"automatic_dynamic_shapes": False, "record_runtime_overhead": False}
"""How torch traces: whatever was compiled before, from which it would guess that more varies; and without marks for its
profiler around every call."""


@dataclass(eq=False)
class Code:
    """What torch made of a function: whether it is right for arguments by name, and the code."""

    holds: Callable[[dict[str, Any]], bool]
    run: Callable[..., Any]
    direct: Callable[..., None] | None = None
    """`run` without torch's layers, once it was asked for."""

    def direct_for(self, arguments: tuple[Any, ...]) -> Callable[..., None]:
        """`run` of a function that returns nothing, for arguments that are as these but for how many rows those have
        whose number varies: all equally many, here and then more than one."""
        if self.direct is None:
            self.direct = without_layers(self.run, arguments)
        return self.direct


def place() -> Path | None:
    """Where compiled functions are kept: beside torch's own code; None where nobody said where that is, or torch has
    not what is needed."""
    folder = folder_beside_torch()
    return folder if folder is not None and as_expected() else None


def folder_beside_torch() -> Path | None:
    """The folder beside torch's own code, whatever torch has; None where nobody said where that is."""
    own = os.environ.get("TORCHINDUCTOR_CACHE_DIR")
    return Path(own) / FOLDER if own else None


def nothing_kept() -> bool:
    """Whether there is a place, and no code of any function in it."""
    folder = folder_beside_torch()
    return folder is not None and not any(folder.glob("*.bin"))


@functools.cache
def as_expected() -> bool:
    """Whether torch has all that is used here of an interface that may change."""
    try:
        from torch._dynamo.aot_compile import AOTCompiledFunction, CompileArtifacts
    except ImportError:
        return False
    kept = hasattr(torch.compiler, "load_compiled_function") and hasattr(AOTCompiledFunction, "save_compiled_function")
    return kept and "guard_manager" in CompileArtifacts.__dataclass_fields__


# -- names -------------------------------------------------------------------------------------------------------------


PLAIN = (int, float, str, tuple, list, dict)
"""Constants of modules that functions read."""


def parts_of(value: Any, seen: set[int]) -> Iterator[object]:
    """What a function's results depend on beside its arguments: byte code, constants, and those of all that it calls
    in gsx; of classes what they hold."""
    value = inspect.unwrap(value) if callable(value) else value
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, types.FunctionType):
        yield from function_parts(value, seen)
    elif isinstance(value, type) and value.__module__.startswith("gsx."):
        yield from class_parts(value, seen)
    elif isinstance(value, PLAIN) and " at 0x" not in repr(value):
        yield repr(value)


def function_parts(function: types.FunctionType, seen: set[int]) -> Iterator[object]:
    """`parts_of` of byte code, of what is given or closed over, and of classes that arguments are of."""
    yield from code_parts(function.__code__, function.__globals__, seen)
    for given in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values(), *held_by(function)):
        if " at 0x" not in repr(given):
            yield repr(given)
        yield from parts_of(given, seen)
        yield from parts_of(type(given), seen)
    for kind in function.__annotations__.values():
        if isinstance(kind, type):
            yield from parts_of(kind, seen)


def held_by(function: types.FunctionType) -> Iterator[object]:
    """What a function closes over."""
    for cell in function.__closure__ or ():
        with suppress(ValueError):  # an empty one
            yield cell.cell_contents


def class_parts(kind: type, seen: set[int]) -> Iterator[object]:
    """`parts_of` of a class: its fields in their order, its functions and properties, its constants; and of the classes
    that it comes from, and that its fields are of."""
    fields = inspect.get_annotations(kind)
    yield list(fields)
    for other in (*kind.__bases__, *(field for field in fields.values() if isinstance(field, type))):
        yield from parts_of(other, seen)
    for name, member in vars(kind).items():
        own = function_of(member)
        if isinstance(own, types.FunctionType) or not name.startswith("__"):
            yield name
            yield from parts_of(own, seen)


def function_of(member: Any) -> Any:
    """What a property, a cached one, a class method or a static one calls; any other member as it is."""
    wrapped = (getattr(member, name, None) for name in ("fget", "func", "__func__"))
    return next((own for own in wrapped if own is not None), member)


def code_parts(code: types.CodeType, known: dict[str, Any], seen: set[int]) -> Iterator[object]:
    """`parts_of` of byte code, and of the functions within it."""
    yield code.co_code
    yield code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from code_parts(constant, known, seen)
        else:
            yield repr(sorted(constant, key=repr) if isinstance(constant, frozenset) else constant)
    for name in code.co_names:
        value = known.get(name)
        if (getattr(value, "__module__", None) or "gsx.").startswith("gsx."):
            yield from parts_of(value, seen)


def digest_of(function: Callable[..., Any]) -> str:
    """By which what is compiled of a function is told from what is compiled of another."""
    return content_key(*parts_of(function, set()))


@functools.cache
def machine() -> tuple[object, ...]:
    """What compiled code depends on beside what it is made from; asked once, since torch changes the environment."""
    settings = sorted(
        (name, value)
        for name, value in os.environ.items()
        if name.startswith(("TORCHINDUCTOR_", "TORCH_COMPILE")) and name != "TORCHINDUCTOR_CACHE_DIR"
    )
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    return (
        *(torch.__version__, platform.python_version(), torch.backends.cpu.get_cpu_capability()),
        processor_kind(),
        compiler and file_stamp(Path(compiler).resolve()),
        settings,
    )


def form_of(value: Any, varying: set[tuple[int, int]]) -> object:
    """An argument as far as compiled code depends on it; of sizes that vary, (which tensor, axis), not how large."""
    if isinstance(value, list | tuple):
        return [form_of(one, varying) for one in value]
    if not isinstance(value, Tensor):
        return repr(value)
    sizes = [None if (id(value), axis) in varying else size for axis, size in enumerate(value.shape)]
    return str(value.dtype), value.requires_grad, sizes, value.is_contiguous(), value._is_view()


# -- files -------------------------------------------------------------------------------------------------------------


def load(file: Path, options: dict[str, Any]) -> Any:
    """What was saved, as torch hands it out; None where there is nothing whole, or nothing that this torch can load.
    `options`: by which it was compiled. By others torch would compile its C++ anew."""
    from torch._inductor import config  # takes seconds to import

    try:
        content = file.read_bytes()
        digest, data = content[:32], content[32:]
        if hashlib.sha256(data).digest() != digest:
            logger.info("compiled code in %s is damaged: it is made again", file)
            return None
        with config.patch(options):
            return torch.compiler.load_compiled_function(io.BytesIO(data))
    except FileNotFoundError:
        return None
    except Exception as error:  # whatever unpickling says of another version's file
        logger.info("compiled code in %s cannot be loaded (%s): it is made again", file, first_line(error))
        return None


def save(made: Any, file: Path) -> None:
    """Keep what torch has made; where that cannot be, it is made again in the next process."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            made.save_compiled_function(str(temporary))
            data = temporary.read_bytes()
            temporary.write_bytes(hashlib.sha256(data).digest() + data)
    except Exception as error:  # a full disk, or something of this function that cannot be written
        logger.info("compiled code is not kept in %s: %s", file, first_line(error))


# -- what a compiler that was killed leaves ----------------------------------------------------------------------------


def is_torn(library: Path) -> bool:
    """Whether the end of a library is missing, where its table of sections lies (ELF-64); of other systems' libraries
    only whether there is anything."""
    with library.open("rb") as file:
        head, size = file.read(64), os.fstat(file.fileno()).st_size
    if not head.startswith(b"\x7fELF\x02") or len(head) < 64:
        return not head or head.startswith(b"\x7fELF")
    begin, (width, number) = int.from_bytes(head[40:48], sys.byteorder), struct.unpack("=2H", head[58:62])
    return begin == 0 or size < begin + width * number


@functools.cache
def without_torn_libraries(folder: Path) -> None:
    """Remove what a linker left that was killed: torch takes whatever is there for whole. Once in a process; what
    others are making is left to them, by the lock that torch has of it."""
    for library in folder.glob("*/*.so"):
        with suppress(OSError):
            if not is_torn(library):
                continue
            with made_by_one(folder / "locks" / library.name.partition(".")[0]) as alone:
                if alone and is_torn(library):
                    logger.info("%s is not whole: it is made again", library)
                    library.unlink()


# -- functions ---------------------------------------------------------------------------------------------------------


class KeptFunction:
    """A function of tensors through torch.compile, whose code is kept in the folder `place()` between processes.

    `varying`: which sizes (tensor, axis) of given arguments may be others the next time; `unchecked`: those of CHECKED
    that need not be.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        varying: Callable[[tuple[Any, ...]], list[tuple[Tensor, int]]],
        options: dict[str, Any],
        unchecked: set[str],
    ) -> None:
        self.function, self.varying, self.options = function, varying, options
        self.names = list(inspect.signature(function).parameters)
        self.checked = [kind for kind in CHECKED if kind not in unchecked]
        self.works = True
        self.codes: dict[tuple[object, ...], list[Code]] = {}

    @functools.cached_property
    def digest(self) -> str:
        """By which the function is known."""
        return digest_of(self.function)

    def code_for(self, arguments: tuple[Any, ...]) -> Code | None:
        """Code that holds for arguments; None where that is left to torch.compile."""
        kind = (*modes(arguments), *map(kind_of, arguments))
        codes, named = self.codes.setdefault(kind, []), self.named(arguments)
        for code in codes:
            if code.holds(named):
                return code
        file = self.file(arguments) if len(codes) < MOST else None
        if file is None:
            return None
        try:
            with counted(), made_by_one(file, wait=True):
                found, free = self.found(file, arguments)
                if found is None:
                    logger.info("compiling %s once; later runs find it on disk ...", self.function.__name__)
                code = found or self.make(free, arguments)
        except Exception as error:  # of an interface that may change: torch.compile says what is really wrong
            logger.info("%s is compiled without being kept (%s)", self.function.__name__, first_line(error))
            self.works = False
            return None
        codes.append(code)
        return code

    def file(self, arguments: tuple[Any, ...]) -> Path | None:
        """Where code for arguments such as these is kept; None where none is."""
        folder = place()
        if folder is None or not self.works:
            return None
        without_torn_libraries(folder.parent)
        return folder / f"{self.key(arguments)}.bin"

    def found(self, file: Path, arguments: tuple[Any, ...]) -> tuple[Code | None, Path]:
        """(code from the disk, if one holds; else None, and where to keep what will). For a few sizes, above all those
        of which one row is left, torch makes code of its own: it lies beside the first, by number."""
        for slot in (file, *(file.with_name(f"{file.stem}-{number}.bin") for number in range(1, MOST))):
            found = load(slot, self.options)
            if found is None:
                return None, slot
            if code_of(found).holds(self.named(arguments)):
                return code_of(found), slot
        return None, file

    def make(self, file: Path, arguments: tuple[Any, ...]) -> Code:
        """Code from the compiler, which is kept.

        Raises:
            ValueError: it does not hold for these arguments.
        """
        try:
            made = self.compile(arguments)
        except Exception:  # the C++ compiler may have been killed, or its folder removed: once more, then it is told
            forget_failures()
            made = self.compile(arguments)
        code = code_of(made)
        if not code.holds(self.named(arguments)):
            raise ValueError("its code does not hold for what it was made for")
        save(made, file)
        return code

    def named(self, arguments: tuple[Any, ...]) -> dict[str, Any]:
        """Arguments by name, but for the last ones, which have values."""
        return dict(zip(self.names, arguments, strict=False))

    def key(self, arguments: tuple[Any, ...]) -> str:
        """Name of the file of code for these arguments."""
        varying = {(id(tensor), axis) for tensor, axis in self.varying(arguments)}
        forms = [form_of(value, varying) for value in arguments]
        about = self.function.__name__, self.digest, sorted(self.options.items()), self.checked, sorted(TRACING.items())
        return f"{self.function.__name__}-{content_key(about, forms, *modes(arguments), machine())}"

    def compile(self, arguments: tuple[Any, ...]) -> Any:
        """What torch makes of the function for arguments such as these."""
        options = self.options | {"guard_filter_fn": lambda found: [self.checks(guard) for guard in found]}
        arguments = tuple(map(without_gradient, arguments))
        if "SHAPE_ENV" not in self.checked:
            arguments = tuple(map(from_the_start, arguments))
        for tensor, axis in self.varying(arguments):
            torch._dynamo.maybe_mark_dynamic(tensor, axis)
        compiled: Any = torch.compile(self.function, fullgraph=True, options=options)
        with torch._dynamo.config.patch(known_to_torch(TRACING)):
            return compiled.aot_compile((arguments, {}))

    def checks(self, guard: Any) -> bool:
        """Whether one of torch's conditions is checked at every call."""
        return guard.guard_type in self.checked


def forget_failures() -> None:
    """Torch remembers for the rest of a process which source did not compile; that of others is found on disk."""
    from torch._inductor import codecache

    for name in ("CppCodeCache", "CppPythonBindingsCodeCache"):
        getattr(getattr(codecache, name, None), "cache", dict[str, object]()).clear()


def known_to_torch(settings: dict[str, Any]) -> dict[str, Any]:
    """Those of dynamo's settings that this torch has."""
    return {name: value for name, value in settings.items() if hasattr(torch._dynamo.config, name)}


def modes(arguments: tuple[Any, ...]) -> tuple[object, ...]:
    """What code depends on beside what arguments are: whether gradients of one of them are followed, how many threads
    there are, whether torch is to be deterministic, and the format of numbers that name none."""
    followed = torch.is_grad_enabled() and learns(arguments)
    deterministic = torch.are_deterministic_algorithms_enabled()
    return followed, torch.get_num_threads(), deterministic, torch.get_default_dtype()


def learns(value: Any) -> bool:
    """Whether it is, or holds, a tensor that requires a gradient."""
    if isinstance(value, list | tuple):
        return any(map(learns, value))
    return isinstance(value, Tensor) and value.requires_grad


def kind_of(value: Any) -> object:
    """What of an argument is looked up; its code says itself which sizes and formats it is for."""
    if isinstance(value, Tensor):
        return value.requires_grad
    return tuple(map(kind_of, value)) if isinstance(value, list | tuple) else value


def without_gradient(value: Any) -> Any:
    """An argument that has gathered no gradient, which code would be told of; of the same strides if it has no gaps."""
    if not isinstance(value, Tensor) or not value.requires_grad:
        return value
    alone = value.detach().clone(memory_format=torch.preserve_format).requires_grad_()
    return alone.view_as(alone) if value._is_view() else alone


def from_the_start(value: Any) -> Any:
    """A tensor without gaps (or each of some) as a view that begins where its storage does: where one begins elsewhere,
    torch asks at every call where that is, and makes nothing of the answer."""
    if not isinstance(value, Tensor):
        return type(value)(map(from_the_start, value)) if isinstance(value, list | tuple) else value
    whole = torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device=value.device)
    return whole.copy_(value.detach())[:].requires_grad_(value.requires_grad) if value.storage_offset() else value


def code_of(made: Any) -> Code:
    """Code and conditions of what torch has made or loaded."""
    return Code(made._artifacts.guard_manager.check, made.fn)


# -- torch's layers ----------------------------------------------------------------------------------------------------

WATCHING = threading.Lock()
"""Held by who watches: one at a time. Other threads go on calling compiled code."""


def flat(arguments: Iterable[Any]) -> list[Tensor]:
    """Arguments, and in place of lists what is in them."""
    found = list[Tensor]()
    for value in arguments:
        found += value if isinstance(value, list) else [value]
    return found


def without_layers(run: Callable[..., Any], arguments: tuple[Any, ...]) -> Callable[..., None]:
    """`run` of a function that returns nothing, straight to the code that was written for it: what torch does before
    and after, for the sake of what such functions have not, takes longer than a call of little work.

    Where that code is, and in which order it wants its tensors and their number of rows, is seen at a call with copies.
    Where that is not as expected, `run` as it is.
    """
    copies = [[v.clone() for v in value] if isinstance(value, list) else value.clone() for value in arguments]
    tensors = flat(copies)
    try:
        calls, result = watched(run, copies)
    except Exception:  # of an interface that may change; whatever else it is, the next call tells
        return run
    if result is not None or len(calls) != 1:
        return run
    code, inputs = calls[0]
    number = {id(tensor): n for n, tensor in enumerate(tensors)}
    order = [number.get(id(value)) for value in inputs]
    others = [value for n, value in zip(order, inputs, strict=True) if n is None]
    if any(isinstance(value, Tensor) or value != len(tensors[0]) for value in others):
        return run

    def call(*given: Any) -> None:
        values = flat(given)
        code([len(values[0]) if n is None else values[n] for n in order])

    return call


Met: TypeAlias = tuple[Callable[[list[Any]], Any], list[Any]]
"""Code that was called, and what it was given."""


def watched(run: Callable[..., Any], arguments: Sequence[Any]) -> tuple[list[Met], Any]:
    """(the code that a call comes to in this thread, and what it returns)."""
    from torch._inductor import output_code

    calls, graphs, own = list[Met](), cast(Any, output_code.CompiledFxGraph), threading.get_ident()
    with WATCHING:
        through = graphs.__call__

        def noted(graph: Any, inputs: list[Any]) -> Any:
            if threading.get_ident() == own:
                calls.append((graph.current_callable, list(inputs)))
            return through(graph, inputs)

        try:
            graphs.__call__ = noted
            return calls, run(*arguments)
        finally:
            graphs.__call__ = through


# -- time ------------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Waited:
    """For code, in seconds."""

    seconds: float = 0.0


WAITED: ContextVar[Waited | None] = ContextVar("WAITED", default=None)
"""Where waiting for code is counted; None where nobody wants to know."""


@contextmanager
def waiting_counted() -> Iterator[Waited]:
    """How long is waited in this thread for code that is compiled, or read: once in a process, or on a machine."""
    waited = Waited()
    token = WAITED.set(waited)
    try:
        yield waited
    finally:
        WAITED.reset(token)


@contextmanager
def counted() -> Iterator[None]:
    """Counts as waiting for code."""
    begun, waited = time.perf_counter(), WAITED.get()
    try:
        yield
    finally:
        if waited is not None:
            waited.seconds += time.perf_counter() - begun


# -- ahead -------------------------------------------------------------------------------------------------------------

Call: TypeAlias = tuple[KeptFunction, tuple[Any, ...], bool]
"""A function, what it was called with, and whether gradients were wanted."""
RECORDED: ContextVar[list[Call] | None] = ContextVar("RECORDED", default=None)
"""Calls that are only to be known; functions run as they stand meanwhile."""


@contextmanager
def recorded() -> Iterator[list[Call]]:
    """Calls of functions that would be compiled; they run as they stand meanwhile."""
    calls = list[Call]()
    token = RECORDED.set(calls)
    try:
        yield calls
    finally:
        RECORDED.reset(token)


def recording() -> bool:
    """Whether calls are only to be known."""
    return RECORDED.get() is not None


def record(function: KeptFunction, arguments: tuple[Any, ...]) -> bool:
    """Whether calls are only to be known; this one is then."""
    calls = RECORDED.get()
    if calls is not None:
        calls.append((function, arguments, torch.is_grad_enabled()))
    return calls is not None


def file_of(call: Call) -> Path | None:
    """Where code for a call is kept; None where none is."""
    function, arguments, gradients = call
    with torch.set_grad_enabled(gradients):
        return function.file(arguments)


def make_ahead(calls: Sequence[Call], stopping: Callable[[], bool] = lambda: False) -> None:
    """Have code for these calls made and kept, where it is not, until `stopping`; what others are making is left to
    them."""
    for call in calls:
        if stopping():
            return
        file, (function, arguments, gradients) = file_of(call), call
        if file is None or file.exists():
            continue
        with made_by_one(file) as alone, torch.set_grad_enabled(gradients), suppress(Exception):  # its user hears of it
            if alone and not file.exists():
                function.make(file, arguments)


def lacking(calls: Sequence[Call]) -> bool:
    """Whether code for one of these calls is not kept yet."""
    return any(file is None or not file.exists() for file in map(file_of, calls))
