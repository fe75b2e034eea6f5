"""Compiled functions that are kept on disk between processes, on a CPU.

torch keeps the code that it generates, but traces each function anew in every process: seconds for each unrolled loop.
Here `aot_compile` (experimental) keeps the whole function with its conditions; loading it takes milliseconds.
Whatever fails is left to torch.compile.
"""

import functools
import inspect
import io
import logging
import os
import platform
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

import gsx
from gsx.core.errors import first_line
from gsx.core.files import replacing
from gsx.engine.cache import content_key, file_stamp, made_by_one, source_digest, source_files
from gsx.engine.machine import processor_kind

logger = logging.getLogger(__name__)

FOLDER = "functions"
"""Below the folder in which torch keeps its code."""
VARIANTS = 8
"""Variants of one function for one kind of arguments: as many as torch makes before it gives up."""
CHECKED = ("TENSOR_MATCH", "DUPLICATE_INPUT", "SHAPE_ENV")
"""torch's conditions that are checked at a call: dtypes, strides, constant sizes, equal arguments, relations of sizes
that vary. Other values are part of the lookup, and the code that the function calls is part of the file's name."""
TRACING: dict[str, Any] = {"automatic_dynamic_shapes": False, "record_runtime_overhead": False}
"""How torch traces: without guesses from earlier compilations, and without marks for its profiler around each call."""
ROOMS = ("core/data", "core/gaussians", "core/quality", "core/rasterizer", "engine")
"""Packages of gsx that hold what its compiled functions call; import contracts keep them from the others."""
IMPORTED = time.time()
"""Files that are newer may differ from the code that this process runs."""
LIBRARY = re.compile(r"(/\S+\.so): ")
"""A library that cannot be loaded, in the system's message."""

Arguments: TypeAlias = tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Code:
    """Compiled code, and the check whether it holds for arguments by name."""

    holds: Callable[[dict[str, Any]], bool]
    run: Callable[..., Any]


def place() -> Path | None:
    """Returns where compiled functions are kept, beside torch's own code; None where no such folder is set."""
    folder = os.environ.get("TORCHINDUCTOR_CACHE_DIR")
    return Path(folder) / FOLDER if folder else None


# -- names -------------------------------------------------------------------------------------------------------------


@functools.cache
def sources_of(module: str) -> str | None:
    """Digests the source that functions of a module run: ROOMS of gsx, and the module's package elsewhere.

    None where the module is no file, or where a file was edited after this process imported it.
    """
    file = getattr(sys.modules.get(module), "__file__", None)
    if file is None:
        return None
    rooms = [Path(gsx.__file__).parent / room for room in ROOMS]
    places = rooms if any(Path(file).is_relative_to(room) for room in rooms) else [*rooms, package_of(Path(file))]
    edited = [path for path in source_files(*places) if path.stat().st_mtime > IMPORTED]
    if edited:
        logger.info("compiled code is not kept: %s was edited after this process began", edited[0])
        return None
    return source_digest(*places)


def package_of(file: Path) -> Path:
    """Returns the folder of the outermost package that holds a module; the file itself where there is none."""
    while (file.parent / "__init__.py").exists():
        file = file.parent
    return file


@functools.cache
def machine() -> tuple[object, ...]:
    """Lists what compiled code depends on beside its source; read once, since torch changes the environment."""
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
    """Describes an argument as far as compiled code depends on it; leaves out sizes that vary, (tensor, axis)."""
    if isinstance(value, list | tuple):
        return [form_of(one, varying) for one in value]
    if not isinstance(value, Tensor):
        return repr(value)
    sizes = [None if (id(value), axis) in varying else size for axis, size in enumerate(value.shape)]
    return str(value.dtype), value.requires_grad, sizes, value.is_contiguous(), value._is_view()


def modes(arguments: Arguments) -> tuple[object, ...]:
    """Lists what code depends on beside its arguments: gradients, threads, determinism, default dtype."""
    followed = torch.is_grad_enabled() and requires_gradient(arguments)
    deterministic = torch.are_deterministic_algorithms_enabled()
    return followed, torch.get_num_threads(), deterministic, torch.get_default_dtype()


def requires_gradient(value: Any) -> bool:
    """Checks whether a value is or holds a tensor that requires a gradient."""
    if isinstance(value, list | tuple):
        return any(map(requires_gradient, value))
    return isinstance(value, Tensor) and value.requires_grad


def kind_of(value: Any) -> object:
    """Describes an argument for the lookup; code itself checks sizes and formats of tensors."""
    if isinstance(value, Tensor):
        return value.requires_grad
    return tuple(map(kind_of, value)) if isinstance(value, list | tuple) else value


def flat(arguments: Iterable[Any]) -> list[Tensor]:
    """Lists arguments, and in place of lists their members."""
    tensors = list[Tensor]()
    for value in arguments:
        tensors += value if isinstance(value, list) else [value]
    return tensors


# -- files -------------------------------------------------------------------------------------------------------------


def load(file: Path, options: dict[str, Any]) -> Code | None:
    """Loads what `save` wrote; None where this torch can load nothing. Other `options` would compile its C++ anew."""
    from torch._inductor import config  # takes seconds to import

    try:
        content = file.read_bytes()
        with config.patch(options):
            return code_of(torch.compiler.load_compiled_function(io.BytesIO(content)))
    except FileNotFoundError:
        return None
    except Exception as error:  # unpickling a damaged file can raise anything
        logger.info("compiled code in %s cannot be loaded (%s): it is made again", file, first_line(error))
        return None


def save(compiled: Any, file: Path) -> None:
    """Keeps what torch compiled; where that fails, the next process compiles again."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            compiled.save_compiled_function(str(temporary))
    except Exception as error:  # a full disk, or something of this function that cannot be written
        logger.info("compiled code is not kept in %s: %s", file, first_line(error))


def code_of(compiled: Any) -> Code:
    """Takes code and conditions from what torch compiled or loaded."""
    return Code(compiled._artifacts.guard_manager.check, compiled.fn)


def forget_failure(error: Exception) -> None:
    """Lets torch compile again after a compiler was killed, now (Ctrl-C) or earlier, leaving part of a library."""
    from torch._inductor import codecache

    for name in ("CppCodeCache", "CppPythonBindingsCodeCache"):
        getattr(getattr(codecache, name, None), "cache", dict[str, object]()).clear()
    for library in LIBRARY.findall(str(error)):
        if library.startswith(os.environ.get("TORCHINDUCTOR_CACHE_DIR", "\0")):
            Path(library).unlink(missing_ok=True)


# -- functions ---------------------------------------------------------------------------------------------------------


class KeptFunction:
    """A function of tensors through torch.compile, whose code is kept in the folder `place()` between processes.

    `varying`: sizes (tensor, axis) of arguments that may differ at the next call; `unchecked`: those of CHECKED that
    need no check.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        varying: Callable[[Arguments], list[tuple[Tensor, int]]],
        options: dict[str, Any],
        unchecked: set[str],
    ) -> None:
        self.function, self.varying, self.options = function, varying, options
        self.names = list(inspect.signature(function).parameters)
        self.checked = [kind for kind in CHECKED if kind not in unchecked]
        self.works = True
        self.codes: dict[tuple[object, ...], list[Code]] = {}

    def code_for(self, arguments: Arguments) -> Code | None:
        """Returns code that holds for arguments; None where that is left to torch.compile."""
        kind = (*modes(arguments), *map(kind_of, arguments))
        codes, named = self.codes.setdefault(kind, []), self.named(arguments)
        for code in codes:
            if code.holds(named):
                return code
        file = self.file(arguments) if len(codes) < VARIANTS else None
        if file is None:
            return None
        try:
            with waiting(), made_by_one(file, wait=True):
                known, slot = self.find(file, arguments)
                if known is None:
                    logger.info("compiling %s once; later runs find it on disk ...", self.function.__name__)
                code = known or self.make(slot, arguments)
        except Exception as error:  # of an experimental interface; torch.compile reports what is really wrong
            logger.info("%s is compiled without being kept (%s)", self.function.__name__, first_line(error))
            self.works = False
            return None
        codes.append(code)
        return code

    def file(self, arguments: Arguments) -> Path | None:
        """Returns where code for such arguments is kept; None where none is."""
        folder, sources = place(), sources_of(self.function.__module__)
        if not (folder and sources and self.works) or self.function.__closure__:
            return None
        varying = {(id(tensor), axis) for tensor, axis in self.varying(arguments)}
        forms, function = [form_of(value, varying) for value in arguments], self.function
        how = repr(function.__defaults__), sorted(self.options.items()), self.checked, sorted(TRACING.items())
        about = function.__module__, function.__qualname__, sources, how, forms
        key = content_key(about, *modes(arguments), machine())
        return folder / f"{self.function.__name__}-{key}.bin"

    def find(self, file: Path, arguments: Arguments) -> tuple[Code | None, Path]:
        """Returns (code from the disk, if one holds; where to keep new code).

        torch makes code of its own for a few sizes, above all one row: it lies beside the first, by number.
        """
        for slot in (file, *(file.with_name(f"{file.stem}-{number}.bin") for number in range(1, VARIANTS))):
            code = load(slot, self.options)
            if code is None or code.holds(self.named(arguments)):
                return code, slot
        return None, file

    def make(self, file: Path, arguments: Arguments) -> Code:
        """Compiles code and keeps it.

        Raises:
            ValueError: it does not hold for these arguments.
        """
        try:
            compiled = self.compile(arguments)
        except Exception as error:
            forget_failure(error)
            compiled = self.compile(arguments)
        code = code_of(compiled)
        if not code.holds(self.named(arguments)):
            raise ValueError("its code does not hold for what it was made for")
        save(compiled, file)
        return code

    def named(self, arguments: Arguments) -> dict[str, Any]:
        """Returns arguments by name, without the last ones, which have default values."""
        return dict(zip(self.names, arguments, strict=False))

    def compile(self, arguments: Arguments) -> Any:
        """Has torch compile the function for such arguments."""
        options = self.options | {"guard_filter_fn": lambda guards: [g.guard_type in self.checked for g in guards]}
        arguments = tuple(map(without_gradient, arguments))
        if "SHAPE_ENV" not in self.checked:
            arguments = tuple(map(without_offset, arguments))
        for tensor, axis in self.varying(arguments):
            torch._dynamo.maybe_mark_dynamic(tensor, axis)
        compiled: Any = torch.compile(self.function, fullgraph=True, options=options)
        known = {name: value for name, value in TRACING.items() if hasattr(torch._dynamo.config, name)}
        with torch._dynamo.config.patch(known):
            return compiled.aot_compile((arguments, {}))


def without_gradient(value: Any) -> Any:
    """Returns a parameter without its gathered gradient, which code would depend on."""
    if not isinstance(value, Tensor) or not value.requires_grad:
        return value
    alone = value.detach().clone(memory_format=torch.preserve_format).requires_grad_()
    return alone.view_as(alone) if value._is_view() else alone


def without_offset(value: Any) -> Any:
    """Returns tensors as views from the start of their storage: else code reads the offset at every call."""
    if not isinstance(value, Tensor):
        return type(value)(map(without_offset, value)) if isinstance(value, list | tuple) else value
    whole = torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device=value.device)
    return whole.copy_(value.detach())[:].requires_grad_(value.requires_grad) if value.storage_offset() else value


# -- time --------------------------------------------------------------------------------------------------------------


class Waited(threading.local):
    """Seconds for which a thread has waited for compiled code."""

    seconds = 0.0


WAITED = Waited()


@contextmanager
def waiting() -> Iterator[None]:
    """Counts this time as waiting for compiled code."""
    start = time.perf_counter()
    try:
        yield
    finally:
        WAITED.seconds += time.perf_counter() - start


def training_clock() -> float:
    """Returns seconds of a clock that stands still while its thread waits for code to be compiled or read."""
    return time.perf_counter() - WAITED.seconds


# -- ahead -------------------------------------------------------------------------------------------------------------

Call: TypeAlias = tuple[KeptFunction, Arguments, bool]
"""A function, its arguments, and whether gradients were enabled."""
RECORDED: ContextVar[list[Call] | None] = ContextVar("RECORDED", default=None)
"""Calls so far; functions run uncompiled meanwhile. None: nothing is recorded."""


@contextmanager
def recorded() -> Iterator[list[Call]]:
    """Lists calls of functions that would be compiled; they run uncompiled meanwhile."""
    calls = list[Call]()
    token = RECORDED.set(calls)
    try:
        yield calls
    finally:
        RECORDED.reset(token)


def recording() -> bool:
    """Checks whether calls are recorded."""
    return RECORDED.get() is not None


def record(function: KeptFunction, arguments: Arguments) -> bool:
    """Records a call, if calls are recorded; returns whether they are."""
    calls = RECORDED.get()
    if calls is not None:
        calls.append((function, arguments, torch.is_grad_enabled()))
    return calls is not None


def file_of(function: KeptFunction, arguments: Arguments, gradients: bool) -> Path | None:
    """Returns where code for a call is kept; None where none is."""
    with torch.set_grad_enabled(gradients):
        return function.file(arguments)


def lacking(calls: Sequence[Call]) -> list[Call]:
    """Returns the calls whose code is not kept yet."""
    return [call for call in calls if (file := file_of(*call)) is None or not file.exists()]


def make_ahead(calls: Sequence[Call], stopping: Callable[[], bool] = lambda: False) -> None:
    """Compiles and keeps code for calls that lack it, until `stopping`; skips what another process compiles."""
    for function, arguments, gradients in calls:
        if stopping():
            return
        file = file_of(function, arguments, gradients)
        if file is None or file.exists():
            continue
        with made_by_one(file) as alone, torch.set_grad_enabled(gradients), suppress(Exception):  # its user reports it
            if alone and not file.exists():
                function.make(file, arguments)
