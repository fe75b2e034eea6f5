"""Peak memory of a case, measured in a process of its own.

    cd benchmarks; python -m measuring.memory '{"path": "eager", "case": {...}, "settings": {...}}'

prints the megabytes of each phase above what the inputs and the libraries need, and the whole process at its largest.
"""

import ctypes
import gc
import json
import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from gsx.core.rasterizer import RasterSettings
from gsx.engine.compositors import COMPOSITORS
from measuring.cases import Case, drawing
from measuring.watches import Job

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
"""Linux: where a process reads its peak and where it forgets it."""
KIB, MB = 1024, 1e6
FOLDER = Path(__file__).parents[1]
"""Where this package is found."""


def unmeasurable(device: torch.device) -> str:
    """Why peaks cannot be measured here; empty when they can."""
    if device.type == "cuda" or CLEAR.is_file():
        return ""
    return "the peak of a process can be followed on Linux only"


def host_peak() -> float:
    """Largest resident memory of this process since `forget_peak`, bytes.

    Not getrusage: a process begins with the ru_maxrss of the one that started it.
    """
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines() if ":" in line)
    return KIB * float(lines["VmHWM"].split()[0])


def forget_peak() -> None:
    """Let the peak begin anew at what is resident now."""
    CLEAR.write_text("5")


def return_freed() -> None:
    """Give freed memory back to the system, so that using it again shows."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@dataclass(eq=False)
class HostPeaks:
    """A watch of resident memory: bytes of each phase above those at the beginning."""

    phases: dict[str, float] = field(default_factory=dict)
    base: float = 0.0

    def begin(self) -> None:
        return_freed()
        forget_peak()
        self.base = host_peak()

    def lap(self, phase: str) -> None:
        self.phases[phase] = host_peak() - self.base
        return_freed()  # or what this phase freed would count in the next as well
        forget_peak()


@dataclass(eq=False)
class DevicePeaks:
    """The same of a GPU's memory, as torch's allocator hands it out."""

    phases: dict[str, float] = field(default_factory=dict)
    base: float = 0.0

    def begin(self) -> None:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        self.base = float(torch.cuda.memory_allocated())

    def lap(self, phase: str) -> None:
        torch.cuda.synchronize()
        self.phases[phase] = torch.cuda.max_memory_allocated() - self.base
        torch.cuda.reset_peak_memory_stats()


def peaks(job: Job, device: torch.device) -> dict[str, float]:
    """MB of each phase above the inputs, and `whole`: everything at the largest moment."""
    watch = DevicePeaks() if device.type == "cuda" else HostPeaks()
    job(watch)
    return {name: value / MB for name, value in watch.phases.items()} | {
        "whole": (watch.base + max(watch.phases.values())) / MB
    }


def peak_memory(path: str, case: Case, device: torch.device, settings: RasterSettings) -> dict[str, float]:
    """`peaks` of drawing a case; on a CPU in a fresh process, free of traces of other work."""
    if unmeasurable(device):
        return {}
    if device.type == "cuda":
        return peaks(drawing(path, case, device, settings), device)
    task = json.dumps({"path": path, "case": asdict(case), "settings": settings.options})
    threads = {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    command = [sys.executable, "-m", "measuring.memory", task]
    done = subprocess.run(command, cwd=FOLDER, env=os.environ | threads, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main(task: str) -> None:
    """Draw once to compile and to load what is loaded late, then measure."""
    given, device = json.loads(task), torch.device("cpu")
    job = drawing(
        given["path"], Case(**given["case"]), device, RasterSettings(**given["settings"], compositors=COMPOSITORS)
    )
    job(HostPeaks())
    sys.stdout.write(json.dumps(peaks(job, device)) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
