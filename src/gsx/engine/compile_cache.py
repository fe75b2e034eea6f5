"""Compiled functions, cached on disk between processes, on a CPU.

torch caches the code that it generates, but traces each function anew in every process: seconds for each unrolled loop.
Here `aot_compile` (experimental) saves the whole function with its conditions; loading it takes milliseconds. Any
failure falls back to torch.compile.
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
from gsx.engine.cache import content_key, creation_lock, file_stamp, source_digest, source_files
from gsx.engine.half_libraries import remove_half_libraries
from gsx.engine.machine import processor_kind

logger = logging.getLogger(__name__)

FOLDER = "functions"
"""Folder below that of torch's code."""
VARIANTS = 8
"""Most variants of one function for one kind of arguments: torch's limit."""
CHECKED = ("TENSOR_MATCH", "DUPLICATE_INPUT", "SHAPE_ENV")
"""torch's conditions that a call checks: dtypes, strides, constant sizes, equal arguments, relations of varying sizes.
Other values are part of the lookup, and the code that the function calls is part of the file's name."""
TRACING: dict[str, Any] = {"automatic_dynamic_shapes": False, "record_runtime_overhead": False}
"""Options of tracing: no guesses from earlier compilations, and no profiler marks around each call."""
ROOMS = ("core/data", "core/gaussians", "core/quality", "core/rasterizer", "engine", "lenses")
"""Packages of gsx whose code its compiled functions call; import contracts keep them from the others."""
IMPORTED = time.time()
"""Newer files may differ from the code that this process runs."""
LIBRARY = re.compile(r"(/\S+\.so): ")
"""Path of a library that cannot be loaded, in the system's message."""

Arguments: TypeAlias = tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Code:
    """Compiled code, and a check that it holds for arguments by name."""

    holds: Callable[[dict[str, Any]], bool]
    run: Callable[..., Any]


def functions_folder() -> Path | None:
    """Returns the folder of compiled functions, next to torch's own code; None where no such folder is set."""
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
        logger.info("compiled code is not cached: %s was edited after this process started", edited[0])
        return None
    return source_digest(*places)


def package_of(file: Path) -> Path:
    """Returns the folder of the outermost package of a module, or the file itself."""
    while (file.parent / "__init__.py").exists():
        file = file.parent
    return file


@functools.cache
def machine() -> tuple[object, ...]:
    """Lists versions, processor and settings that compiled code depends on; once: torch edits the environment."""
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
    """Describes an argument as far as compiled code depends on it, without `varying` sizes, (tensor, axis)."""
    if isinstance(value, list | tuple):
        return [form_of(one, varying) for one in value]
    if not isinstance(value, Tensor):
        return repr(value)
    sizes = [None if (id(value), axis) in varying else size for axis, size in enumerate(value.shape)]
    return str(value.dtype), value.requires_grad, sizes, value.is_contiguous(), value._is_view()


def modes(arguments: Arguments) -> tuple[object, ...]:
    """Lists the modes that code depends on: gradients, threads, determinism, default dtype."""
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
    """Lists arguments; members in place of lists."""
    tensors = list[Tensor]()
    for value in arguments:
        tensors += value if isinstance(value, list) else [value]
    return tensors


# -- files -------------------------------------------------------------------------------------------------------------


def load(file: Path, options: dict[str, Any]) -> Code | None:
    """Loads a file of `save`; None if this torch cannot. Other `options` would compile its C++ anew."""
    from torch._inductor import config  # takes seconds to import

    try:
        content = file.read_bytes()
        with config.patch(options):
            return code_of(torch.compiler.load_compiled_function(io.BytesIO(content)))
    except FileNotFoundError:
        return None
    except Exception as error:  # unpickling a damaged file can raise anything
        logger.info("compiled code in %s cannot be loaded (%s), compiling again", file, first_line(error))
        return None


def save(compiled: Any, file: Path) -> None:
    """Saves compiled code; if that fails, the next process compiles again."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            compiled.save_compiled_function(str(temporary))
    except Exception as error:  # a full disk, or something of this function that cannot be written
        logger.info("compiled code is not cached in %s: %s", file, first_line(error))


def code_of(compiled: Any) -> Code:
    """Extracts code and conditions from a function that torch compiled or loaded."""
    return Code(compiled._artifacts.guard_manager.check, compiled.fn)


def forget_failure(error: Exception) -> None:
    """Lets torch compile again after a killed compiler has left part of a library."""
    from torch._inductor import codecache

    for name in ("CppCodeCache", "CppPythonBindingsCodeCache"):
        getattr(getattr(codecache, name, None), "cache", dict[str, object]()).clear()
    for library in LIBRARY.findall(str(error)):
        if library.startswith(os.environ.get("TORCHINDUCTOR_CACHE_DIR", "\0")):
            Path(library).unlink(missing_ok=True)


# -- functions ---------------------------------------------------------------------------------------------------------


class CachedFunction:
    """A function of tensors through torch.compile, whose code is cached in `functions_folder()` between processes.

    `varying`: sizes (tensor, axis) of arguments that may differ at the next call; `unchecked`: conditions of CHECKED to
    skip.
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
        """Returns code that holds for arguments; None: left to torch.compile."""
        kind = (*modes(arguments), *map(kind_of, arguments))
        codes, named = self.codes.setdefault(kind, []), self.named(arguments)
        for code in codes:
            if code.holds(named):
                return code
        file = self.file(arguments) if len(codes) < VARIANTS else None
        if file is None:
            return None
        try:
            with waiting(), creation_lock(file, wait=True):
                known, slot = self.find(file, arguments)
                if known is None:
                    logger.info("compiling %s, once for all later runs ...", self.function.__name__.replace("_", " "))
                code = known or self.make(slot, arguments)
        except Exception as error:  # of an experimental interface; torch.compile reports the true cause
            logger.info("%s is compiled, not cached (%s)", self.function.__name__, first_line(error))
            self.works = False
            return None
        codes.append(code)
        return code

    def file(self, arguments: Arguments) -> Path | None:
        """Returns the file of code for such arguments; None: not cached."""
        folder, sources = functions_folder(), sources_of(self.function.__module__)
        if not (folder and sources and self.works) or self.function.__closure__:
            return None
        varying = {(id(tensor), axis) for tensor, axis in self.varying(arguments)}
        forms, function = [form_of(value, varying) for value in arguments], self.function
        how = repr(function.__defaults__), sorted(self.options.items()), self.checked, sorted(TRACING.items())
        about = function.__module__, function.__qualname__, sources, how, forms
        key = content_key(about, *modes(arguments), machine())
        return folder / f"{self.function.__name__}-{key}.bin"

    def find(self, file: Path, arguments: Arguments) -> tuple[Code | None, Path]:
        """Returns (code from the disk that holds, or None; file for new code).

        torch specialises code for a few sizes, above all one row: such code is numbered from 1.
        """
        for slot in (file, *(file.with_name(f"{file.stem}-{number}.bin") for number in range(1, VARIANTS))):
            code = load(slot, self.options)
            if code is None or code.holds(self.named(arguments)):
                return code, slot
        return None, file

    def make(self, file: Path, arguments: Arguments) -> Code:
        """Compiles code and saves it; ValueError: it does not hold for these arguments."""
        remove_half_libraries()
        try:
            compiled = self.compile(arguments)
        except Exception as error:
            forget_failure(error)
            compiled = self.compile(arguments)
        code = code_of(compiled)
        if not code.holds(self.named(arguments)):
            raise ValueError("the compiled code does not hold for its own arguments")
        save(compiled, file)
        return code

    def named(self, arguments: Arguments) -> dict[str, Any]:
        """Returns arguments by name, without the last ones, which have defaults."""
        return dict(zip(self.names, arguments, strict=False))

    def compile(self, arguments: Arguments) -> Any:
        """Compiles the function for such arguments."""
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
    """Returns a parameter without its accumulated gradient, on which code would depend."""
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
    """Time that a thread has waited for compiled code, seconds."""

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
    """Returns the seconds of a clock that stops while its thread waits for code to be compiled or read."""
    return time.perf_counter() - WAITED.seconds


# -- ahead -------------------------------------------------------------------------------------------------------------

Call: TypeAlias = tuple[CachedFunction, Arguments, bool]
"""A function, its arguments, and if gradients were enabled."""
RECORDED: ContextVar[list[Call] | None] = ContextVar("RECORDED", default=None)
"""Calls so far; None: not recording."""


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


def record(function: CachedFunction, arguments: Arguments) -> bool:
    """Records a call, if calls are recorded; returns True if they are."""
    calls = RECORDED.get()
    if calls is not None:
        calls.append((function, arguments, torch.is_grad_enabled()))
    return calls is not None


def file_of(function: CachedFunction, arguments: Arguments, gradients: bool) -> Path | None:
    """Returns the file of code for a call; None: not cached."""
    with torch.set_grad_enabled(gradients):
        return function.file(arguments)


def uncached(calls: Sequence[Call]) -> list[Call]:
    """Returns the calls whose code is not cached yet."""
    return [call for call in calls if (file := file_of(*call)) is None or not file.exists()]


def make_ahead(calls: Sequence[Call], stopping: Callable[[], bool] = lambda: False) -> None:
    """Compiles and saves code for uncached calls, until `stopping`; skips those that another process compiles."""
    for function, arguments, gradients in calls:
        if stopping():
            return
        file = file_of(function, arguments, gradients)
        if file is None or file.exists():
            continue
        # a failure is reported where the function is called
        with creation_lock(file) as alone, torch.set_grad_enabled(gradients), suppress(Exception):
            if alone and not file.exists():
                function.make(file, arguments)
