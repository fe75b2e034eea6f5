"""What a training run does about the compiled path before its first step."""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass, replace
from threading import Thread
from typing import IO

import torch
from torch.nn import Parameter

from gsx.core.data.camera import Camera, look_at
from gsx.core.errors import first_line
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Splats
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import RasterSettings, rasterize, rasterize_tiled
from gsx.core.training.run import Run
from gsx.engine.compile_cache import Call, file_of, lacking, make_ahead, nothing_kept, recorded
from gsx.engine.compiling import available
from gsx.engine.path import compiles
from gsx.experiments.runs.settings import Settings

logger = logging.getLogger(__name__)

WARM_SPLATS, WARM_SIZE = 2000, (128, 96)
"""Of the picture that has everything compiled: lists of several chunks in several groups."""
HELPED: ContextVar[bool] = ContextVar("HELPED", default=False)
"""Whether a second process was begun, which compiles or has done so."""


@dataclass(frozen=True, kw_only=True)
class Learnt:
    """What code for a step depends on beside the rules of the rasterizer."""

    sh_degree: int = 0
    """Up to which colours change with direction."""
    absolute_gradient: bool = False
    """Whether the backbone asks for absolute gradients of screen means."""


def decide(settings: RasterSettings, steps: int, device: torch.device) -> RasterSettings:
    """Settings for a training run of `steps`: path=auto becomes eager or compiled, with a word about why."""
    if settings.path != "auto":
        return settings
    long_enough = asks_for_code(settings, steps)
    compiled = long_enough and available(device.type)
    reason = f"{steps} steps" if compiled or not long_enough else "no working compiler"
    path = "compiled" if compiled else "eager"
    logger.info("rasterizer: %s path (%s; rasterizer=eager or rasterizer=compiled decides otherwise)", path, reason)
    return replace(settings, path=path)


def asks_for_code(settings: RasterSettings, steps: int) -> bool:
    """Whether a training run of `steps` is to be drawn by the compiled path, if that works here."""
    return settings.path == "compiled" or (settings.path == "auto" and steps >= settings.auto_steps)


@contextmanager
def help_at_once(settings: Settings, device: torch.device) -> Iterator[None]:
    """Where nothing was ever compiled a second process begins with that, as long as the context lasts, while the first
    one starts; elsewhere it is known later what is lacking."""
    wanted = device.type == "cpu" and asks_for_code(settings.raster, settings.general.iterations) and nothing_kept()
    with helper(settings.raster, sh_degree(settings)) if wanted else nullcontext():
        yield


def sh_degree(settings: Settings) -> int:
    """Degree of a backbone's spherical harmonics; 0 of one that has no such option."""
    return getattr(settings.backbone.options, "sh_degree", 0)


def warm(run: Run, settings: Settings, helped: bool = True) -> None:
    """Have the rasterizer and the loss compiled before the first step, and say so; `helped`: by a second process."""
    if compiles(run.raster, run.device.type):
        logger.info("compiling the rasterizer once; later runs find it on disk ...")
        learnt = Learnt(sh_degree=sh_degree(settings), absolute_gradient=run.backbone.absolute_gradient)
        seconds = compile_now(run.raster, learnt, run.device, helped, lambda: run.stopping)
        if not run.stopping:
            logger.info("compiled in %.0f s", seconds)


def compile_now(
    settings: RasterSettings,
    learnt: Learnt,
    device: torch.device,
    helped: bool = False,
    stopping: Callable[[], bool] = lambda: False,
) -> float:
    """Learn from a small picture, so that all loops get compiled, unless all are kept or it is to stop; returns the
    seconds it took."""
    begun = time.perf_counter()
    calls = needed(settings, learnt, device)
    if lacking(calls):  # on a GPU there are no calls: all has been compiled by now
        with helper(settings, learnt.sh_degree) if helped else nullcontext():
            common = set(map(file_of, of_any_backbone(calls, settings, learnt)))
            own_first = sorted(calls, key=lambda call: file_of(call) in common)  # what nobody helps with
            make_ahead(own_first, stopping)
            if not stopping():
                learn_little(settings, learnt, device)
    return time.perf_counter() - begun


def needed(settings: RasterSettings, learnt: Learnt, device: torch.device) -> list[Call]:
    """Calls of all that a step compiles."""
    with recorded() as calls:
        learn_little(settings, learnt, device)
    return calls


def learn_little(settings: RasterSettings, learnt: Learnt, device: torch.device) -> None:
    """All that a step compiles, on a small picture."""
    splats, degree = warm_splats(device), learnt.sh_degree
    rest = Parameter(torch.zeros(len(splats), (degree + 1) ** 2 - 1, 3, device=device))
    colours = colours_of(splats.colours[:, None], rest, splats.means, degree, compiled=True)
    as_training, absolute = replace(settings, training_focal=0.0), learnt.absolute_gradient
    image = rasterize(replace(splats, colours=colours), warm_camera(), as_training, absolute_gradient=absolute).image
    photometric(image, torch.zeros(image.shape, device=device), 0.2, compiled=True).backward()


@contextmanager
def helper(settings: RasterSettings, sh_degree: int) -> Iterator[None]:
    """A process that compiles from the other end what backbones of this degree have in common, as long as the context
    lasts; none where this process has a single thread, or was given one before."""
    process = begun(settings, sh_degree) if torch.get_num_threads() > 1 and not HELPED.get() else None
    if process is None:
        yield
        return
    token = HELPED.set(True)
    try:
        yield
    finally:
        HELPED.reset(token)
        kill(process)


def begun(settings: RasterSettings, sh_degree: int) -> subprocess.Popen[bytes] | None:
    """That process; None where there can be none, which is said."""
    given = {"settings": asdict(replace(settings, path="compiled")), "sh_degree": sh_degree}
    words = json.dumps(given | {"threads": torch.get_num_threads()})
    code = "import sys; from gsx.experiments.runs.rasterizer_path import help_compiling; help_compiling(sys.argv[1])"
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-c", code, words],
            stdin=subprocess.PIPE,  # by its end the process knows that this one is gone
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C is for this one, which ends the other
        )
    except OSError as error:
        logger.info("this process compiles alone (%s)", first_line(error))
        return None


def help_compiling(words: str) -> None:
    """What that process does, as long as the one is there that began it."""
    Thread(target=end_with, args=[sys.stdin.buffer], daemon=True).start()
    given = json.loads(words)
    torch.set_num_threads(given["threads"])
    settings, learnt = RasterSettings(**given["settings"]), Learnt(sh_degree=given["sh_degree"])
    make_ahead(of_any_backbone(needed(settings, learnt, torch.device("cpu")), settings, learnt)[::-1])


def end_with(stream: IO[bytes]) -> None:
    """End this process, and the compilers that it has begun, when nobody can write to a stream any more."""
    stream.read()
    if os.name == "posix" and os.getsid(0) == os.getpid():
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(0)


def kill(process: subprocess.Popen[bytes]) -> None:
    """End a process of a session of its own, and the compilers that it has begun."""
    if os.name == "posix":
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.communicate()


def of_any_backbone(calls: Sequence[Call], settings: RasterSettings, learnt: Learnt) -> list[Call]:
    """Those of a step's calls that are the same by any screen filter and any gradients, which the backbone chooses."""
    other = replace(settings, dilation=settings.dilation + 1, compensate=not settings.compensate, zoomed="plain")
    others = needed(other, replace(learnt, absolute_gradient=not learnt.absolute_gradient), torch.device("cpu"))
    files = set(map(file_of, others))
    return [call for call in calls if file_of(call) in files]


def compile_beside(settings: RasterSettings, device: torch.device, take: Callable[[RasterSettings], None]) -> Thread:
    """Have what draws pictures compiled in a thread, and hand over the settings by which that is used; nothing where
    nothing compiles. Until then pictures are drawn by the eager path."""
    compiled = replace(settings, path="compiled")

    def draw_one() -> None:
        splats = Splats(**{name: value.detach() for name, value in vars(warm_splats(device)).items()})
        try:
            if not available(device.type):
                return
            rasterize_tiled(splats, warm_camera(), compiled, background=torch.zeros(3, device=device))
        except Exception as error:  # a compiler's; pictures come all the same
            logger.info("pictures are drawn by the eager path (%s)", first_line(error))
        else:
            take(compiled)

    thread = Thread(target=draw_one, name="compiling", daemon=True)
    if settings.path != "eager":
        thread.start()
    return thread


def warm_camera() -> Camera:
    """What looks at them."""
    return look_at((0, -3, 0), (0, 0, 0), fov_x=0.7, width=WARM_SIZE[0], height=WARM_SIZE[1])


def warm_splats(device: torch.device) -> Splats:
    """Faint splats before the camera; their own generator, so that a run's randomness is not touched."""
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
