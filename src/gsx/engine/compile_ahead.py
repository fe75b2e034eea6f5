"""Compilation of all that a training step needs, before the first step; a second process compiles half of it."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Thread

import torch
from torch.nn import Parameter

from gsx.core.data.camera import Camera, look_at
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Splats
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.engine.backend import COMPILED
from gsx.engine.cache import content_key
from gsx.engine.compile_cache import (
    Call,
    functions_folder,
    machine,
    make_ahead,
    modes,
    recorded,
    sources_of,
    uncached,
)
from gsx.engine.compositors import COMPOSITORS

WARM_SPLATS, WARM_SIZE = 2000, (128, 96)
"""Splats and size of the picture whose drawing compiles everything: lists of several chunks in several groups."""
HELPER = "import sys; from gsx.engine.compile_ahead import help_compiling; help_compiling(sys.argv[1])"
"""Program of the second process."""
RUNNING: ContextVar[subprocess.Popen[bytes] | None] = ContextVar("RUNNING", default=None)
"""The second process; None: none was started."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """Rules of the rasterizer and the backbone that the code of a step depends on."""

    settings: RasterSettings
    sh_degree: int = 0
    """Degree of the spherical harmonics."""
    absolute_gradient: bool = False
    """True if the backbone needs absolute gradients of screen means."""

    @property
    def words(self) -> str:
        """Rules and number of threads as JSON, without what no code depends on."""
        settings = self.settings.options | {"training_focal": 0.0}
        return json.dumps(vars(self) | {"settings": settings, "threads": torch.get_num_threads()})

    @property
    def stamp(self) -> Path | None:
        """Empty file that exists once all code of the step is cached; None: code is not cached."""
        folder, sources = functions_folder(), sources_of(__name__)
        if folder is None or sources is None:
            return None
        return folder / f"step-{content_key(self.words, sources, modes(()), machine())}.done"


def compile_ahead(
    step: Step, device: torch.device, helped: bool = True, stopping: Callable[[], bool] = lambda: False
) -> float:
    """Compiles all that a step needs and that is not cached, until `stopping`; returns the seconds that it took.

    `helped`: by a second process on a CPU.
    """
    start = time.perf_counter()
    calls = needed(step, device)
    missing = uncached(calls)
    if missing:
        with helper(step, helped and len(missing) > 1 and functions_folder() is not None):
            make_ahead(calls, stopping)
            if not stopping():
                draw_one(step, device)
    if calls and not (missing and uncached(calls)):
        leave_stamp(step)
    return time.perf_counter() - start


def leave_stamp(step: Step) -> None:
    """Records that all code of a step is cached; on a full disk the next run looks for each function."""
    if (stamp := step.stamp) is not None:
        with suppress(OSError):
            stamp.touch()


def needed(step: Step, device: torch.device) -> list[Call]:
    """Lists the compiled calls of a step; on a GPU it compiles them at once and lists none."""
    with recorded() as calls:
        draw_one(step, device)
    return calls


def draw_one(step: Step, device: torch.device) -> None:
    """Runs a small picture through all that a step compiles."""
    splats, degree = warm_splats(device), step.sh_degree
    rest = Parameter(torch.zeros(len(splats), (degree + 1) ** 2 - 1, 3, device=device))
    colours = colours_of(splats.colours[:, None], rest, splats.means, degree, COMPILED)
    as_training = replace(step.settings, training_focal=0.0)
    drawn = replace(splats, colours=colours)
    image = rasterize(drawn, warm_camera(), as_training, absolute_gradient=step.absolute_gradient).image
    photometric(image, torch.zeros(image.shape, device=device), 0.2, COMPILED).backward()


def warm_camera() -> Camera:
    """Returns the camera of the small picture."""
    return look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=WARM_SIZE[0], height=WARM_SIZE[1])


def warm_splats(device: torch.device) -> Splats:
    """Draws faint splats before the camera from their own generator, which leaves a run's randomness unchanged."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(WARM_SPLATS, 3, generator=generator) * 2 - 1
    fields = {
        "means": means,
        "scales": torch.full_like(means, 0.05),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(WARM_SPLATS, 1),
        "log_opacities": torch.full((WARM_SPLATS,), -2.0),
        "colours": torch.rand(WARM_SPLATS, 3, generator=generator),
    }
    return Splats(**{name: value.to(device).requires_grad_() for name, value in fields.items()})


# -- the second process ------------------------------------------------------------------------------------------------


@contextmanager
def compiling_early(step: Step) -> Iterator[None]:
    """Compiles a step in a second process during the context, unless all of its code is cached."""
    stamp = step.stamp
    with helper(step, stamp is not None and not stamp.exists()):
        yield


@contextmanager
def helper(step: Step, enabled: bool = True) -> Iterator[None]:
    """Runs a process that compiles the calls of a step from the last to the first, as long as the context lasts.

    Starts none if one that runs compiles this step, if this process has a single thread, or if the system refuses.
    """
    process = start_helper(step.words) if enabled and torch.get_num_threads() > 1 else None
    token = RUNNING.set(process or RUNNING.get())
    try:
        yield
    finally:
        RUNNING.reset(token)
        if process is not None:
            end(process)


def start_helper(words: str) -> subprocess.Popen[bytes] | None:
    """Starts the second process; ends one that runs for another step, and returns None for one that runs for this."""
    running = RUNNING.get()
    if running is not None and running.poll() is None:
        if running.args[-1] == words:  # type: ignore[index]
            return None
        end(running)
    with suppress(OSError):
        return subprocess.Popen(
            [sys.executable, "-P", "-c", HELPER, words],
            stdin=subprocess.PIPE,  # its end stops the process, also if this one is killed
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for this process alone
        )
    return None


def end(process: subprocess.Popen[bytes]) -> None:
    """Ends a helper and its compilers; SIGTERM lets these remove unfinished files."""
    if os.name == "posix":
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
    process.terminate()
    process.communicate()


def help_compiling(words: str) -> None:
    """Compiles the calls of a step from the last to the first, until standard input ends or the compiler fails."""
    Thread(target=end_with_input, daemon=True).start()
    fields = json.loads(words)
    torch.set_num_threads(fields.pop("threads"))
    step = Step(**fields | {"settings": RasterSettings(**fields["settings"], compositors=COMPOSITORS)})
    calls = needed(step, torch.device("cpu"))[::-1]
    make_ahead(calls[:1])
    if not uncached(calls[:1]):  # else nothing can be compiled
        make_ahead(calls)


def end_with_input() -> None:
    """Ends this process and its compilers when standard input ends, since the process that started it is gone."""
    sys.stdin.buffer.read()
    if os.name == "posix" and os.getpgrp() == os.getpid():
        os.killpg(os.getpid(), signal.SIGTERM)
    os._exit(0)
