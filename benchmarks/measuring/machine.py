"""What a result was measured on."""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import gsx
from gsx.engine.machine import device_name

ROOT = Path(__file__).parents[2]
BUSY = 0.3
"""Load average over a minute above which other work disturbs the measurement."""


def describe_machine(device: torch.device) -> dict[str, Any]:
    """Lasting facts: processor, threads, versions, compiler."""
    facts = {
        "cpu": device_name(torch.device("cpu")),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "vectors": torch.backends.cpu.get_cpu_capability(),
        "memory_gb": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1),
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "compiler": compiler(),
        "gsx": gsx.__version__,
    }
    return facts | ({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {})


def compiler() -> str:
    """First line of the C++ compiler's version, or why there is none; torch.compile asks for the same ones."""
    found = next((path for name in (os.environ.get("CXX", ""), "g++", "clang++") if (path := shutil.which(name))), "")
    return first_line([found, "--version"]) if found else "none"


def commit() -> str:
    """The checked out revision, marked where source files differ from it."""
    revision = first_line(["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"])
    changed = first_line(["git", "-C", str(ROOT), "status", "--porcelain", "--", "src", "benchmarks", "conf"])
    return f"{revision}, with changes" if revision and changed else revision


def first_line(command: list[str]) -> str:
    """First line that a command prints; empty when it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return (done.stdout.splitlines() or [""])[0]


def load_average() -> float:
    """Processes that ran or waited, over the last minute."""
    return round(os.getloadavg()[0], 2)


def shown_command(arguments: Sequence[str], script: str = "benchmarks/rasterizer.py") -> str:
    """The command line with files by their names: folders are this machine's own."""
    return " ".join([f"python {script}", *map(without_folders, arguments)])


def without_folders(word: str) -> str:
    """`--to=/some/where` as `--to=where`."""
    option, equals, value = word.rpartition("=")
    return option + equals + (Path(value).name if "/" in value else value)


def told_load() -> float:
    """The load average; a warning where it disturbs the measurement."""
    load = load_average()
    if load > BUSY:
        print(f"the load is {load:.2f}: seconds will not be those of an idle machine", file=sys.stderr)
    return load
