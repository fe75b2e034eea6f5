"""Progress of training and evaluation: one live line on a terminal, plain lines elsewhere, metrics.jsonl."""

import json
import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from gsx.core.files import replace_file
from gsx.core.plugins import hookimpl
from gsx.core.training.run import Run, StepResult
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluator import peak_memory_mb, quick_psnr
from gsx.experiments.run_folder.files import read_lines

METRICS = "metrics.jsonl"
LIVE_SECONDS, PLAIN_SECONDS = 0.2, 5.0
"""Time between updates on a terminal, and elsewhere (a Slurm log stays readable)."""
SMOOTHING = 0.3
"""Weight of the newest line in the displayed loss, PSNR and speed."""


def clock(seconds: float) -> str:
    """Format seconds as m:ss or h:mm:ss."""
    hours, rest = divmod(max(0, int(seconds)), 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"


class Line:
    """One line, overwritten on a terminal; plain lines elsewhere, less often."""

    def __init__(self) -> None:
        self.stream = sys.stderr
        self.live = self.stream.isatty()
        self.updated = time.monotonic() - PLAIN_SECONDS
        self.width = 0

    def due(self) -> bool:
        """Return True if an update is due, and start its waiting time again."""
        now = time.monotonic()
        due = now - self.updated >= (LIVE_SECONDS if self.live else PLAIN_SECONDS)
        self.updated = now if due else self.updated
        return due

    def show(self, text: str) -> None:
        """Write over the last line on a terminal, below it elsewhere."""
        end, start = ("", "\r") if self.live else ("\n", "")
        text = text[: self.room()]
        with suppress(OSError):  # its terminal was closed
            self.stream.write(start + text.ljust(self.width if self.live else 0) + end)
            self.stream.flush()
        self.width = len(text)

    def room(self) -> int | None:
        """Return the columns of the terminal but one, as longer lines wrap; None without a terminal."""
        with suppress(OSError, ValueError):
            columns = os.get_terminal_size(self.stream.fileno()).columns
            return columns - 1 if columns > 1 else None
        return None

    def end(self) -> None:
        """Leave the last line on the terminal."""
        if self.live and self.width:
            with suppress(OSError):
                self.stream.write("\n")
            self.width = 0


class Countdown:
    """A line with the finished share of some work, and the time left at the same speed."""

    def __init__(self, what: str, total: float) -> None:
        self.what, self.total, self.line = what, total, Line()
        self.done, self.started = 0.0, time.monotonic()

    def advance(self, amount: float, part: str) -> None:
        """Add to the finished amount of `total`; `part`: name of the last part."""
        self.done += amount
        left = max(0.0, self.total - self.done)
        last = left < 1e-6 * self.total
        if self.line.due() or last:
            seconds = (time.monotonic() - self.started) * left / self.done
            self.line.show(f"{self.what} {self.done / self.total:.0%}  {part}  ETA {clock(seconds)}")
        if last:
            self.line.end()


class Progress:
    """Listener that displays step, speed, loss, PSNR, primitives, memory and time left."""

    def __init__(self) -> None:
        self.output = Line()
        self.steps, self.seconds = 0, 0.0
        """Steps since the last update, and seconds of training at that update."""
        self.averages: dict[str, float] = {}

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """Measure speed from here on."""
        self.seconds = run.progress.seconds

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Update the line when due."""
        self.steps += 1
        if not self.output.due() and not run.complete:
            return
        self.average("loss", float(step.loss))
        self.average("psnr", step.psnr())
        self.average("speed", self.steps / max(run.progress.seconds - self.seconds, 1e-9))
        self.steps, self.seconds = 0, run.progress.seconds
        self.output.show(self.line(run))

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Leave the last line on the terminal."""
        self.output.end()

    def average(self, name: str, value: float) -> None:
        """Update the exponential average of a displayed value."""
        old = self.averages.get(name, value)
        self.averages[name] = old + SMOOTHING * (value - old)

    def line(self, run: Run) -> str:
        """Return the line."""
        a, primitives, memory = self.averages, len(run.backbone.table), peak_memory_mb(run.device)
        megabytes = "" if memory is None else f"  {memory:,.0f} MB"
        return (
            f"step {run.step}/{run.iterations}  {a['speed']:.1f} it/s  "
            f"ETA {clock((run.iterations - run.step) / a['speed'])}  "
            f"loss {a['loss']:.4f}  PSNR {a['psnr']:.2f}  {primitives:,} splats{megabytes}"
        )


def read_curves(folder: Path) -> list[dict[str, Any]]:
    """Read the intact lines of a run's metrics.jsonl."""
    return read_lines(folder / METRICS, {})


class MetricsLog:
    """Listener that appends to metrics.jsonl every `training.log_every` steps, test PSNR at evenly spaced points."""

    def __init__(self, options: EvalOptions) -> None:
        self.options = options
        self.stream: IO[str] | None = None

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """Open the file without lines later than the run's step, which a resumed run may have."""
        path = run.folder / METRICS
        run.progress.curves[:] = [line for line in read_curves(run.folder) if line["step"] <= run.step]
        replace_file(path, "".join(json.dumps(line) + "\n" for line in run.progress.curves).encode())
        self.stream = path.open("a")

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Write a line when due, or after an event."""
        points = run.training.test_points
        tested = points > 0 and run.step * points // run.iterations > (run.step - 1) * points // run.iterations
        event = step.changes or step.pseudo or step.skipped
        if not (run.step % run.training.log_every == 0 or event or tested or run.step == 1):
            return
        line = self.entry(run, step)
        if tested and run.scene.test:
            line["test_psnr"] = quick_psnr(run, self.options)
        run.progress.curves.append(line)
        assert self.stream is not None
        self.stream.write(json.dumps(line) + "\n")
        self.stream.flush()

    def entry(self, run: Run, step: StepResult) -> dict:
        """Return one line of metrics.jsonl."""
        memory = peak_memory_mb(run.device)
        return {
            "step": run.step,
            "seconds": round(run.progress.seconds, 3),
            "loss": float(step.loss),
            "psnr": step.psnr(),
            "primitives": len(run.backbone.table),
            "pairs": step.rendering.intersections,
            "memory_mb": None if memory is None else round(memory, 1),
            **({"terms": step.terms} if step.terms else {}),
            **({"pseudo": step.pseudo} if step.pseudo else {}),
            **({"left_out": step.dropped} if step.dropped else {}),
            **step.changes,
            **({"skipped": step.skipped} if step.skipped else {}),
        }

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file, however training ended."""
        if self.stream is not None:
            self.stream.close()
