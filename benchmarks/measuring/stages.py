"""The stages of a training step, clocked from outside: each function's time without that of the stages within it."""

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from itertools import cycle
from pathlib import Path
from typing import Any

from gsx.builtin import plugins
from gsx.core.training.run import Run
from gsx.core.training.trainer import train_step
from gsx.experiments.runs.open import open_run

VIEWS, UNTIMED = 10, 5
"""Training views that the steps walk through; steps before the clock starts, which compile."""
REST = "everything else"
PLACES = [
    ("projection", "gsx.core.rasterizer.render", "project"),
    ("tiles", "gsx.core.rasterizer.render", "intersect_tiles"),
    ("lists", "gsx.engine.compiled", "lay_out"),
    ("lists", "gsx.engine.compiled", "places_of"),
    ("blending", "gsx.engine.compiled", "CompiledCompositor.__call__"),
    ("blending, backward", "gsx.engine.compiled", "CompiledComposite.backward"),
    ("loss", "gsx.core.training.trainer", "photometric"),
    ("backward, but for blending", "torch", "Tensor.backward"),
]
"""Functions that a stage begins and ends with, where the step looks them up."""
METHODS = {
    "splats": "draw",
    "statistics": "observe",
    "sums": "accumulate",
    "density": "densify_and_prune",
    "Adam": "update",
}
"""The same of the backbone."""


@dataclass(eq=False)
class StageClock:
    """Seconds by stage; a stage within another stops the other's clock."""

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    open: list[str] = field(default_factory=list)
    last: float = 0.0

    def turn(self) -> None:
        """Give the time since the last turn to the innermost stage."""
        now = time.perf_counter()
        if self.open:
            self.seconds[self.open[-1]] += now - self.last
        self.last = now

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time within belongs to a stage."""
        self.turn()
        self.open.append(name)
        try:
            yield
        finally:
            self.turn()
            self.open.pop()

    def clocked(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function` as a stage."""

        def call(*given: Any, **named: Any) -> Any:
            with self.stage(name):
                return function(*given, **named)

        return call


def install(clock: StageClock, run: Run) -> None:
    """Have the stages of the run's steps clocked, for the rest of this process. A source may lack some."""
    for name, module, path in PLACES:
        *owners, last = path.split(".")
        owner = import_module(module)
        for part in owners:
            owner = getattr(owner, part)
        if hasattr(owner, last):
            made = clock.clocked(name, getattr(owner, last))
            setattr(owner, last, staticmethod(made) if isinstance(vars(owner)[last], staticmethod) else made)
    for name, method in METHODS.items():
        setattr(run.backbone, method, clock.clocked(name, getattr(run.backbone, method)))


@dataclass(frozen=True)
class Measured:
    """What the steps of a run took, and what they worked on."""

    milliseconds: dict[str, float]
    """Median over steps, by stage; `step`: of the whole."""
    counts: dict[str, float]
    """primitives, numbers (learnt), shown, pairs, pixels: means over steps."""


def measure_stages(folder: Path, steps: int) -> Measured:
    """Steps of the run as its last checkpoint left it, by the compiled path; the folder is not written to.

    The step's number stays, so that density control, which comes now and then, is left out.
    """
    with suppress(ImportError):  # older sources know nothing of it
        from gsx.engine.allocator import keep_freed_memory

        keep_freed_memory()
    loaded, clock = plugins(), StageClock()
    run = open_run(folder, loaded, ["device=cpu"])[0]
    run.raster = run.backbone.raster = replace(run.raster, path="compiled")
    install(clock, run)
    views, start = cycle(range(min(VIEWS, len(run.scene.train)))), run.step
    for view in run.scene.train[:VIEWS]:
        view.image()
    rounds, seen = [], []
    for number in range(UNTIMED + steps):
        run.sampler.order.append(next(views))
        run.step = start
        clock.seconds.clear()
        with clock.stage(REST):
            step = train_step(run, loaded)
        if number >= UNTIMED:
            rounds.append({name: 1e3 * spent for name, spent in clock.seconds.items()})
            seen.append((len(step.rendering.screen.ids), step.rendering.intersections, step.rendering.image[0].numel()))
    stages = {name: statistics.median(each.get(name, 0.0) for each in rounds) for name in rounds[0]}
    whole = statistics.median(sum(each.values()) for each in rounds)
    shown, pairs, pixels = (statistics.mean(column) for column in zip(*seen, strict=True))
    learnt = sum(value.numel() for value in run.backbone.table.parameters.values())
    counts = {
        "primitives": len(run.backbone.table),
        "numbers": learnt,
        "shown": shown,
        "pairs": pairs,
        "pixels": pixels,
    }
    return Measured(stages | {"step": whole}, counts)
